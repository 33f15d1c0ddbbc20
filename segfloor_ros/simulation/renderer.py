"""Pictures of a world through MuJoCo, without a display."""

from __future__ import annotations

import os
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.errors import SegfloorError
from segfloor_ros.geometry import Array, quaternion_xyzw
from segfloor_ros.simulation.movers import is_moving, part_poses
from segfloor_ros.simulation.scene import Scene
from segfloor_ros.simulation.world import RIG, World, mover_bodies

GREY_OF_RGB = np.array([0.299, 0.587, 0.114], np.float32)


class RenderingError(SegfloorError):
    """Nothing can be rendered here: a library is missing."""


class WorldRenderer:
    """A world in MuJoCo in which the stereo rig and what moves can be placed."""

    def __init__(self, scene: Scene, world: World):
        self.mujoco = _import_mujoco()
        self._scene = scene
        self.model = self.mujoco.MjModel.from_xml_string(world.xml, world.files)
        self.data = self.mujoco.MjData(self.model)
        self._movers = mover_bodies(scene)
        self._mocap = {
            name: int(self.model.body(name).mocapid[0]) for name in [RIG, *chain(*self._movers)]
        }
        self.floor_ids = [self.model.geom(name).id for name in world.floor_geoms]

    def view(self, width: int, height: int, focal_px: float) -> View:
        """Return a view through cameras of this size and focal length. Close it when done."""
        return View(self, width, height, focal_px)

    def move(self, T_world_left: Array, time_s: float) -> None:
        """Put the rig at a pose of the left optical frame, and what moves where it is at a time."""
        self._place(RIG, T_world_left[:3, 3], quaternion_xyzw(T_world_left[:3, :3]))
        for mover, names in zip(self._scene.movers, self._movers, strict=True):
            for name, T_world_part in zip(names, part_poses(mover, time_s), strict=True):
                self._place(name, T_world_part[:3, 3], quaternion_xyzw(T_world_part[:3, :3]))
        self.mujoco.mj_forward(self.model, self.data)

    def moving_geoms(self, time_s: float) -> list[int]:
        """Return the geoms of all that moves at a time."""
        moving = [
            name
            for mover, names in zip(self._scene.movers, self._movers, strict=True)
            for name in names
            if is_moving(mover, time_s)
        ]
        bodies = [self.model.body(name).id for name in moving]
        return [int(g) for g in np.flatnonzero(np.isin(self.model.geom_bodyid, bodies))]

    def _place(self, name: str, position: Array, quat_xyzw: Array) -> None:
        index = self._mocap[name]
        self.data.mocap_pos[index] = position
        self.data.mocap_quat[index] = np.roll(quat_xyzw, 1)


class View:
    """Pictures through the rectified pinhole cameras of the rig. The optical axis meets the middle
    of the picture, (width - 1) / 2 and (height - 1) / 2 in pixels.
    """

    def __init__(self, renderer: WorldRenderer, width: int, height: int, focal_px: float):
        self._model, self._data = renderer.model, renderer.data
        self._floor_ids = renderer.floor_ids
        self._geom_type = int(renderer.mujoco.mjtObj.mjOBJ_GEOM)
        self._fov_y_deg = float(np.degrees(2 * np.arctan(height / 2 / focal_px)))
        self._renderer = _open_renderer(renderer.mujoco, self._model, width, height)

    def close(self) -> None:
        """Free the graphics memory."""
        self._renderer.close()

    def grey(self, camera: str) -> NDArray[np.float32]:
        """Return the picture (H, W) float32, 0 to 255, of the camera `left` or `right`."""
        return self._render(camera).astype(np.float32) @ GREY_OF_RGB

    def depth_m(self, camera: str) -> NDArray[np.float32]:
        """Return the depths (H, W) float32 along the optical axis in metres."""
        self._renderer.enable_depth_rendering()
        depth_m = self._render(camera)
        self._renderer.disable_depth_rendering()
        return depth_m

    def floor_mask(self, camera: str) -> NDArray[np.uint8]:
        """Return the mask (H, W) uint8: 255 where the camera sees floor, 0 elsewhere."""
        return self.mask(camera, self._floor_ids)

    def mask(self, camera: str, geoms: list[int]) -> NDArray[np.uint8]:
        """Return the mask (H, W) uint8: 255 where the camera sees one of the geoms, 0 elsewhere."""
        self._renderer.enable_segmentation_rendering()
        ids = self._render(camera)
        self._renderer.disable_segmentation_rendering()
        seen = (ids[..., 1] == self._geom_type) & np.isin(ids[..., 0], geoms)
        return np.where(seen, 255, 0).astype(np.uint8)

    def _render(self, camera: str) -> NDArray[Any]:
        self._model.cam_fovy[:] = self._fov_y_deg
        self._renderer.update_scene(self._data, camera)
        return self._renderer.render().copy()


def _import_mujoco() -> Any:
    os.environ.setdefault('MUJOCO_GL', 'egl')
    try:
        import mujoco
    except ImportError:
        raise RenderingError(
            "simulating needs MuJoCo: pip install 'segfloor_ros[sim]' (or pip install mujoco)"
        ) from None
    except (AttributeError, OSError, RuntimeError):
        raise RenderingError(_NO_GL) from None
    return mujoco


def _open_renderer(mujoco: Any, model: Any, width: int, height: int) -> Any:
    try:
        return mujoco.Renderer(model, height, width)
    except (AttributeError, ImportError, OSError, RuntimeError):
        raise RenderingError(_NO_GL) from None


_NO_GL = (
    'no OpenGL library for rendering without a display: on Debian or Ubuntu install '
    'libegl1 and libgl1-mesa-dri (apt-get install libegl1 libgl1-mesa-dri)'
)
