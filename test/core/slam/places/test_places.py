"""Places that are seen again: what covers a view by hand-made cameras, and laps of a room."""

import numpy as np
import pytest
from hand_made_maps import WALL, row_of_views
from scipy import sparse
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.contracts import NO_POINT
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.plugins.maps.pruning import views_to_keep
from segfloor_ros.core.slam.places.views import (
    SECOND_VISIT,
    covered_share,
    view_novelty,
    views_near,
)
from segfloor_ros.core.slam.rig import NEIGHBOURS
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.twists import se3_exp

HERE = np.eye(4)

RNG = np.random.default_rng(6)
FLOOR = np.stack([RNG.uniform(-1, 1, 10), np.full(10, 0.5), RNG.uniform(4, 6, 10)], axis=1)
"""Ten points of a floor, some 5 m away."""

SCENES = [(2.0, WALL), (5.0, FLOOR)]


def turned(angle_rad):
    return se3_exp(np.array([0.0, 0.0, 0.0, 0.0, angle_rad, 0.0]))


def test_a_view_covers_itself_and_half_of_one_turned_by_half_the_field_of_view():
    assert covered_share(CAMERA, [HERE], HERE, 2.0) == 1.0
    half_fov = np.arctan(CAMERA.width / 2 / CAMERA.fx)
    assert covered_share(CAMERA, [turned(half_fov)], HERE, 2.0) == pytest.approx(0.5, abs=0.1)
    assert covered_share(CAMERA, [turned(np.pi)], HERE, 2.0) == 0.0
    both = [turned(half_fov), turned(-half_fov)]
    assert covered_share(CAMERA, both, HERE, 2.0) > 0.85  # corners lean out of turned images


def camera_at(x):
    return se3_exp(np.array([-x, 0.0, 0.0, 0.0, 0.0, 0.0]))


def test_near_views_come_nearest_first_and_not_beyond_reach():
    sparse_map = row_of_views(8, list(range(10)), 0.3)
    np.testing.assert_array_equal(views_near(sparse_map, camera_at(0.62), 2.0, 3), [2, 3, 1])
    # Half the depth of 2 m is 1 m: the keyframes at 1.8 and 2.1 m are out of reach.
    near = views_near(sparse_map, camera_at(0.62), 2.0, 99)
    np.testing.assert_array_equal(np.sort(near), [0, 1, 2, 3, 4, 5])
    assert len(views_near(sparse_map, turned(2.0), 2.0, 99)) == 0


def kept_of(x_m, is_alive=True, shared=None):
    """Return which of the views at some places of a corridor, one after the other, stay, and what
    stands for each. What they see is 2 m away: a view is new after 8 cm.
    """
    poses = np.array([camera_at(x) for x in x_m])
    alive = np.broadcast_to(is_alive, len(poses))
    shared = None if shared is None else sparse.csr_array(shared)
    stands_in = views_to_keep(poses, np.full(len(poses), 2.0), alive, shared)
    return np.flatnonzero(stands_in == np.arange(len(poses))).tolist(), stands_in


def test_views_of_one_visit_stay_and_those_that_a_later_one_shows_again_go():
    there = np.arange(0.0, 3.0, 0.1)
    every, _ = kept_of(there)
    assert every == list(range(30))
    back = there[::-1][:20] - 0.03
    kept, stands_in = kept_of([*there, *back])
    # It came back to 0.97 m; what is within 24 cm of the turn is one visit.
    assert kept == [*range(8), *range(27, 50)]
    assert stands_in[15] == 44  # at 1.5 m and 1.47 m


def test_views_do_not_grow_with_the_visits():
    there = np.arange(0.0, 3.0, 0.1)
    laps = [np.concatenate([there, there[::-1]]) + 0.004 * k for k in range(6)]
    counts = [len(kept_of(np.concatenate(laps[:k]))[0]) for k in (1, 2, 6)]
    assert counts[2] < 1.15 * counts[0]
    assert counts[2] - counts[1] <= 2


@pytest.mark.parametrize(
    ('share', 'visits', 'expected'),
    [(0.3, 3, [0, 1, 2]), (0.3, 9, [6, 7, 8]), (0.6, 5, [2, 3, 4]), (0.6, 4, [1, 2, 3])],
    ids=['three lights', 'day after day', 'much the same', 'once more'],
)
def test_the_views_of_each_light_stay(share, visits, expected):
    """The light is that of every third visit, in which views share so many of their points."""
    there = np.arange(0.0, 3.0, 0.1)
    light = np.repeat(np.arange(visits) % 3, len(there))
    shared = np.where(light[:, None] == light, share, 0.1)
    kept, _ = kept_of(np.tile(there, visits), shared=shared)
    of_visit = np.bincount(np.array(kept) // len(there), minlength=visits)
    # The first view of all always stays.
    assert np.flatnonzero(of_visit > 1).tolist() == expected
    assert (of_visit[expected] > 25).all()


def test_a_rare_light_stays_when_the_usual_one_comes_again():
    there = np.arange(0.0, 3.0, 0.1)
    is_rare = np.repeat(np.arange(7) == 1, len(there))
    shared = np.where(is_rare[:, None] == is_rare, 0.3, 0.05)
    kept, _ = kept_of(np.tile(there, 7), shared=shared)
    assert np.bincount(np.array(kept) // len(there))[[1, 5, 6]].min() > 25


def test_a_view_without_points_stands_for_none():
    there = np.arange(0.0, 3.0, 0.1)
    alive = np.arange(60) < 30
    kept, _ = kept_of([*there, *there], alive)
    assert kept == list(range(60))


@pytest.mark.parametrize(('depth_m', 'xyz'), SCENES)
def test_views_of_an_earlier_visit_count_from_three_times_as_far(depth_m, xyz):
    ids = np.arange(10, dtype=np.int32)
    sparse_map = row_of_views(NEIGHBOURS + 5, list(range(10)), 0.01 * depth_m, xyz)
    # 0.12 m beside keyframe 0 at a depth of 2 m is 1.5 times what makes a view new.
    beside = camera_at(-0.06 * depth_m)
    new = view_novelty(sparse_map, ids, beside, depth_m)
    assert new == pytest.approx(0.5)
    # Points that the earlier views did not see, or a view that looks past them, are new.
    unknown = sparse_map_without(sparse_map, range(5))
    assert view_novelty(unknown, ids, beside, depth_m) > 1.5
    turned_off = turned(0.17) @ camera_at(-0.01 * depth_m)
    assert view_novelty(sparse_map, ids, turned_off, depth_m) > 1.5


@pytest.mark.parametrize(('depth_m', 'xyz'), SCENES)
def test_a_known_place_is_looked_at_again_now_and_then(depth_m, xyz):
    ids = np.arange(10, dtype=np.int32)
    sparse_map = row_of_views(NEIGHBOURS + 5, list(range(10)), 0.1 * depth_m, xyz)
    # The nearest of the latest keyframes stands at half the depth, 12.5 times as far as a new view.
    new = view_novelty(sparse_map, ids, camera_at(0.0), depth_m)
    assert new == pytest.approx(12.5 / (2 * SECOND_VISIT))


@pytest.mark.parametrize('is_retired', [False, True])
def test_every_visit_that_made_a_keyframe_doubles_the_way_to_the_next(is_retired):
    depth_m, ids = 2.0, np.arange(10, dtype=np.int32)
    sparse_map = row_of_views(NEIGHBOURS + 15, list(range(10)), 0.1 * depth_m)
    nearest = 15 * 0.1 / 0.04
    first = view_novelty(sparse_map, ids, camera_at(0.0), depth_m)
    assert first == pytest.approx(nearest / (2 * SECOND_VISIT))
    for visits, index in ((2, 6), (3, 9)):
        again = sparse_map.keyframes[index]
        again.T_camera_world = camera_at(0.01 * depth_m)
        if is_retired:
            sparse_map.retire(again, sparse_map.keyframes[0])
        new = view_novelty(sparse_map, ids, camera_at(0.0), depth_m)
        assert new == pytest.approx(nearest / (SECOND_VISIT * 2**visits))


def sparse_map_without(sparse_map, views):
    for index in views:
        view = sparse_map.keyframes[index]
        sparse_map.unlink(view.index, np.flatnonzero(view.point_id != NO_POINT))
    return sparse_map


@pytest.mark.slow
def test_laps_of_a_room_add_no_points_after_the_second():
    room = StereoRoom()
    slam = equipped_slam(CAMERA, StereoSlamSettings(num_features=500), MOUNT)
    rng = np.random.default_rng(2)
    per_lap, size, error_m = 20, [], []
    for k in range(3 * per_lap):
        angle = 2 * np.pi * k / per_lap
        # Never quite the same way: some centimetres beside it.
        x, y = 0.4 * np.sin(angle) + rng.normal(scale=0.01), 0.1 * np.cos(angle)
        truth = planar_pose(x, y, 0.15 * np.sin(angle))
        if k == 0:
            start = truth
        result = slam.process(room.frame(k, truth))[0]
        assert result.tracked
        T_map_base = result.T_map_odom @ result.T_odom_base
        error_m.append(np.linalg.norm((np.linalg.inv(start) @ truth - T_map_base)[:3, 3]))
        if k % per_lap == per_lap - 1:
            size.append((len(slam.map.keyframes), int(slam.map.alive.sum())))
    keyframes, points = np.array(size).T
    assert keyframes[2] <= keyframes[1] + 1
    assert points[2] <= 1.03 * points[1]
    assert max(error_m[-per_lap:]) < 1.5 * max(error_m[:per_lap]) + 0.002
