"""The whole map, adjusted after it was bent, and brought back into one that has grown since."""

from __future__ import annotations

import numpy as np
import pytest

from segfloor_ros.core.contracts import NO_POINT, Up
from segfloor_ros.core.geometry import invert, transform_points
from segfloor_ros.core.plugins.maps.map_arrays import fill_map
from segfloor_ros.core.slam.mapping import normal_equations
from segfloor_ros.core.slam.mapping.bundle_adjustment import (
    apply_global,
    copy_map,
    move_keyframes,
    solve_global,
)
from segfloor_ros.core.slam.rig import Rig
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, SparseMap
from segfloor_ros.core.twists import se3_exp, se3_log
from tools.map_costs import CAMERA, bend, made_up_map, ring

COUNT = 80


@pytest.fixture
def bent():
    sparse_map = SparseMap(Rig(CAMERA))
    fill_map(sparse_map, made_up_map(COUNT, np.random.default_rng(2)))
    bend(sparse_map)
    return sparse_map


def errors_m(sparse_map):
    poses = np.stack([k.T_camera_world for k in sparse_map.keyframes[:COUNT]])
    return np.linalg.norm(invert(poses)[:, :3, 3] - invert(ring(COUNT))[:, :3, 3], axis=1)


def adjust(sparse_map, meanwhile=lambda: None, up_world=None):
    copied = copy_map(sparse_map, up_world)
    result = solve_global(CAMERA, copied, lambda: True)
    meanwhile()
    apply_global(sparse_map, result)


def test_a_bent_ring_is_round_again(bent):
    before = errors_m(bent).max()
    adjust(bent)
    assert before > 0.1
    assert errors_m(bent).max() < 0.05 * before


@pytest.mark.parametrize('is_up_known', [False, True])
def test_a_map_that_has_turned_goes_back_to_where_its_first_keyframes_came(bent, is_up_known):
    tilt, turn = 0.02, 0.03
    T = se3_exp(np.array([0.3, 0.0, -0.2, tilt, turn, 0.0]))
    move_keyframes(bent, np.stack([k.T_camera_world for k in bent.keyframes]) @ invert(T))
    adjust(bent, up_world=Up(np.array([0.0, -1.0, 0.0]), 0.01) if is_up_known else None)
    off = [se3_log(invert(k.T_camera_world) @ ring(COUNT)[i])[3:] for i, k in
           enumerate(bent.keyframes[:10])]  # fmt: skip
    tilted, turned, _ = np.abs(np.mean(off, axis=0))
    assert turned < 0.05 * turn
    assert tilted == pytest.approx(tilt if is_up_known else 0.0, abs=0.05 * tilt)
    if not is_up_known:
        assert errors_m(bent).max() < 0.02


@pytest.mark.parametrize('retired', [0, 9])
def test_a_first_keyframe_that_shows_little_does_not_turn_the_map(retired):
    sparse_map = SparseMap(Rig(CAMERA))
    fill_map(sparse_map, made_up_map(COUNT, np.random.default_rng(2)))
    first = sparse_map.keyframes[0]
    sparse_map.unlink(0, np.flatnonzero(first.point_id != NO_POINT)[::3])
    sparse_map.unlink(0, np.flatnonzero(first.point_id != NO_POINT)[::2])
    for k in range(1, 1 + retired):
        sparse_map.retire(sparse_map.keyframes[k], sparse_map.keyframes[10])
    first.observations.uvd_px[:, 0] += 5.0  # it seems to look 0.9 deg further to the left
    adjust(sparse_map)
    assert errors_m(sparse_map)[1:].max() < 0.02
    first.observations.uvd_px[:, 0] -= 5.0
    adjust(sparse_map)
    assert errors_m(sparse_map).max() < 0.02, 'it goes to where it belongs'


def test_a_first_keyframe_that_shows_nothing_stays_beside_the_next(bent):
    first = bent.keyframes[0]
    bent.unlink(0, np.flatnonzero(first.point_id != NO_POINT)[3:])
    step = first.T_camera_world @ bent.keyframes[1].T_world_camera
    before = bent.keyframes[-1].T_camera_world.copy()
    adjust(bent)
    after = first.T_camera_world @ bent.keyframes[1].T_world_camera
    np.testing.assert_allclose(after, step, atol=1e-9)
    assert np.abs(bent.keyframes[-1].T_camera_world - before).max() > 0.05


def test_a_large_map_is_adjusted_without_a_factor_and_comes_out_the_same(bent, monkeypatch):
    copied = copy_map(bent, None)
    by_factor = solve_global(CAMERA, copied, lambda: True)
    monkeypatch.setattr(normal_equations, 'MANY', COUNT // 2)
    monkeypatch.delattr(normal_equations, 'solve_symmetric')
    by_gradients = solve_global(CAMERA, copied, lambda: True)
    poses = (invert(found.adjusted.T_camera_world) for found in (by_factor, by_gradients))
    moved_m = np.linalg.norm(np.subtract(*poses)[:, :3, 3], axis=1)
    assert moved_m.max() < 0.02 * errors_m(bent).max()


def test_rotations_stay_rotations_however_often_the_map_is_adjusted(bent):
    for _ in range(25):
        adjust(bent)
    turns = np.stack([k.T_camera_world[:3, :3] for k in bent.keyframes])
    np.testing.assert_allclose(
        turns @ turns.swapaxes(1, 2), np.tile(np.eye(3), (COUNT, 1, 1)), atol=1e-12
    )


def test_a_world_that_turns_takes_points_their_directions_and_retired_keyframes_along(bent):
    T = se3_exp(np.array([0.3, -0.2, 0.1, 0.1, 0.2, 0.5]))
    bent.retire(bent.keyframes[30], bent.keyframes[31])
    alive = bent.alive.copy()
    xyz, direction = bent.xyz_world[alive], bent.viewing_direction[alive]
    poses = np.stack([k.T_camera_world for k in bent.keyframes])
    turned = poses @ invert(T)
    turned[30] = np.eye(4)  # where the one stands that it follows is what counts
    move_keyframes(bent, turned)
    np.testing.assert_allclose(bent.xyz_world[alive], transform_points(T, xyz), atol=1e-9)
    np.testing.assert_allclose(bent.viewing_direction[alive], direction @ T[:3, :3].T, atol=1e-9)
    np.testing.assert_allclose(bent.keyframes[30].T_camera_world, poses[30] @ invert(T), atol=1e-9)


def test_what_was_mapped_meanwhile_moves_along(bent):
    last = bent.keyframes[-1]
    ahead = se3_exp(np.array([0.0, 0.0, -0.2, 0.0, 0.0, 0.0]))

    def map_on():
        none = np.zeros(0, np.intp)
        bent.restore(
            KeyframeRecord(
                COUNT,
                COUNT,
                last.stamp_ns + 1,
                ahead @ last.T_camera_world,
                None,
                last.octave[none],
                last.observations.take(none),
                np.zeros(0, np.int32),
            )
        )

    adjust(bent, map_on)
    new = bent.keyframes[COUNT]
    np.testing.assert_allclose(new.T_camera_world @ last.T_world_camera, ahead, atol=1e-9)


def test_what_moved_meanwhile_keeps_its_move(bent):
    poses = np.stack([k.T_camera_world for k in bent.keyframes])
    step = se3_exp(np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0]))

    def local_adjustment():
        moved = poses.copy()
        moved[40] = step @ poses[40]
        move_keyframes(bent, moved)

    adjust(bent, local_adjustment)
    error = bent.keyframes[40].T_camera_world @ invert(ring(COUNT)[40])
    np.testing.assert_allclose(error[:3, 3], step[:3, 3], atol=0.006)


@pytest.mark.parametrize('moved_m', [0.0, 0.005])
def test_points_are_where_they_were_adjusted_to_though_a_loop_moved_the_map_meanwhile(
    bent, moved_m
):
    def loop():
        poses = np.stack([k.T_camera_world for k in bent.keyframes])
        move_keyframes(bent, poses @ se3_exp(np.array([moved_m, 0.0, 0.0, 0.0, 0.0, 0.0])))

    cost = solve_global(CAMERA, copy_map(bent, None), lambda: True).adjusted.cost_after
    adjust(bent, loop)
    after = solve_global(CAMERA, copy_map(bent, None), lambda: False)
    assert after.adjusted.cost_before == pytest.approx(cost, rel=0.01)


def test_an_adjustment_that_is_no_longer_wanted_changes_nothing(bent):
    before = np.stack([k.T_camera_world for k in bent.keyframes])
    copied = copy_map(bent, None)
    apply_global(bent, solve_global(CAMERA, copied, lambda: False))
    np.testing.assert_array_equal(before, np.stack([k.T_camera_world for k in bent.keyframes]))
