"""The sparse map's bookkeeping on small hand-made maps."""

import numpy as np
from hand_made_maps import CAMERA, add, keyframe

from segfloor_ros.core.contracts import NO_POINT
from segfloor_ros.core.plugins.maps.map_arrays import add_points, map_to_arrays, points_to_arrays
from segfloor_ros.core.slam.places import loop_closing
from segfloor_ros.core.slam.rig import Rig
from segfloor_ros.core.slam.sparse_map import Match, PointRows, SparseMap, features_of


def two_keyframes():
    """Points 0, 1, 2 at z = 2, made by keyframe 0; keyframe 1, a metre to the right, sees 1
    and 2.
    """
    sparse_map = SparseMap(Rig(CAMERA))
    first = keyframe(0, [NO_POINT] * 4)
    add(sparse_map, first, [0, 1, 3], [[0, 0, 2], [1, 0, 2], [2, 0, 2]])
    second = keyframe(1, [2, NO_POINT, 1], x=1.0)
    add(sparse_map, second)
    return sparse_map, first, second


def test_ids_count_up_and_link_both_ways():
    sparse_map, first, _ = two_keyframes()
    np.testing.assert_array_equal(first.point_id, [0, 1, NO_POINT, 2])
    np.testing.assert_array_equal(sparse_map.observer_count, [1, 2, 2])
    np.testing.assert_array_equal(sparse_map.points_of(np.array([1])), [1, 2])
    order, shared = sparse_map.covisible(np.array([1, 2]))
    np.testing.assert_array_equal(order, [1, 0])
    np.testing.assert_array_equal(shared, [2, 2])


def test_a_point_takes_on_the_latest_view_but_keeps_its_patch_while_its_size_stays():
    sparse_map, _, _ = two_keyframes()
    np.testing.assert_array_equal(sparse_map.descriptor[:, 0], [0, 1, 1])
    # Keyframe 1 sees point 1 from 2.0 m instead of 2.24 m, and point 2 from 2.24 instead of 2.83 m.
    np.testing.assert_allclose(sparse_map.viewing_distance_m, [2, 2, np.sqrt(5)])
    np.testing.assert_array_equal(sparse_map.patch[:, 0, 0], [0, 0, 0])
    nearer = keyframe(2, [2], x=2.0)
    nearer.T_camera_world[2, 3] = -1.0
    add(sparse_map, nearer)
    assert sparse_map.patch[2, 0, 0] == 2


def test_removed_points_vanish_everywhere_and_leave_their_rows_but_not_their_ids():
    sparse_map, first, second = two_keyframes()
    sparse_map.remove_points(np.array([1]))
    np.testing.assert_array_equal(first.point_id, [0, NO_POINT, NO_POINT, 2])
    np.testing.assert_array_equal(second.point_id, [2, NO_POINT, NO_POINT])
    np.testing.assert_array_equal(sparse_map.alive, [True, False, True])
    third = keyframe(2, [NO_POINT])
    add(sparse_map, third, [0], [[0, 0, 5]])
    np.testing.assert_array_equal(third.point_id, [1])
    np.testing.assert_array_equal(sparse_map.stable_id, [0, 3, 2])
    np.testing.assert_array_equal(sparse_map.xyz_world[1], [0, 0, 5])
    np.testing.assert_array_equal(sparse_map.observer_count, [1, 1, 2])
    np.testing.assert_array_equal(sparse_map.patch[1, 0, 0], 2)


def test_rows_are_reused_before_new_ones_are_made():
    sparse_map, _, _ = two_keyframes()
    sparse_map.remove_points(np.array([0, 2]))
    third = keyframe(2, [NO_POINT] * 3)
    add(sparse_map, third, [0, 1, 2], [[0, 0, 5], [0, 0, 6], [0, 0, 7]])
    np.testing.assert_array_equal(third.point_id, [0, 2, 3])
    np.testing.assert_array_equal(sparse_map.stable_id, [3, 1, 4, 5])
    np.testing.assert_array_equal(sparse_map.xyz_world[:, 2], [5, 2, 6, 7])
    assert sparse_map.alive.all()


def test_unlinking_the_last_observer_removes_the_point():
    sparse_map, first, second = two_keyframes()
    sparse_map.unlink(second.index, np.array([0]))
    np.testing.assert_array_equal(sparse_map.observer_count, [1, 2, 1])
    assert sparse_map.alive.all()
    sparse_map.unlink(first.index, np.array([3]))
    np.testing.assert_array_equal(sparse_map.alive, [True, True, False])
    points, keyframes, rows = sparse_map.edges_of(np.array([0, 1, 2]))
    edges = set(zip(points.tolist(), keyframes.tolist(), rows.tolist(), strict=True))
    assert edges == {(0, 0, 0), (1, 0, 1), (1, 1, 2)}


def test_features_of_no_point_are_forgotten_and_the_map_is_the_same():
    sparse_map, first, second = two_keyframes()
    before = map_to_arrays(sparse_map)
    sparse_map.thin_out(first)
    assert len(first.octave) == len(first.observations) == 3
    assert first.observations.uvd_px.nbytes + first.observations.sigma_px.nbytes == 3 * 18
    np.testing.assert_array_equal(
        features_of(sparse_map, first).descriptor, sparse_map.descriptor[first.point_id]
    )
    np.testing.assert_array_equal(first.point_id, [0, 1, 2])
    assert len(second.point_id) == 3, 'another keeps what it has'
    for name, values in map_to_arrays(sparse_map).items():
        np.testing.assert_array_equal(values, before[name])
    sparse_map.remove_points(np.array([2]))
    np.testing.assert_array_equal(first.point_id, [0, 1, NO_POINT])
    np.testing.assert_array_equal(second.point_id, [NO_POINT, NO_POINT, 1])


def test_a_place_seen_before_features_were_forgotten_merges_no_points():
    sparse_map, first, _ = two_keyframes()
    ids = np.array([1], np.int32)
    seen = Match(0, 1, np.eye(4), np.array([3]), ids, sparse_map.stable_id[ids])
    sparse_map.thin_out(first)
    loop_closing._merge(sparse_map, seen)
    np.testing.assert_array_equal(first.point_id, [0, 1, 2])


def test_points_that_tracking_seldom_finds_are_poor(monkeypatch):
    sparse_map, _, _ = two_keyframes()
    for _ in range(10):
        sparse_map.points.note_tracking(np.array([0, 1, 2]), np.array([1, 2]))
    # Point 0 was found once (when it was made) in eleven chances.
    np.testing.assert_array_equal(sparse_map.poor_points(0), [0])
    monkeypatch.setattr('segfloor_ros.core.slam.sparse_map.FOUND_SHARE', 0.05)
    np.testing.assert_array_equal(sparse_map.poor_points(0), [])


def test_grows_beyond_its_first_buffer():
    sparse_map = SparseMap(Rig(CAMERA))
    xyz = np.random.default_rng(0).normal(size=(3000, 3))
    add(sparse_map, keyframe(0, [NO_POINT] * 3000), np.arange(3000), xyz)
    np.testing.assert_array_equal(sparse_map.xyz_world, xyz)


def test_points_of_a_map_behind_another_count_its_keyframes_from_where_they_come():
    own, other = PointRows(), PointRows()
    own.add(3)
    other.add(2, born=np.array([0, 4]), seen_last=np.array([4, 5]))
    add_points(own, points_to_arrays(other, np.arange(2)), first_keyframe=7)
    assert own['born'].tolist() == [0, 0, 0, 7, 11]
    assert own['seen_last'][3:].tolist() == [11, 12]
    assert own['stable_id'].tolist() == [0, 1, 2, 0, 1]


def test_observations_are_those_of_the_keyframes_whatever_is_done_to_them():
    rng, sparse_map = np.random.default_rng(0), SparseMap(Rig(CAMERA))
    for k in range(8):
        known = np.flatnonzero(sparse_map.alive)
        seen = rng.choice(known, min(len(known), 15), replace=False)
        ids = np.concatenate([seen, np.full(12, NO_POINT)])
        new = np.arange(len(seen), len(ids) - 2)
        add(sparse_map, keyframe(k, ids), new, rng.normal(size=(len(new), 3)))
        kept = np.array([k, max(k - 1, 0)])
        sparse_map.unlink(kept[:1], np.array([0]))
        sparse_map.unlink(kept, np.array([1, 2]))
        chosen = rng.permutation(np.flatnonzero(sparse_map.alive))[:7]
        sparse_map.merge(chosen[:3], chosen[3:6])
        sparse_map.remove_points(chosen[6:])
        if k > 3:
            sparse_map.thin_out(sparse_map.keyframes[k - 3])
        edges = sparse_map.edges_of(np.flatnonzero(sparse_map.alive))
        observed = [
            (int(record.point_id[row]), record.index, int(row))
            for record in sparse_map.keyframes
            for row in np.flatnonzero(record.point_id != NO_POINT)
        ]
        listed = list(zip(*(column.tolist() for column in edges), strict=True))
        assert sorted(listed) == sorted(observed)
        assert (np.diff(edges[1]) >= 0).all(), 'keyframe by keyframe'
        count = np.bincount(edges[0], minlength=len(sparse_map.alive))
        np.testing.assert_array_equal(
            count[sparse_map.alive], sparse_map.observer_count[sparse_map.alive]
        )
