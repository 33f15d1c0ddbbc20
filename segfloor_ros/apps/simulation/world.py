"""A scene as a MuJoCo model: textured meshes of prisms, floor, lights, the stereo rig, movers; and
what can be seen of it, rendered without a display.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from ctypes import ArgumentError
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from segfloor_ros.apps.simulation.scene import Lighting, Scene
from segfloor_ros.apps.simulation.solids import (
    CLASSES,
    GLASS,
    Prism,
    floors,
    is_moving,
    obstacles,
    part_poses,
    part_solids,
)
from segfloor_ros.apps.simulation.textures import Texture, make_texture
from segfloor_ros.core.errors import SegfloorError
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.quaternions import quaternion_xyzw

SHADOW_PX = 4096
"""Side of the picture of the shadows, which the sun casts within 12 m of the origin."""

GLASS_ALPHA = 0.12
"""Share of its own brightness that a pane adds to what is seen through it."""

RIG = 'rig'

CAMERAS = ('left', 'right')


@dataclass(frozen=True)
class Mesh:
    """Triangles: vertices and normals (V, 3), texture coordinates (V, 2) with v downward in the
    picture, faces (F, 3) counter-clockwise seen from outside.
    """

    vertices: Array
    normals: Array
    uv: Array
    faces: NDArray[np.int64]


def merge(meshes: list[Mesh]) -> Mesh:
    """Return one mesh with the triangles of all."""
    counts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.vstack([mesh.vertices for mesh in meshes]),
        np.vstack([mesh.normals for mesh in meshes]),
        np.vstack([mesh.uv for mesh in meshes]),
        np.vstack([mesh.faces + first for mesh, first in zip(meshes, counts, strict=True)]),
    )


def sides(prism: Prism, side_m: float) -> Mesh:
    """Return the upright sides of a prism. side_m: what the texture covers."""
    corners = prism.footprint
    following = np.roll(corners, -1, axis=0)
    along = following - corners
    lengths = np.hypot(*along.T)
    count = len(corners)
    index = np.stack([np.arange(count), (np.arange(count) + 1) % count], axis=1)
    low, high = prism.bottom_m[index], prism.top_m[index]
    xy = np.stack([corners, following], axis=1)
    vertices = np.concatenate(
        [np.dstack([xy, low]), np.dstack([xy[:, ::-1], high[:, ::-1]])], axis=1
    ).reshape(-1, 3)
    normals = np.repeat(_side_normals(prism, along / lengths[:, None]), 2, axis=1)
    normals = normals[:, [0, 2, 3, 1]].reshape(-1, 3)
    uv = _side_uv(prism, along / lengths[:, None], lengths, vertices, side_m)
    first = np.arange(count)[:, None] * 4
    faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    return Mesh(vertices, normals, uv, faces)


def _side_normals(prism: Prism, direction: Array) -> Array:
    """Return the normals (K, 2, 3) at the start and the end of each side."""
    flat = np.stack([direction[:, 1], -direction[:, 0], np.zeros(len(direction))], axis=1)
    if not prism.smooth:
        return np.stack([flat, flat], axis=1)
    corner = flat + np.roll(flat, 1, axis=0)
    corner /= np.linalg.norm(corner, axis=1, keepdims=True)
    return np.stack([corner, np.roll(corner, -1, axis=0)], axis=1)


def _side_uv(
    prism: Prism, direction: Array, lengths: Array, vertices: Array, side_m: float
) -> Array:
    """Return texture coordinates of the sides' vertices. Flat sides take the position along them,
    so that a pattern runs on over adjoining solids; round ones the way around.
    """
    if prism.is_sheet:
        return np.tile([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]], (len(lengths), 1))
    start = np.cumsum(lengths) - lengths
    if not prism.smooth:
        start = (prism.footprint * direction).sum(axis=1)
    end = start + lengths
    u = np.stack([start, end, end, start], axis=1).ravel() / side_m
    return np.stack([u, -vertices[:, 2] / side_m], axis=1)


def cap(prism: Prism, up: int, side_m: float) -> Mesh:
    """Return the top (up 1) or the bottom (up -1) of a prism."""
    heights_m = prism.top_m if up > 0 else prism.bottom_m
    vertices = np.column_stack([prism.footprint, heights_m])
    normal = np.cross(vertices[1] - vertices[0], vertices[2] - vertices[0])
    normal *= np.sign(normal[2]) * up / np.linalg.norm(normal)
    second = np.arange(1, len(vertices) - 1)
    fan = np.stack([np.zeros_like(second), second, second + 1], axis=1)
    uv = vertices[:, :2] * (1.0, -1.0) / side_m
    return Mesh(vertices, np.tile(normal, (len(vertices), 1)), uv, fan if up > 0 else fan[:, ::-1])


@dataclass
class World:
    """A MuJoCo model: xml with its binary files, names of the floor's geoms, and the parts that it
    is put together from. labels: the class of each geom by name;
    by_class: whether no geom belongs to two, which may change rounding in a few pixels.
    """

    scene: Scene
    textures: dict[str, Texture] = field(default_factory=dict)
    assets: list[str] = field(default_factory=list)
    bodies: list[str] = field(default_factory=list)
    files: dict[str, bytes] = field(default_factory=dict)
    floor_geoms: list[str] = field(default_factory=list)
    labels: dict[str, str] = field(default_factory=dict)
    by_class: bool = False
    xml: str = ''

    def texture(self, name: str) -> Texture:
        """Return a texture, made and given a material on first use. `name:3` is a variant."""
        if name not in self.textures:
            base, _, variant = name.partition(':')
            made = make_texture(base, self.scene.seed * 100 + int(variant or 0))
            self.textures[name] = made
            self.files[f'{name}.png'] = cv2.imencode('.png', made.pixels)[1].tobytes()
            alpha = GLASS_ALPHA if base == GLASS else 1
            self.assets.append(
                f'<texture name="{name}" type="2d" file="{name}.png"/>'
                f'<material name="{name}" texture="{name}" specular="0" shininess="0" '
                f'rgba="1 1 1 {alpha:g}"/>'
            )
        return self.textures[name]

    def solids(self, prisms: list[Prism], prefix: str) -> list[str]:
        """Add the prisms, one geom per texture, or per texture and class; return the geoms as
        text. The tops of floors are geoms of their own, so that they can be told apart in a
        picture.
        """
        parts: dict[tuple[str, bool, str], list[Mesh]] = {}
        for prism in prisms:
            side_m = self.texture(prism.texture).side_m
            label = prism.label if self.by_class else ''
            upright = parts.setdefault((prism.texture, False, label), [])
            upright.append(sides(prism, side_m))
            top = parts.setdefault((prism.texture, prism.is_floor, label), [])
            top.append(cap(prism, 1, side_m))
            upright.append(cap(prism, -1, side_m))
        return [
            self._geom(f'{prefix}_{index}', texture, merge(meshes), is_floor, label)
            for index, ((texture, is_floor, label), meshes) in enumerate(parts.items())
        ]

    def _geom(self, name: str, texture: str, mesh: Mesh, is_floor: bool, label: str) -> str:
        self.labels[name] = label
        self.assets.append(
            f'<mesh name="{name}" inertia="shell" vertex="{_numbers(mesh.vertices)}" '
            f'normal="{_numbers(mesh.normals)}" texcoord="{_numbers(mesh.uv)}" '
            f'face="{_numbers(mesh.faces)}"/>'
        )
        if is_floor:
            self.floor_geoms.append(name)
        return (
            f'<geom name="{name}" type="mesh" mesh="{name}" material="{texture}" '
            'contype="0" conaffinity="0"/>'
        )


def build_world(scene: Scene, width: int, height: int, by_class: bool = False) -> World:
    """Return the model of a scene for pictures no larger than a size in pixels. by_class: of
    `World`.

    Raises InputError for an unknown texture or furniture.
    """
    world = World(scene, by_class=by_class)
    _add_ground(world)
    world.bodies += world.solids(obstacles(scene), 'solid')
    if scene.slopes or scene.floor_patches:
        world.bodies += world.solids(floors(scene), 'slope')
    _add_movers(world)
    world.xml = _document(world, width, height)
    return world


def mover_bodies(scene: Scene) -> list[list[str]]:
    """Return the names of the movable bodies of each mover, one per part."""
    return [
        [f'mover_{i}_{part}' for part in range(len(part_solids(mover)))]
        for i, mover in enumerate(scene.movers)
    ]


def _add_ground(world: World) -> None:
    floor, ceiling = world.scene.floor, world.scene.ceiling
    world.floor_geoms.append('ground')
    world.labels |= {'ground': 'floor', 'ceiling': 'ceiling'}
    _add_plane(world, 'ground', 0.0, floor.texture, floor.reflectance)
    if ceiling.height_m > 0:
        _add_plane(world, 'ceiling', ceiling.height_m, ceiling.texture, 0.0)


def _add_plane(world: World, name: str, height_m: float, texture: str, reflectance: float) -> None:
    """Add a wide plane at a height; one above the ground looks down."""
    per_metre = 1 / world.texture(texture).side_m
    world.assets.append(
        f'<material name="{name}" texture="{texture}" texuniform="true" specular="0" '
        f'texrepeat="{per_metre} {per_metre}" shininess="0" reflectance="{reflectance}"/>'
    )
    facing = '0 1 0 0' if height_m > 0 else '1 0 0 0'
    world.bodies.append(
        f'<geom class="plane" name="{name}" pos="0 0 {height_m}" quat="{facing}" '
        f'material="{name}"/>'
    )


def _add_movers(world: World) -> None:
    for mover, names in zip(world.scene.movers, mover_bodies(world.scene), strict=True):
        for name, prisms in zip(names, part_solids(mover), strict=True):
            geoms = ''.join(world.solids(prisms, name))
            world.bodies.append(f'<body name="{name}" mocap="true">{geoms}</body>')


def _document(world: World, width: int, height: int) -> str:
    scene, camera = world.scene, world.scene.camera
    diffuse = 1.1 - scene.lighting.ambient
    # MuJoCo's cameras look along -z with y up: half a turn about x from the optical frame.
    cameras = ''.join(
        f'<camera name="{name}" pos="{x} 0 0" quat="0 1 0 0"/>'
        for name, x in zip(CAMERAS, (0.0, camera.baseline_m), strict=True)
    )
    template = Path(__file__).with_name('world.xml').read_text()
    return template.format(
        width=width,
        height=height,
        shadow_px=SHADOW_PX if scene.lighting.sun > 0 else 0,
        assets=''.join(world.assets),
        ambient=_grey(scene.lighting.ambient),
        diffuse=_grey(diffuse),
        fill=_grey(0.8 * diffuse),
        key_light=_from((0.45, 0.6, -0.75), scene.lighting),
        fill_light=_from((-0.7, -0.35, -0.5), scene.lighting),
        sun=_sun(scene.lighting),
        bodies=''.join(world.bodies),
        rig=RIG,
        cameras=cameras,
    )


def _from(direction: tuple[float, float, float], lighting: Lighting) -> str:
    """Return the direction of a light, turned about the vertical."""
    turn = Rotation.from_euler('Z', lighting.turn_deg, degrees=True)
    return _numbers(turn.apply(np.array(direction)))


def _sun(lighting: Lighting) -> str:
    if lighting.sun == 0:
        return ''
    return (
        '<light directional="true" castshadow="true" pos="-4 -3 6" '
        f'dir="{_from((0.55, 0.4, -0.7), lighting)}" '
        f'ambient="0 0 0" diffuse="{_grey(lighting.sun)}" specular="0 0 0"/>'
    )


def _grey(value: float) -> str:
    return f'{value:g} {value:g} {value:g}'


def _numbers(values: Array | np.ndarray) -> str:
    if values.dtype.kind == 'i':
        return ' '.join(map(str, values.ravel().tolist()))
    return ' '.join(f'{value:.6g}' for value in values.ravel().tolist())


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
        self._labels = world.labels
        self.floor_ids = [self.model.geom(name).id for name in world.floor_geoms]

    @cached_property
    def labels(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """The class and the instance of each geom; the last ones are those of nothing."""
        names = [self.model.geom(i).name for i in range(self.model.ngeom)]
        label = [CLASSES.index(self._labels[name]) for name in names]
        owner = {name: i for i, parts in enumerate(self._movers, 1) for name in parts}
        body = [self.model.body(i).name for i in self.model.geom_bodyid]
        instance = [owner.get(name, 0) for name in body]
        return np.array([*label, 255], np.uint8), np.array([*instance, 0], np.uint8)

    def move(self, T_world_left: Array, times_s: Sequence[float]) -> None:
        """Put the rig at a pose of the left optical frame, and each mover where it is at a time."""
        self._place(RIG, T_world_left[:3, 3], quaternion_xyzw(T_world_left[:3, :3]))
        for mover, names, time_s in zip(self._scene.movers, self._movers, times_s, strict=True):
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
        return cv2.cvtColor(self._render(camera).astype(np.float32), cv2.COLOR_RGB2GRAY)

    def depth_m(self, camera: str) -> NDArray[np.float32]:
        """Return the depths (H, W) float32 along the optical axis in metres."""
        self._renderer.enable_depth_rendering()
        depth_m = self._render(camera)
        self._renderer.disable_depth_rendering()
        return depth_m

    def mask(self, camera: str, geoms: list[int]) -> NDArray[np.uint8]:
        """Return the mask (H, W) uint8: 255 where the camera sees one of the geoms, 0 elsewhere."""
        return np.where(np.isin(self.geoms(camera), geoms), 255, 0).astype(np.uint8)

    def geoms(self, camera: str) -> NDArray[np.intp]:
        """Return the geom (H, W) that the camera sees in each pixel, -1 for none."""
        self._renderer.enable_segmentation_rendering()
        ids = self._render(camera)
        self._renderer.disable_segmentation_rendering()
        return np.where(ids[..., 1] == self._geom_type, ids[..., 0], -1).astype(np.intp)

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
    except (ArgumentError, AttributeError, OSError, RuntimeError):
        raise RenderingError(_NO_GL) from None
    return mujoco


def _open_renderer(mujoco: Any, model: Any, width: int, height: int) -> Any:
    try:
        return mujoco.Renderer(model, height, width)
    except (AttributeError, ImportError, OSError, RuntimeError):
        raise RenderingError(_NO_GL) from None


_NO_GL = (
    'no OpenGL library for rendering without a display: on Debian or Ubuntu '
    'apt-get install libegl1 libgl1-mesa-dri libopengl0'
)
