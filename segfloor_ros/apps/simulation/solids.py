"""The solids of a world: upright prisms, from which pictures, floor masks and the true map all
follow, and those of the people and cars that move through it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from segfloor_ros.apps.simulation.scene import (
    Car,
    FloorPatch,
    Furniture,
    Mover,
    MovingBox,
    Person,
    Point,
    Scene,
    Slope,
    Wall,
)
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import Array, make_transform
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from segfloor_ros.core.settings import suggestion

CYLINDER_SIDES = 32
PATCH_THICKNESS_M, POSTER_THICKNESS_M = 0.001, 0.004
POSTER_VARIANTS = 6

SAMPLES_PER_CELL = 5
MARGIN_M = 0.5

MOVING_WITHIN_S = 0.2
"""What changes its place within this time around a moment moves."""

SIDES = (1, -1)

GLASS = 'glass'
"""The texture of what is seen through, and its class."""

CLASSES = ('floor', 'wall', 'ceiling', 'box', 'furniture', 'person', 'car', GLASS)
"""Names of what there is, by the number it has in a label image."""


@dataclass(frozen=True)
class Body:
    """A person of the usual height: the joints, how long the limbs are between them, and how far
    they swing. stride_rad: largest swing of a thigh; with it the length of a step follows, so that
    feet do not slide. knee_rad: bend of the knee while the foot swings forward.
    """

    thigh_m: float = 0.44
    shin_m: float = 0.42
    sole_m: float = 0.02
    shoulder_m: float = 1.42
    stride_rad: float = 0.42
    knee_rad: float = 0.9
    arm_rad: float = 0.45
    elbow_rad: float = 0.35

    @property
    def leg_m(self) -> float:
        """Length of a straight leg without the sole."""
        return self.thigh_m + self.shin_m

    @property
    def hip_m(self) -> float:
        """Height of the hip of someone who stands."""
        return self.leg_m + self.sole_m


BODY = Body()


@dataclass(frozen=True)
class Prism:
    """A solid over a convex footprint (K, 2), counter-clockwise, between the heights bottom_m and
    top_m (K,) of its corners. is_floor: its top can be driven on. is_sheet: a sheet on a wall,
    its picture shown once on each side; no obstacle. smooth: shade the sides as one round surface.
    label: one of `CLASSES`.
    """

    footprint: Array
    bottom_m: Array
    top_m: Array
    texture: str
    is_floor: bool = False
    is_sheet: bool = False
    smooth: bool = False
    label: str = CLASSES[0]


def block(
    at: Point | Array,
    size: tuple[float, float, float],
    texture: str,
    yaw_deg: float = 0.0,
    bottom_m: float = 0.0,
    is_sheet: bool = False,
) -> Prism:
    """Return a box of length, width and height."""
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * size[:2]
    footprint = corners @ _turn(yaw_deg).T + np.array(at)
    return Prism(
        footprint, np.full(4, bottom_m), np.full(4, bottom_m + size[2]), texture, is_sheet=is_sheet
    )


def cylinder(
    at: Point, radius_m: float, height_m: float, texture: str, bottom_m: float = 0.0
) -> Prism:
    """Return an upright cylinder as a prism of many sides."""
    angle = np.arange(CYLINDER_SIDES) * 2 * np.pi / CYLINDER_SIDES
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1) * radius_m + np.array(at)
    bottom = np.full(CYLINDER_SIDES, bottom_m)
    return Prism(circle, bottom, bottom + height_m, texture, smooth=True)


def obstacles(scene: Scene) -> list[Prism]:
    """Return the solids of a scene that stand still and are not floor, sheets on walls included."""
    walls = [prism for wall in scene.walls for prism in _wall(wall)]
    boxes = [block(b.at, b.size, b.texture, b.yaw_deg, b.bottom_m) for b in scene.boxes]
    boxes += [
        cylinder(c.at, c.radius_m, c.height_m, c.texture, c.bottom_m) for c in scene.cylinders
    ]
    furniture = [prism for thing in scene.furniture for prism in _furniture(thing)]
    return [
        *_labelled('wall', walls),
        *_labelled('box', boxes),
        *_labelled('furniture', furniture),
        *_labelled('wall', _posters(scene)),
    ]


def _labelled(label: str, solids: list[Prism]) -> list[Prism]:
    """Return solids of a class; those of glass are glass."""
    return [replace(p, label=GLASS if p.texture == GLASS else label) for p in solids]


def floors(scene: Scene) -> list[Prism]:
    """Return the solids of a scene that are floor, besides the ground plane."""
    return [_slope(slope) for slope in scene.slopes] + [_patch(p) for p in scene.floor_patches]


def _wall(wall: Wall) -> list[Prism]:
    """Return one box per stretch, each long enough to fill the corner."""
    solids = []
    for start, end in _stretches(wall):
        along = np.array(end) - np.array(start)
        length = float(np.hypot(*along))
        middle = (np.array(start) + np.array(end)) / 2
        size = (length + wall.thickness_m, wall.thickness_m, wall.height_m)
        yaw_deg = float(np.degrees(np.arctan2(along[1], along[0])))
        solids.append(block(middle, size, wall.texture, yaw_deg, wall.bottom_m))
    return solids


def _stretches(wall: Wall) -> list[tuple[Point, Point]]:
    points = list(wall.points) + ([wall.points[0]] if wall.closed else [])
    return list(pairwise(points))


def _posters(scene: Scene) -> list[Prism]:
    """Hang sheets at random places on both sides of the walls that want them."""
    rng = np.random.default_rng([scene.seed, 1])
    solids = []
    for wall in scene.walls:
        stretches = _stretches(wall)
        lengths = np.array([np.hypot(b[0] - a[0], b[1] - a[1]) for a, b in stretches])
        for chosen in rng.choice(len(stretches), wall.posters, p=lengths / lengths.sum()):
            (start, end), length = stretches[chosen], lengths[chosen]
            along = (np.array(end) - np.array(start)) / length
            across = np.array([-along[1], along[0]]) * (1 if rng.uniform() < 0.5 else -1)
            wide, tall = rng.uniform(0.3, 0.9), rng.uniform(0.4, 1.1)
            place = rng.uniform(0.5, max(0.6, length - 0.5))
            offset = wall.thickness_m / 2 + POSTER_THICKNESS_M / 2
            at = np.array(start) + along * place + across * offset
            yaw_deg = float(np.degrees(np.arctan2(along[1], along[0])))
            bottom_m = min(rng.uniform(0.2, 1.2), wall.height_m - tall)
            texture = f'poster:{rng.integers(POSTER_VARIANTS)}'
            size = (wide, POSTER_THICKNESS_M, tall)
            solids.append(block(at, size, texture, yaw_deg, bottom_m, is_sheet=True))
    return solids


def _slope(slope: Slope) -> Prism:
    start, end = np.array(slope.start), np.array(slope.end)
    along = end[:2] - start[:2]
    side = np.array([-along[1], along[0]]) / np.hypot(*along) * slope.width_m / 2
    footprint = np.array([start[:2] - side, end[:2] - side, end[:2] + side, start[:2] + side])
    top = np.array([start[2], end[2], end[2], start[2]])
    # Nowhere thinner than a sheet, so that the foot of a ramp is a solid too.
    return Prism(footprint, np.full(4, -0.02), top, slope.texture, is_floor=True)


def _patch(patch: FloorPatch) -> Prism:
    size = (*patch.size, PATCH_THICKNESS_M)
    flat = block(patch.at, size, patch.texture, patch.yaw_deg)
    return Prism(flat.footprint, flat.bottom_m, flat.top_m, flat.texture, is_floor=True)


@cache
def _kinds() -> dict[str, Any]:
    """Return texture and blocks of each kind of furniture."""
    return yaml.safe_load(Path(__file__).with_name('furniture.yaml').read_text())


def _furniture(thing: Furniture) -> list[Prism]:
    kinds = _kinds()
    if thing.kind not in kinds:
        raise InputError(f'unknown furniture {thing.kind}{suggestion(thing.kind, list(kinds))}')
    texture, parts = kinds[thing.kind]['texture'], kinds[thing.kind]['blocks']
    turn, at = _turn(thing.yaw_deg), np.array(thing.at)
    return [
        block(turn @ (x, y) + at, (length, width, height), texture, thing.yaw_deg, bottom)
        for x, y, length, width, height, bottom in parts
    ]


def _turn(yaw_deg: float) -> Array:
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    return np.array([[c, -s], [s, c]])


def floor_height_m(floors: list[Prism], points: Array) -> Array:
    """Return the height (N,) of the floor at points (N, 2): 0, or the highest slope there."""
    heights = np.zeros(len(points))
    for prism in floors:
        inside = inside_footprint(prism, points)
        heights[inside] = np.maximum(heights[inside], _top_at(prism, points[inside]))
    return heights


def inside_footprint(prism: Prism, points: Array) -> NDArray[np.bool_]:
    """Return which points (N, 2) lie in a prism's footprint."""
    corners = prism.footprint
    edges = np.roll(corners, -1, axis=0) - corners
    offsets = points[:, None] - corners[None]
    left_of = edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0] >= -1e-9
    return np.asarray(left_of.all(axis=1))


def true_map(
    scene: Scene, obstacles: list[Prism], floors: list[Prism], start: Array
) -> OccupancyGrid:
    """Return the map: a cell is occupied when a solid in it stands between the step and the robot's
    height above the floor there, free when the rest of it can be reached from `start` (2,).

    Raises InputError when the start is on an obstacle.
    """
    standing = [prism for prism in obstacles if not prism.is_sheet]
    grid = _empty_grid(scene, standing, start)
    blocked = np.zeros(grid.cells.shape, bool)
    for prism in standing:
        rows, columns, hit = _hit_cells(grid, scene, prism, floors)
        blocked[rows, columns] |= hit
    at_start = tuple(grid.cells_of(start))
    if blocked[at_start]:
        raise InputError(f'the path starts on an obstacle, at x {start[0]:g}, y {start[1]:g} m')
    _, labels = cv2.connectedComponents((~blocked).astype(np.uint8), connectivity=4)
    reached = labels == labels[at_start]
    cells = np.full(blocked.shape, UNKNOWN, np.int8)
    cells[blocked], cells[reached] = OCCUPIED, FREE
    return OccupancyGrid(cells, grid.resolution_m, grid.origin_xy_m)


def _empty_grid(scene: Scene, obstacles: list[Prism], start: Array) -> OccupancyGrid:
    """Return a grid around everything, in phase with the outermost corner of the solids."""
    size = scene.resolution_m
    drive = np.vstack([start[None], np.array(scene.path.waypoints)])
    corners = np.vstack([p.footprint for p in obstacles]) if obstacles else drive
    anchor = corners.min(axis=0) - scene.raster_phase * size
    everything = np.vstack([corners, drive])
    low = anchor - np.ceil((anchor - everything.min(axis=0) + MARGIN_M) / size) * size
    columns, rows = np.ceil((everything.max(axis=0) + MARGIN_M - low) / size).astype(int)
    cells = np.full((rows, columns), UNKNOWN, np.int8)
    return OccupancyGrid(cells, size, (float(low[0]), float(low[1])))


def _hit_cells(
    grid: OccupancyGrid, scene: Scene, prism: Prism, floors: list[Prism]
) -> tuple[slice, slice, NDArray[np.bool_]]:
    """Return rows, columns, and in which of their cells a sample point lies in a prism at the
    robot's height.
    """
    corners = grid.cells_of(prism.footprint)
    first, last = corners.min(axis=0), corners.max(axis=0) + 1
    steps = (np.arange(SAMPLES_PER_CELL) + 0.5) / SAMPLES_PER_CELL
    x, y = (
        (np.arange(first[i], last[i])[:, None] + steps).ravel() * grid.resolution_m + origin_m
        for i, origin_m in zip((1, 0), grid.origin_xy_m, strict=True)
    )
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    hit = inside_footprint(prism, points)
    ground_m, top_m = floor_height_m(floors, points[hit]), _top_at(prism, points[hit])
    below = float(prism.bottom_m.min()) < ground_m + scene.robot_height_m
    hit[hit] = below & (top_m > ground_m + scene.step_height_m)
    (rows, columns), each = last - first, SAMPLES_PER_CELL
    cells = np.asarray(hit.reshape(rows, each, columns, each).any(axis=(1, 3)))
    return slice(first[0], last[0]), slice(first[1], last[1]), cells


def _top_at(prism: Prism, points: Array) -> Array:
    """Return the height (N,) of a prism's top, a plane, at points (N, 2)."""
    design = np.column_stack([prism.footprint, np.ones(len(prism.footprint))])
    plane = np.linalg.lstsq(design, prism.top_m, rcond=None)[0]
    return points @ plane[:2] + plane[2]


def part_solids(mover: Mover) -> list[list[Prism]]:
    """Return the solids of each part of a mover, in the frame of the part's joint."""
    if isinstance(mover, Car):
        return [_labelled('car', _car_solids(mover))]
    if isinstance(mover, MovingBox):
        return [_labelled('box', [block((0.0, 0.0), mover.size, mover.texture)])]
    assert isinstance(mover, Person)
    scale, cloth, trousers = mover.height_m / Person.height_m, mover.texture, 'cloth:7'
    torso = [
        block((0.0, 0.0), (0.22, 0.36, 0.54), cloth, bottom_m=0.0),
        cylinder((0.0, 0.0), 0.06, 0.12, 'concrete', 0.54),
        cylinder((0.01, 0.0), 0.1, 0.24, 'concrete', 0.63),
    ]
    thigh = [cylinder((0.0, 0.0), 0.085, BODY.thigh_m + 0.05, trousers, -BODY.thigh_m)]
    shin = [
        cylinder((0.0, 0.0), 0.06, BODY.shin_m + 0.03, trousers, -BODY.shin_m),
        block((0.07, 0.0), (0.27, 0.1, 0.08), 'granite', bottom_m=-BODY.shin_m - BODY.sole_m),
    ]
    upper_arm = [cylinder((0.0, 0.0), 0.055, 0.32, cloth, -0.29)]
    forearm = [cylinder((0.0, 0.0), 0.045, 0.27, 'concrete', -0.26)]
    parts = [torso, *([thigh, shin, upper_arm, forearm] * 2)]
    return [_labelled('person', [_scaled(prism, scale) for prism in part]) for part in parts]


def part_poses(mover: Mover, time_s: float) -> Array:
    """Return where the joint of each part is at a time: T_world_part (P, 4, 4)."""
    walked_m = _walked_m(mover, time_s)
    x, y, yaw = place(mover, time_s)
    T_world_mover = make_transform(Rotation.from_euler('Z', yaw).as_matrix(), np.array([x, y, 0]))
    if not isinstance(mover, Person):
        return T_world_mover[None]
    return T_world_mover @ _limbs(walked_m, mover.height_m / Person.height_m)


def is_moving(mover: Mover, time_s: float) -> bool:
    """Return whether a mover changes its place around a time."""
    before, after = (_walked_m(mover, time_s + d) for d in (-MOVING_WITHIN_S, MOVING_WITHIN_S))
    return before != after


def _limbs(walked_m: float, scale: float) -> Array:
    """Return the joints (9, 4, 4) of someone who has walked so far from standing at the origin.

    The leg on the floor is straight, which gives the height of the hip, and its foot stays where it
    is; the other knee bends, so that its foot clears the floor. Arms swing against the legs.
    """
    step_m = 2 * BODY.leg_m * scale * np.sin(BODY.stride_rad)
    phase = np.pi * walked_m / step_m
    # Whole steps between standing and standing: the swing grows over the first one.
    swing = min(1.0, walked_m / step_m)
    of_leg = swing * np.sin(BODY.stride_rad) * np.arcsin(np.sin(phase)) / (np.pi / 2)
    angles = [float(np.arcsin(of_leg)), -float(np.arcsin(of_leg))]
    dip = BODY.leg_m * (1 - np.cos(angles[0]))
    hip = _joint(0.0, 0.0, BODY.hip_m - dip, 0.0)
    poses = [hip]
    for side, angle, forward in zip(SIDES, angles, (np.cos(phase), -np.cos(phase)), strict=True):
        thigh = hip @ _joint(0.0, 0.1 * side, 0.0, -angle)
        shin = thigh @ _joint(0.0, 0.0, -BODY.thigh_m, swing * BODY.knee_rad * max(0.0, forward))
        reach = -angle / BODY.stride_rad * BODY.arm_rad
        upper_arm = hip @ _joint(0.0, 0.235 * side, BODY.shoulder_m - BODY.hip_m - 0.04, -reach)
        forearm = upper_arm @ _joint(0.0, 0.0, -0.28, -BODY.elbow_rad)
        poses += [thigh, shin, upper_arm, forearm]
    scaled = np.array(poses)
    scaled[:, :3, 3] *= scale
    return scaled


def _joint(x: float, y: float, z: float, pitch_rad: float) -> Array:
    """Return a joint at a place; a positive pitch swings what hangs from it backwards."""
    return make_transform(Rotation.from_euler('Y', pitch_rad).as_matrix(), np.array([x, y, z]))


def _scaled(prism: Prism, scale: float) -> Prism:
    footprint, bottom_m, top_m = (scale * a for a in (prism.footprint, prism.bottom_m, prism.top_m))
    return Prism(footprint, bottom_m, top_m, prism.texture, smooth=prism.smooth)


def _car_solids(car: Car) -> list[Prism]:
    """Return body, cabin and wheels of a car whose middle is over the origin."""
    length, width, height = car.size
    wheels = [
        block((0.3 * length * end, 0.42 * width * side), (0.62, 0.22, 0.6), 'granite')
        for end in SIDES
        for side in SIDES
    ]
    body = block((0.0, 0.0), (length, width, 0.55 * height - 0.2), car.texture, bottom_m=0.2)
    cabin_size = (0.55 * length, 0.88 * width, 0.45 * height)
    cabin = block((-0.06 * length, 0.0), cabin_size, 'panels', bottom_m=0.55 * height)
    return [body, cabin, *wheels]


def _walked_m(mover: Mover, time_s: float) -> float:
    since_s, way_m = max(0.0, time_s - mover.start_s), _lengths_m(mover).sum()
    way_s = way_m / mover.speed_m_s
    ends, rest_s = divmod(since_s, way_s + mover.stays_s)
    stood_s = ends * mover.stays_s + max(0.0, rest_s - way_s)
    walked = (since_s - stood_s) * mover.speed_m_s
    return walked if mover.returns else min(walked, way_m)


def _lengths_m(mover: Mover) -> Array:
    return np.hypot(*np.diff(np.array(mover.points), axis=0).T)


def place(mover: Mover, time_s: float) -> tuple[float, float, float]:
    """Return x, y, yaw at a time, on the way to and fro along the mover's points."""
    walked_m = _walked_m(mover, time_s)
    points, lengths = np.array(mover.points), _lengths_m(mover)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    round_trip = walked_m % (2 * along[-1])
    back = round_trip > along[-1]
    reached = 2 * along[-1] - round_trip if back else round_trip
    stretch = int(np.clip(np.searchsorted(along, reached, side='right') - 1, 0, len(lengths) - 1))
    direction = (points[stretch + 1] - points[stretch]) / lengths[stretch]
    x, y = points[stretch] + direction * (reached - along[stretch])
    heading = -direction if back and not isinstance(mover, MovingBox) else direction
    return float(x), float(y), float(np.arctan2(heading[1], heading[0]))
