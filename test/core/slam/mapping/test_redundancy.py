"""Redundant keyframes on hand-made maps, and on a drive to and fro."""

import numpy as np
import pytest
from hand_made_maps import add, keyframe
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.contracts import NO_POINT, StereoFrame
from segfloor_ros.core.geometry import make_transform
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.slam.mapping.keyframe_mapping import redundant_share, retire_redundant
from segfloor_ros.core.slam.rig import Rig
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.sparse_map import SparseMap


def views(*point_ids):
    """A map of ten points at z = 2 and a view of some of them per argument, 10 cm apart."""
    sparse_map = SparseMap(Rig(CAMERA))
    xyz = np.stack([np.arange(10.0), np.zeros(10), np.full(10, 2.0)], axis=1)
    first = keyframe(0, [NO_POINT] * 10)
    add(sparse_map, first, np.arange(10), xyz)
    for index, ids in enumerate(point_ids, 1):
        add(sparse_map, keyframe(index, ids, x=0.1 * index))
    return sparse_map


ALL = list(range(10))


def test_the_share_counts_points_with_three_other_observers():
    sparse_map = views(ALL, ALL[:6], ALL[:4])
    # Keyframes 0, 1, 2 and 3 see points 0 to 3; 4 and 5 have two others, the rest one.
    assert redundant_share(sparse_map, sparse_map.keyframes[1]) == pytest.approx(0.4)
    assert redundant_share(sparse_map, sparse_map.keyframes[3]) == 1.0


def test_coarser_views_do_not_make_one_redundant():
    sparse_map = views(ALL, ALL, ALL)
    sparse_map.keyframes[2].features.octave[:] = 2
    assert redundant_share(sparse_map, sparse_map.keyframes[1]) == 0.0
    assert redundant_share(sparse_map, sparse_map.keyframes[2]) == 1.0


def test_the_first_and_the_latest_are_kept():
    sparse_map = views(*[ALL] * 8)
    retire_redundant(sparse_map, np.arange(9))
    retired = [k.index for k in sparse_map.keyframes if k.retired]
    # Every point must keep three observers besides the one in question.
    assert retired == [1, 2, 3, 4, 5]
    np.testing.assert_array_equal(sparse_map.observer_count, [4] * 10)
    assert sparse_map.alive.all()


def test_a_retired_keyframe_keeps_its_place_beside_the_one_it_follows():
    sparse_map = views(*[ALL] * 8)
    one, two, four = (sparse_map.keyframes[k] for k in (1, 2, 4))
    sparse_map.retire(one, two)
    sparse_map.retire(two, four)
    four.T_camera_world = make_transform(np.eye(3), np.array([0.0, 0.0, -5.0])) @ (
        four.T_camera_world
    )
    sparse_map.follow()
    np.testing.assert_allclose(two.T_world_camera[:3, 3], [0.2, 0.0, 5.0], atol=1e-12)
    np.testing.assert_allclose(one.T_world_camera[:3, 3], [0.1, 0.0, 5.0], atol=1e-12)
    assert len(one.octave) == len(one.observations) == len(one.point_id) == 0
    order, _ = sparse_map.covisible(np.arange(10))
    assert 1 not in order and 2 not in order


@pytest.mark.parametrize(
    ('seed', 'contrast', 'turn_rad'),
    [pytest.param(0, 60.0, 0.0, marks=pytest.mark.slow), (9, 35.0, 0.02)],
)
def test_driving_to_and_fro_makes_its_views_once(seed, contrast, turn_rad):
    room = StereoRoom(seed, contrast)
    x = np.concatenate([np.arange(0, 10), np.arange(10, 0, -1)])
    images = {}
    slam = equipped_slam(CAMERA, StereoSlamSettings(num_features=500), MOUNT)
    stamps, views_per_turn = [], []
    for k in range(3 * len(x)):
        at = int(x[k % len(x)])
        if at not in images:
            images[at] = room.frame(0, planar_pose(0.06 * at, 0.0, turn_rad * at))
        frame = StereoFrame(k, k * 100_000_000, images[at].left, images[at].right)
        result = slam.process(frame)[0]
        assert result.tracked
        if result.keyframe is not None:
            stamps.append(result.stamp_ns)
            np.testing.assert_array_equal(result.keyframe.path.stamp_ns, stamps)
        if k % len(x) == len(x) - 1:
            views_per_turn.append(sum(not r.retired for r in slam.map.keyframes))
    assert 3 <= views_per_turn[0] <= len(images)
    assert views_per_turn[-1] == views_per_turn[0] == len(stamps)
