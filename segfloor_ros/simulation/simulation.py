"""The simulation of a drive: images of a stereo camera with everything true about them, rendered by
MuJoCo without a display.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.errors import InputError, SegfloorError
from segfloor_ros.geometry import Array, quaternion_xyzw
from segfloor_ros.grid.map_file import OCCUPIED, OccupancyGrid
from segfloor_ros.simulation.camera import (
    Picture,
    depth_reading_mm,
    develop,
    ideal_image,
    moments_s,
    plan_imaging,
    rectified_camera,
)
from segfloor_ros.simulation.motion import (
    Drive,
    ImuReadings,
    RigMotion,
    WheelReadings,
    imu_readings,
    plan_drive,
    smooth_motion,
    wheel_readings,
)
from segfloor_ros.simulation.scene import Scene
from segfloor_ros.simulation.solids import floors, is_moving, obstacles, part_poses, true_map
from segfloor_ros.simulation.world import CAMERAS, RIG, World, build_world, mover_bodies

GREY_OF_RGB = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True)
class SimulatedFrame:
    """One pair of images (H, W) uint8 as the cameras deliver them, where the rectified left
    optical frame was (4, 4), and the depth image (H, W) uint16 in mm, where there is a sensor.
    """

    index: int
    time_s: float
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    T_world_left: Array
    depth_mm: NDArray[np.uint16] | None = None


@dataclass(frozen=True)
class FrameTruth:
    """What is true of one frame's rectified left image: floor mask (H, W) uint8, 255 floor;
    depth_m and disparity_px (H, W) float32.
    """

    floor: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    disparity_px: NDArray[np.float32]


class Motion(Protocol):
    """Tells where the rectified left optical frame is (4, 4) at a time."""

    def T_world_left(self, time_s: float) -> Array:
        """Return the pose."""


class Simulation:
    """Drives through a scene. Use as a context manager; raises RenderingError where nothing can
    be rendered and InputError for an impossible scene. supersampling: the pictures are
    rendered this many times finer than the camera's pixels. robot: moves in place of the drive.
    """

    def __init__(self, scene: Scene, supersampling: int = 1, robot: Motion | None = None):
        self.scene, self._finer = scene, supersampling
        self.drive: Drive = plan_drive(scene.path, scene.camera.rate_hz)
        self.camera = rectified_camera(scene.camera)
        self.imaging = plan_imaging(scene)
        if scene.sensors.depth.max_m and not scene.camera.rectified:
            raise InputError('a depth sensor needs a camera without distortion and misalignment')
        solids, ground = obstacles(scene), floors(scene)
        self.motion = RigMotion(scene, self.drive, ground)
        self._moved: Motion = robot or self.motion
        self.true_map: OccupancyGrid = true_map(scene, solids, ground, self.drive.xy_yaw[0, :2])
        if robot is None:
            _check_clear(self.true_map, self.drive)
        width, height = self.imaging.width * supersampling, self.imaging.height * supersampling
        world = build_world(scene, max(width, self.camera.width), max(height, self.camera.height))
        self._renderer = WorldRenderer(scene, world)
        focal_px = self.imaging.focal_px * supersampling
        self._pictures = View(self._renderer, width, height, focal_px)
        self._truth = View(self._renderer, self.camera.width, self.camera.height, self.camera.fx)

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, *error: object) -> None:
        self._pictures.close()
        self._truth.close()

    @property
    def frame_count(self) -> int:
        """How many pairs the drive has."""
        return len(self.drive.times_s)

    def frames(self, every: int = 1) -> Iterator[SimulatedFrame]:
        """Yield the pairs in order, or only one of every so many."""
        for index in range(0, self.frame_count, every):
            yield self.frame(index)

    def frame(self, index: int) -> SimulatedFrame:
        """Render one pair."""
        return self.frame_at(index, float(self.drive.times_s[index]))

    def frame_at(self, index: int, time_s: float) -> SimulatedFrame:
        """Render a pair of a time; its noise depends on the number."""
        left, right = (
            develop(self._exposed(side, time_s), self.imaging, self.scene, side, index, time_s)
            for side in range(len(CAMERAS))
        )
        pose = self._moved.T_world_left(time_s)
        return SimulatedFrame(index, time_s, left, right, pose, self._depth_mm(index, time_s))

    def truth(self, index: int) -> FrameTruth:
        """Render what is true of one frame's rectified left image."""
        time_s = float(self.drive.times_s[index])
        self._renderer.move(self._moved.T_world_left(time_s), time_s)
        depth_m = self._truth.depth_m(CAMERAS[0])
        disparity_px = np.float32(self.camera.disparity_times_depth) / depth_m
        floor = self._truth.mask(CAMERAS[0], self._renderer.floor_ids)
        return FrameTruth(floor, depth_m, disparity_px)

    def wheels(self) -> WheelReadings | None:
        """Return what the wheels tell of the whole drive, where the scene has such."""
        if not self.scene.sensors.wheel_odometry.rate_hz:
            return None
        return wheel_readings(self.scene, smooth_motion(self.motion))

    def imu(self) -> ImuReadings | None:
        """Return what the IMU tells of the whole drive, where the scene has one."""
        if not self.scene.sensors.imu.rate_hz:
            return None
        return imu_readings(self.scene, smooth_motion(self.motion))

    def _depth_mm(self, index: int, time_s: float) -> NDArray[np.uint16] | None:
        if not self.scene.sensors.depth.max_m:
            return None
        taken_s = time_s - self.scene.sensors.depth.lag_s
        self._renderer.move(self._moved.T_world_left(taken_s), taken_s)
        true_m, grey = self._truth.depth_m(CAMERAS[0]), self._truth.grey(CAMERAS[0])
        return depth_reading_mm(self.scene, self.camera.fx, true_m, grey, index, time_s)

    def moving_mask(self, index: int) -> NDArray[np.uint8]:
        """Render what moves in one frame's left image: (H, W) uint8, 255 moving."""
        time_s = float(self.drive.times_s[index])
        self._renderer.move(self._moved.T_world_left(time_s), time_s)
        mask = self._pictures.mask(CAMERAS[0], self._renderer.moving_geoms(time_s))
        share = ideal_image(mask.astype(np.float32), self.imaging, 0)
        return np.where(share > 127, np.uint8(255), np.uint8(0))

    def _exposed(self, side: int, time_s: float) -> Picture:
        """Return the ideal picture of a camera, each row over its exposure around a time."""
        moments, weights = moments_s(self.scene, side)
        # The picture may be finer than the image, and larger, with the same middle, for the lens.
        rows = np.arange(self.imaging.height * self._finer) // self._finer
        margin, last = (self.imaging.height - len(weights)) // 2, len(weights) - 1
        weights = weights[(rows - margin).clip(0, last)]
        exposed = np.zeros((len(rows), 1), np.float32)
        for moment, weight in zip(time_s + moments, weights.T, strict=True):
            self._renderer.move(self._moved.T_world_left(moment), moment)
            exposed = exposed + weight[:, None] * self._pictures.grey(CAMERAS[side])
        return exposed


def _check_clear(grid: OccupancyGrid, drive: Drive) -> None:
    cells = ((drive.xy_yaw[:, :2] - np.array(grid.origin_xy_m)) / grid.resolution_m).astype(int)
    hits = np.nonzero(grid.cells[cells[:, 1], cells[:, 0]] == OCCUPIED)[0]
    if len(hits):
        x, y, _ = drive.xy_yaw[hits[0]]
        raise InputError(f'the path runs into an obstacle at x {x:.2f}, y {y:.2f} m')


class RenderingError(SegfloorError):
    """Nothing can be rendered here: a library is missing."""


class WorldRenderer:
    """A world in MuJoCo in which the stereo rig and what moves can be placed."""

    def __init__(self, scene: Scene, world: World):
        self.mujoco = import_mujoco()
        self._scene = scene
        self.model = self.mujoco.MjModel.from_xml_string(world.xml, world.files)
        self.data = self.mujoco.MjData(self.model)
        self._movers = mover_bodies(scene)
        self._mocap = {
            name: int(self.model.body(name).mocapid[0]) for name in [RIG, *chain(*self._movers)]
        }
        self.floor_ids = [self.model.geom(name).id for name in world.floor_geoms]

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
    of the picture, (width - 1) / 2 and (height - 1) / 2 in pixels. Close it when done.
    """

    def __init__(self, renderer: WorldRenderer, width: int, height: int, focal_px: float):
        self._model, self._data = renderer.model, renderer.data
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


def import_mujoco() -> Any:
    """Return the module. Raises RenderingError where it is not installed, or cannot render."""
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
