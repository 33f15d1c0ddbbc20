"""Flat worlds of discs and walls, seen by an ideal floor scan."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from segfloor_ros.core.contracts import FloorScan, KeyframeFeatures, KeyframePath, LabelledPoints
from segfloor_ros.core.grid.mapper import OccupancyGridMapper
from segfloor_ros.core.grid.occupancy import OccupancyGrid

FIELD_OF_VIEW_RAD = np.pi / 2
SIGHT_M = 8.0
RANGE_MAX_M = 10.0
"""Where the error is 0.3 m: 3 mm at one metre."""


@dataclass(frozen=True)
class World:
    """discs: (x, y, radius); walls: (x1, y1, x2, y2), in metres in frame `map`."""

    discs: tuple[tuple[float, float, float], ...] = ()
    walls: tuple[tuple[float, float, float, float], ...] = ()

    def distance_m(self, x: float, y: float, bearing: np.ndarray) -> np.ndarray:
        """Return the distance to the nearest thing on each bearing (N,), infinite where none."""
        direction = np.stack([np.cos(bearing), np.sin(bearing)], 1)
        nearest = np.full(len(bearing), np.inf)
        for cx, cy, radius in self.discs:
            along = direction @ [cx - x, cy - y]
            beside = direction @ [-(cy - y), cx - x]
            inside = (np.abs(beside) < radius) & (along > 0)
            depth = along - np.sqrt(np.where(inside, radius**2 - beside**2, 0))
            nearest = np.where(inside, np.minimum(nearest, depth), nearest)
        for x1, y1, x2, y2 in self.walls:
            wall = np.array([x2 - x1, y2 - y1])
            start = np.array([x1 - x, y1 - y])
            cross = direction[:, 0] * wall[1] - direction[:, 1] * wall[0]
            with np.errstate(divide='ignore', invalid='ignore'):
                depth = (start[0] * wall[1] - start[1] * wall[0]) / cross
                share = (start[0] * direction[:, 1] - start[1] * direction[:, 0]) / cross
            hit = (depth > 0) & (share >= 0) & (share <= 1)
            nearest = np.where(hit, np.minimum(nearest, depth), nearest)
        return nearest


@dataclass
class Drive:
    """Feeds a mapper keyframe by keyframe from poses (x, y, yaw) in worlds."""

    mapper: OccupancyGridMapper
    noise: np.random.Generator = field(default_factory=lambda: np.random.default_rng(7))
    error_per_m: float = 0.002
    miss_share: float = 0.0
    leak_share: float = 0.0
    movable: World | None = None
    poses: list[tuple[float, float, float]] = field(default_factory=list)

    def scan(self, world: World, pose: tuple[float, float, float]) -> FloorScan:
        step = np.deg2rad(0.5)
        count = round(FIELD_OF_VIEW_RAD / step) + 1
        bearing = -FIELD_OF_VIEW_RAD / 2 + step * np.arange(count)
        depth = world.distance_m(pose[0], pose[1], pose[2] + bearing)
        sigma = self.error_per_m * np.where(np.isfinite(depth), depth, 0) ** 2
        seen = depth + self.noise.normal(0, 1, count) * sigma
        seen[self.noise.random(count) < self.miss_share] = np.inf
        leaks = self.noise.random(count) < self.leak_share
        floor = np.minimum(np.where(leaks, seen + 1.5, seen), SIGHT_M)
        obstacle = np.where(leaks | (seen > SIGHT_M), np.nan, seen)
        movable = None
        if self.movable is not None:
            ends = self.movable.distance_m(pose[0], pose[1], pose[2] + bearing)
            hides = ends < floor
            # The end of floor that fades out is less certain than that at an obstacle.
            floor = np.minimum(floor, ends - 0.1)
            obstacle = np.where(hides, np.nan, obstacle)
            movable = np.where(hides, ends, np.nan).astype(np.float32)
        return FloorScan(
            -FIELD_OF_VIEW_RAD / 2,
            step,
            floor.astype(np.float32),
            obstacle.astype(np.float32),
            RANGE_MAX_M,
            movable,
        )

    def look(
        self, world: World, pose: tuple[float, float, float], points: LabelledPoints | None = None
    ) -> None:
        """Take one keyframe from a pose; every point of `points` is seen."""
        self.poses.append(pose)
        points = points or no_points()
        features = KeyframeFeatures(
            np.zeros((len(points.point_id), 2), np.float32), points.point_id, points.xyz_map
        )
        path = path_of(self.poses)
        self.mapper.update(int(path.stamp_ns[-1]), points, features, path, self.scan(world, pose))

    def grid(self) -> OccupancyGrid:
        return self.mapper.grid()


def path_of(poses: list[tuple[float, float, float]]) -> KeyframePath:
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    x, y, yaw = np.array(poses).T
    T[:, 0, 0], T[:, 0, 1] = np.cos(yaw), -np.sin(yaw)
    T[:, 1, 0], T[:, 1, 1] = np.sin(yaw), np.cos(yaw)
    T[:, 0, 3], T[:, 1, 3] = x, y
    return KeyframePath(np.arange(len(poses), dtype=np.int64) * 400_000_000, T)


def no_points() -> LabelledPoints:
    return LabelledPoints(
        np.zeros(0, np.int32),
        np.zeros((0, 3), np.float32),
        np.zeros(0, np.uint8),
        np.zeros(0, np.float32),
    )


def cells_at(grid: OccupancyGrid, xy: np.ndarray) -> np.ndarray:
    """Return the cells at positions (N, 2), -1 outside of the grid."""
    index = np.floor((np.asarray(xy) - grid.origin_xy_m) / grid.resolution_m).astype(int)
    rows, columns = grid.cells.shape
    inside = (index >= 0).all(1) & (index[:, 0] < columns) & (index[:, 1] < rows)
    index = np.where(inside[:, None], index, 0)
    return np.where(inside, grid.cells[index[:, 1], index[:, 0]], -1)


def centres(x: tuple[float, float], y: tuple[float, float], step: float = 0.05) -> np.ndarray:
    """Return positions (N, 2) on a raster of cell centres in a box."""
    xs, ys = np.arange(x[0] + step / 2, x[1], step), np.arange(y[0] + step / 2, y[1], step)
    return np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)


@pytest.fixture
def make_drive() -> Callable[..., Drive]:
    """Build a drive: `make_drive(settings, **drive_options)`."""

    def build(settings: object, **options: object) -> Drive:
        return Drive(OccupancyGridMapper(settings), **options)  # type: ignore[arg-type]

    return build
