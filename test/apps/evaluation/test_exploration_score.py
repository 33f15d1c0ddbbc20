"""Figures of an exploration, worked out by hand, in a map whose frame lies elsewhere and turned."""

import numpy as np
import pytest

from segfloor_ros.apps.evaluation.exploration import (
    FILM_FRAMES,
    Exploration,
    Moment,
    figures,
    picture,
    reachable_floor,
)
from segfloor_ros.apps.evaluation.maps import from_frame
from segfloor_ros.apps.navigation import Goal
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.images import decode_colour
from segfloor_ros.core.geometry import Array, make_transform
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, OccupancyGrid

START = (3.0, 1.0, np.pi / 2)


def two_rooms() -> OccupancyGrid:
    """Two rooms of 3 m x 2 m side by side without a door, the outer corner of all at (2, -0.5)."""
    cells = np.full((22, 62), FREE, np.int8)
    cells[[0, -1]] = cells[:, [0, 31, -1]] = OCCUPIED
    return OccupancyGrid(cells, 0.1, (2.0, -0.5))


def pose(x: float, y: float, yaw: float = 0.0) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return make_transform(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array([x, y, 0.0]))


def test_only_the_room_of_the_start_can_be_reached() -> None:
    floor = reachable_floor(two_rooms(), 0.2, START)
    assert not floor[:, 31:].any()
    assert floor[5:-5, 5:26].all()
    there = reachable_floor(two_rooms(), 0.2, (7.0, 1.0, 0.0))
    assert there[5:-5, 36:-5].all() and not there[:, :32].any()


def test_a_robot_that_is_too_large_for_where_it_starts_is_refused() -> None:
    with pytest.raises(InputError, match=r'turns within 1\.20 m'):
        reachable_floor(two_rooms(), 1.2, START)


def test_goals_and_path_are_where_the_frame_of_the_map_lies() -> None:
    # In the map ahead is +x; in the scene the robot looks along +y.
    in_map = np.array([[0.0, 0.0], [0.3, 0.0], [0.4, -0.5]])
    in_scene = from_frame(in_map, START)
    stamps = [0, 10**9, 2 * 10**9]
    poses = {t: pose(*xy) for t, xy in zip(stamps, in_map, strict=True)}
    true = {t: pose(*xy) for t, xy in zip(stamps, in_scene, strict=True)}
    reached = Goal(in_map[2], is_reached=True)
    # A command takes effect one frame after it is given.
    goals = [(reached, t) for t in stamps]
    grid = OccupancyGrid(np.full((10, 10), FREE, np.int8), 0.1, (-0.5, -0.5))
    found = Exploration(START, poses, true, [Moment(2 * 10**9, grid, None)], [], goals, 4.0)
    told = figures(found, two_rooms(), 0.2)
    assert (told['goals_reached'], told['goals_total']) == (2, 3)
    assert told['path_rmse_m'] == pytest.approx(0.0, abs=1e-4)
    assert told['path_m'] == pytest.approx(0.3 + np.hypot(0.1, 0.5), abs=0.01)
    assert told['real_time_factor'] == pytest.approx(0.5)
    found.poses.clear()
    never_found = figures(found, two_rooms(), 0.2)
    assert (never_found['path_rmse_m'], never_found['tracked_share']) == (None, 0.0)


@pytest.mark.slow
def test_the_picture_has_a_strip_of_what_was_seen_below_the_map() -> None:
    grid = OccupancyGrid(np.full((10, 10), FREE, np.int8), 0.1, (-0.5, -0.5))
    stamps = [10**9 * i for i in range(20)]
    found = Exploration(START, {}, {t: pose(*START) for t in stamps})
    found.take(Moment(stamps[-1], grid, None))
    bare = decode_colour(picture(found, two_rooms()), 'bare')
    images = [np.full((60, 80), 10 * i, np.uint8) for i in range(20)]
    found.moments = [Moment(t, grid, image) for t, image in zip(stamps, images, strict=True)]
    drawn = decode_colour(picture(found, two_rooms()), 'drawn')
    np.testing.assert_array_equal(drawn[: len(bare)], bare)
    strip = drawn[len(bare) :]
    width = bare.shape[1] // 4
    assert strip.shape[0] == 2 * (width * 60 // 80)
    levels = [
        int(row[10, width * i + width // 2, 0]) for row in np.split(strip, 2) for i in range(4)
    ]
    assert levels == sorted(levels) and (levels[0], levels[-1]) == (0, 190)


def test_of_a_long_exploration_moments_are_kept_evenly_and_the_newest() -> None:
    found, count = Exploration(START), 0
    for count in range(1, 1001):
        grid = OccupancyGrid(np.full((1, 1), FREE, np.int8), 0.1, (0.0, 0.0))
        found.take(Moment(count, grid, None))
        assert found.moments[-1].stamp_ns == count
        assert min(count, FILM_FRAMES) <= len(found.moments) <= 2 * FILM_FRAMES
    kept = [moment.stamp_ns for moment in found.moments]
    assert kept[0] == 1
    assert len(np.unique(np.diff(kept[:-1]))) == 1
