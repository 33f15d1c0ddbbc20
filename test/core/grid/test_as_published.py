"""The published mapper on cases worked out by hand: rays, layers, outliers and limits."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import path_of

from segfloor_ros.core.contracts import (
    POINT_FLOOR,
    POINT_OBSTACLE,
    FloorScan,
    KeyframeFeatures,
    LabelledPoints,
)
from segfloor_ros.core.grid.as_published import PublishedMapper
from segfloor_ros.core.grid.mapper import OccupancyGridMapper, make_mapper
from segfloor_ros.core.grid.occupancy import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    OccupancyGridSettings,
)

NO_SCAN = FloorScan(0.0, 0.1, np.zeros(0, np.float32))
NAN = np.full(3, np.nan, np.float32)


def cloud(*points: tuple[float, float, float, int]) -> LabelledPoints:
    """Return points (x, y, z, label) with the ids 0, 1, 2…"""
    table = np.array(points).reshape(-1, 4)
    xyz, label = table[:, :3].astype(np.float32), table[:, 3].astype(np.uint8)
    ids = np.arange(len(table), dtype=np.int32)
    return LabelledPoints(ids, xyz, label, np.ones(len(table), np.float32))


def looks_at(*ids: int) -> KeyframeFeatures:
    count = len(ids)
    return KeyframeFeatures(
        np.zeros((count, 2), np.float32), np.array(ids, np.int32), np.tile(NAN, (count, 1))
    )


def mapped(
    points: LabelledPoints,
    *drive: tuple[tuple[float, float, float], KeyframeFeatures],
    **settings: float,
) -> OccupancyGrid:
    """Return the map of keyframes at poses (x, y, yaw) that see some of the points."""
    mapper = make_mapper(OccupancyGridSettings(as_published=True, resolution_m=0.1, **settings))
    poses = [pose for pose, _ in drive]
    for k, (_, features) in enumerate(drive):
        path = path_of(poses[: k + 1])
        mapper.update(int(path.stamp_ns[-1]), points, features, path, NO_SCAN)
    return mapper.grid()


def at(grid: OccupancyGrid, *points: tuple[float, float]) -> list[int]:
    return [int(grid.cells[tuple(grid.cells_of(np.array(point)))]) for point in points]


def test_the_setting_chooses_the_mapper() -> None:
    assert type(make_mapper(OccupancyGridSettings())) is OccupancyGridMapper
    assert type(make_mapper(OccupancyGridSettings(as_published=True))) is PublishedMapper


def test_rays_go_to_floor_points_that_the_keyframe_sees_and_obstacles_only_mark() -> None:
    points = cloud(
        (1.05, 0.05, 0.0, POINT_FLOOR),
        (0.05, 1.05, 0.0, POINT_FLOOR),  # of another keyframe
        (0.55, 0.45, 0.4, POINT_OBSTACLE),  # is seen
        (0.55, -0.45, 2.4, POINT_OBSTACLE),  # is not seen now, and hangs high: no height limit
    )
    grid = mapped(points, ((0.05, 0.05, 0.0), looks_at(0, 2)))
    assert at(grid, (0.05, 0.05), (0.55, 0.05), (1.05, 0.05)) == [FREE] * 3
    assert at(grid, (0.05, 1.05), (0.25, 0.25), (0.55, 0.55)) == [UNKNOWN] * 3
    assert at(grid, (0.55, 0.45), (0.55, -0.45)) == [OCCUPIED] * 2
    assert (grid.cells == FREE).sum() == 11  # a line of 1-cell width


def test_an_obstacle_on_a_ray_stays_and_does_not_end_it() -> None:
    points = cloud((1.05, 0.05, 0.0, POINT_FLOOR), (0.55, 0.05, 0.1, POINT_OBSTACLE))
    grid = mapped(points, ((0.05, 0.05, 0.0), looks_at(0)))
    assert at(grid, (0.45, 0.05), (0.55, 0.05), (0.65, 0.05)) == [FREE, OCCUPIED, FREE]


def test_a_ray_beyond_the_third_quartile_and_a_half_is_dropped() -> None:
    """Nine rays of 1 m and one of 4: mean 1.3, sigma 0.9, Q3 1.907, IQR 1.214, limit 3.73 m. Rays
    of 1, 2, 3 and 4 m: mean 2.5, sigma 1.118, limit 5.52 m.
    """
    pose = (0.05, 0.05, 0.0)
    lengths_m = [1.0] * 9 + [4.0]
    one_far = cloud(*((0.05 + length, 0.05, 0.0, POINT_FLOOR) for length in lengths_m))
    assert (mapped(one_far, (pose, looks_at(*range(10)))).cells == FREE).sum() == 11
    spread = cloud(*((0.05 + length, 0.05, 0.0, POINT_FLOOR) for length in (1.0, 2.0, 3.0, 4.0)))
    assert (mapped(spread, (pose, looks_at(*range(4)))).cells == FREE).sum() == 41


def test_a_longer_ray_than_allowed_ends_there() -> None:
    points = cloud((2.05, 0.05, 0.0, POINT_FLOOR))
    grid = mapped(points, ((0.05, 0.05, 0.0), looks_at(0)), max_range_m=1.0)
    assert at(grid, (0.95, 0.05)) == [FREE]
    assert (grid.cells == FREE).sum() == 11


def test_an_opening_removes_lone_rays() -> None:
    points = cloud((1.05, 0.05, 0.0, POINT_FLOOR), (0.55, 0.45, 0.4, POINT_OBSTACLE))
    grid = mapped(points, ((0.05, 0.05, 0.0), looks_at(0)), opening_cells=3)
    assert not (grid.cells == FREE).any()
    assert at(grid, (0.55, 0.45)) == [OCCUPIED]


def test_rays_follow_their_keyframe_and_obstacles_their_points() -> None:
    before = cloud((1.05, 0.05, 0.0, POINT_FLOOR), (0.55, 0.45, 0.4, POINT_OBSTACLE))
    after = cloud((1.05, 1.05, 0.0, POINT_FLOOR), (0.55, 1.45, 0.4, POINT_OBSTACLE))
    mapper = make_mapper(OccupancyGridSettings(as_published=True, resolution_m=0.1))
    path = path_of([(0.05, 0.05, 0.0)])
    mapper.update(int(path.stamp_ns[0]), before, looks_at(0), path, NO_SCAN)
    moved = path_of([(0.05, 1.05, 0.0), (0.05, 1.05, 0.0)])
    mapper.update(int(moved.stamp_ns[1]), after, looks_at(), moved, NO_SCAN)
    grid = mapper.grid()
    assert at(grid, (0.55, 1.05), (0.55, 1.45)) == [FREE, OCCUPIED]
    assert at(grid, (0.55, 0.45)) == [UNKNOWN]
    again = make_mapper(OccupancyGridSettings(as_published=True, resolution_m=0.1))
    again.from_arrays(mapper.to_arrays(), moved.stamp_ns)
    np.testing.assert_array_equal(again.grid().cells, grid.cells)


@pytest.mark.parametrize('seen', [(), (0,)])
def test_a_keyframe_without_floor_adds_no_free_cell(seen: tuple[int, ...]) -> None:
    points = cloud((0.55, 0.45, 0.4, POINT_OBSTACLE))
    grid = mapped(points, ((0.0, 0.0, 0.0), looks_at(*seen)))
    assert not (grid.cells == FREE).any()
