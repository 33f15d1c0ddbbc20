"""A scene as a MuJoCo model: textured meshes, floor, lights, the stereo rig, movers."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from segfloor_ros.geometry import Array
from segfloor_ros.simulation.mesh import Mesh, caps, merge, sides
from segfloor_ros.simulation.movers import part_solids
from segfloor_ros.simulation.scene import Lighting, Scene
from segfloor_ros.simulation.solids import Prism, floors, obstacles
from segfloor_ros.simulation.textures import Texture, make_texture

NEAR_M, FAR_M = 0.02, 120.0
GROUND_HALF_M = 60.0
SHADOW_HALF_M, SHADOW_PX = 12, 4096
"""Within so far of the origin the sun casts shadows, of so many pixels across."""
RIG = 'rig'
CAMERAS = ('left', 'right')


@dataclass(frozen=True)
class World:
    """A MuJoCo model as text with its binary files, and the names of the floor's geoms."""

    xml: str
    files: dict[str, bytes]
    floor_geoms: tuple[str, ...]


@dataclass
class WorldBuilder:
    """Collects the parts of the model."""

    scene: Scene
    textures: dict[str, Texture] = field(default_factory=dict)
    assets: list[str] = field(default_factory=list)
    bodies: list[str] = field(default_factory=list)
    files: dict[str, bytes] = field(default_factory=dict)
    floor_geoms: list[str] = field(default_factory=list)

    def texture(self, name: str) -> Texture:
        """Return a texture, made and given a material on first use. `name:3` is a variant."""
        if name not in self.textures:
            base, _, variant = name.partition(':')
            made = make_texture(base, self.scene.seed * 100 + int(variant or 0))
            self.textures[name] = made
            self.files[f'{name}.png'] = cv2.imencode('.png', made.pixels)[1].tobytes()
            self.assets.append(
                f'<texture name="{name}" type="2d" file="{name}.png"/>'
                f'<material name="{name}" texture="{name}" specular="0" shininess="0"/>'
            )
        return self.textures[name]

    def solids(self, prisms: list[Prism], prefix: str) -> list[str]:
        """Add the prisms, one geom per texture; return the geoms as text. The tops of floors are
        geoms of their own, so that they can be told apart in a picture.
        """
        parts: dict[tuple[str, bool], list[Mesh]] = {}
        for prism in prisms:
            side_m = self.texture(prism.texture).side_m
            upright = parts.setdefault((prism.texture, False), [])
            upright.append(sides(prism, side_m))
            upright.append(caps(prism, side_m, top=not prism.is_floor))
            if prism.is_floor:
                top = caps(prism, side_m, bottom=False)
                parts.setdefault((prism.texture, True), []).append(top)
        return [
            self._geom(f'{prefix}_{index}', texture, merge(meshes), is_floor)
            for index, ((texture, is_floor), meshes) in enumerate(parts.items())
        ]

    def _geom(self, name: str, texture: str, mesh: Mesh, is_floor: bool) -> str:
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


def build_world(scene: Scene, width: int, height: int) -> World:
    """Return the model of a scene for pictures no larger than a size in pixels.

    Raises InputError for an unknown texture or furniture.
    """
    builder = WorldBuilder(scene)
    _add_ground(builder)
    builder.bodies += builder.solids(obstacles(scene), 'solid')
    if scene.slopes or scene.floor_patches:
        builder.bodies += builder.solids(floors(scene), 'slope')
    _add_movers(builder)
    return World(_document(builder, width, height), builder.files, tuple(builder.floor_geoms))


def mover_bodies(scene: Scene) -> list[list[str]]:
    """Return the names of the movable bodies of each mover, one per part."""
    return [
        [f'mover_{i}_{part}' for part in range(len(part_solids(mover)))]
        for i, mover in enumerate(scene.movers)
    ]


def _add_ground(builder: WorldBuilder) -> None:
    floor, ceiling = builder.scene.floor, builder.scene.ceiling
    builder.floor_geoms.append('ground')
    _add_plane(builder, 'ground', 0.0, floor.texture, floor.reflectance)
    if ceiling.height_m > 0:
        _add_plane(builder, 'ceiling', ceiling.height_m, ceiling.texture, 0.0)


def _add_plane(
    builder: WorldBuilder, name: str, height_m: float, texture: str, reflectance: float
) -> None:
    """Add a wide plane at a height; one above the ground looks down."""
    per_metre = 1 / builder.texture(texture).side_m
    builder.assets.append(
        f'<material name="{name}" texture="{texture}" texuniform="true" specular="0" '
        f'texrepeat="{per_metre} {per_metre}" shininess="0" reflectance="{reflectance}"/>'
    )
    facing = '0 1 0 0' if height_m > 0 else '1 0 0 0'
    builder.bodies.append(
        f'<geom name="{name}" type="plane" pos="0 0 {height_m}" quat="{facing}" '
        f'size="{GROUND_HALF_M} {GROUND_HALF_M} 1" material="{name}" '
        'contype="0" conaffinity="0"/>'
    )


def _add_movers(builder: WorldBuilder) -> None:
    for mover, names in zip(builder.scene.movers, mover_bodies(builder.scene), strict=True):
        for name, prisms in zip(names, part_solids(mover), strict=True):
            geoms = ''.join(builder.solids(prisms, name))
            builder.bodies.append(f'<body name="{name}" mocap="true">{geoms}</body>')


def _document(builder: WorldBuilder, width: int, height: int) -> str:
    scene, camera = builder.scene, builder.scene.camera
    diffuse = 1.1 - scene.lighting.ambient
    # MuJoCo's cameras look along -z with y up: half a turn about x from the optical frame.
    cameras = ''.join(
        f'<camera name="{name}" pos="{x} 0 0" quat="0 1 0 0"/>'
        for name, x in zip(CAMERAS, (0.0, camera.baseline_m), strict=True)
    )
    return f"""
<mujoco>
  <statistic extent="1" center="0 0 1"/>
  <visual>
    <global offwidth="{width}" offheight="{height}"/>
    <map znear="{NEAR_M}" zfar="{FAR_M}" shadowclip="{SHADOW_HALF_M}"/>
    <quality offsamples="4" shadowsize="{SHADOW_PX if scene.lighting.sun > 0 else 0}"/>
    <headlight active="0"/>
  </visual>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1=".75 .75 .75" rgb2=".6 .6 .6"
             width="64" height="64"/>
    {''.join(builder.assets)}
  </asset>
  <worldbody>
    <light directional="true" castshadow="false" pos="0 0 2" dir="0.45 0.6 -0.75"
           ambient="{_grey(scene.lighting.ambient)}" diffuse="{_grey(diffuse)}" specular="0 0 0"/>
    <light directional="true" castshadow="false" pos="0 0 2" dir="-0.7 -0.35 -0.5"
           ambient="0 0 0" diffuse="{_grey(0.8 * diffuse)}" specular="0 0 0"/>
    <light directional="true" castshadow="false" pos="0 0 1" dir="0 0 1"
           ambient="0 0 0" diffuse="{_grey(0.8 * diffuse)}" specular="0 0 0"/>
    {_sun(scene.lighting)}
    {''.join(builder.bodies)}
    <body name="{RIG}" mocap="true">{cameras}</body>
  </worldbody>
</mujoco>"""


def _sun(lighting: Lighting) -> str:
    if lighting.sun == 0:
        return ''
    return (
        '<light directional="true" castshadow="true" pos="-4 -3 6" dir="0.55 0.4 -0.7" '
        f'ambient="0 0 0" diffuse="{_grey(lighting.sun)}" specular="0 0 0"/>'
    )


def _grey(value: float) -> str:
    return f'{value:g} {value:g} {value:g}'


def _numbers(values: Array | np.ndarray) -> str:
    if values.dtype.kind == 'i':
        return ' '.join(map(str, values.ravel().tolist()))
    return ' '.join(f'{value:.6g}' for value in values.ravel().tolist())
