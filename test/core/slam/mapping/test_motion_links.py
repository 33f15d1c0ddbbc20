"""Measured motions between keyframes in a bundle adjustment."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from segfloor_ros.core.contracts import RelativeMotion, Up
from segfloor_ros.core.geometry import invert, make_transform
from segfloor_ros.core.slam.mapping.normal_equations import (
    Levels,
    Links,
    System,
    cost,
    factors_of,
    loop_factors,
    motion_before,
    squared_errors,
    with_factors,
)
from segfloor_ros.core.slam.rig import chi2_limit
from segfloor_ros.core.slam.sparse_map import LoopEdge
from segfloor_ros.core.twists import se3_exp, se3_log

UP = np.array([0.03, -0.99, -0.12]) / np.linalg.norm([0.03, -0.99, -0.12])

RNG = np.random.default_rng(4)
POSES = np.stack([se3_exp(RNG.normal(size=6) * 0.4) for _ in range(3)])
COVARIANCE = np.diag([4e-4, 9e-4, 4e-4, 1e-4, 1e-4, 4e-4])


def link(before, now, error):
    """A motion that its poses miss by a twist."""
    moved = POSES[now] @ invert(POSES[before])
    return before, now, RelativeMotion(se3_exp(-np.array(error)) @ moved, COVARIANCE)


def empty_system(count):
    none = np.zeros
    return System(
        none((count, 6, 6)), none((3, 3, 0)), none((6, 3, 0)), none(count + 1, np.intp),
        none(0, np.intp), none((count, 6)), none((3, 0)), none((count, 6, 2)), none((2, 3, 0)),
        np.eye(2), none(2),
        np.tile(np.eye(6), (count, 1, 1)),
    )  # fmt: skip


def test_the_error_is_the_twist_by_which_the_poses_miss():
    error = np.array([0.01, -0.02, 0.03, 0.002, 0.001, -0.003])
    (links,) = Links.of([link(0, 1, error), link(2, 0, 2 * error)])
    np.testing.assert_allclose(links.errors(POSES), [error, 2 * error], atol=1e-9)


def test_poses_that_move_as_measured_cost_nothing_and_slip_costs_less_than_its_square():
    none, small, large = (Links.of([link(0, 1, [x, 0, 0, 0, 0, 0])])[0] for x in (0, 0.01, 1.0))
    assert cost(none, POSES) == pytest.approx(0.0, abs=1e-9)
    assert cost(small, POSES) == pytest.approx(0.01**2 / (4e-4 + 1e-6), rel=1e-3)
    assert cost(large, POSES) < 0.2 * squared_errors(large, POSES)[0]


def test_the_right_hand_side_is_the_slope_of_the_cost():
    links = Links.of(
        [link(0, 1, [0.01, 0, 0.01, 0.003, 0, 0]), link(1, 2, [0, 0.02, 0, 0, 0.002, 0])]
    )
    system = with_factors(empty_system(2), POSES, links)
    for k in range(2):
        for axis in range(6):
            twist = np.zeros(6)
            twist[axis] = 1e-5
            costs = []
            for sign in (1, -1):
                moved = POSES.copy()
                moved[k] = se3_exp(sign * twist) @ moved[k]
                costs.append(sum(cost(item, moved) for item in links))
            slope = (costs[0] - costs[1]) / 2e-5
            # The cost is a sum of squares: its slope is twice the gradient's half.
            assert -2 * system.camera_rhs[k, axis] == pytest.approx(slope, rel=0.02, abs=0.3)


def test_a_step_brings_free_poses_where_they_were_measured():
    links = Links.of(
        [link(0, 1, [0.01, 0, 0.01, 0.003, 0, 0]), link(1, 2, [0, 0.02, 0, 0, 0.002, 0])]
    )
    step = with_factors(empty_system(2), POSES, links).solve(0.0)
    moved = POSES.copy()
    moved[:2] = se3_exp(step.twists) @ moved[:2]
    assert (squared_errors(links[0], moved) < 1e-3 * chi2_limit(6)).all()
    # The third pose was held; both others moved.
    for k in range(2):
        assert np.linalg.norm(se3_log(moved[k] @ invert(POSES[k]))) > 1e-3


def test_without_links_the_system_stays_as_it_is():
    system = empty_system(2)
    assert with_factors(system, POSES, ()) is system


def test_a_keyframe_that_tilts_is_turned_back():
    tilt = Rotation.from_rotvec([0.02, 0.3, -0.01]).as_matrix()
    poses = np.stack([make_transform(tilt, np.zeros(3))])
    up = Up(Rotation.from_rotvec([0.0, 0.3, 0.0]).apply(UP), 0.01)
    levels = Levels.of([(0, up)], UP)
    before = np.linalg.norm(levels[0].errors(poses))
    assert before > 0.015
    for _ in range(3):
        step = with_factors(empty_system(1), poses, levels).solve(0.0)
        poses = se3_exp(step.twists) @ poses
    assert np.linalg.norm(levels[0].errors(poses)) < 0.01 * before
    # Turning about up is free.
    assert Rotation.from_matrix(poses[0, :3, :3]).magnitude() == pytest.approx(0.3, abs=0.03)


SLOT = np.array([2, -1, 0, 3, 1])
"""Where keyframes are in a problem; the second one is not in it."""

DRIVE = np.stack([se3_exp(RNG.normal(size=6) * 0.4) for _ in range(5)])


def in_problem():
    poses = np.zeros((4, 4, 4))
    poses[SLOT[SLOT >= 0]] = DRIVE[SLOT >= 0]
    return poses


def test_motions_and_ups_are_those_of_the_keyframes_wherever_these_are_in_a_problem():
    motions = [RelativeMotion(T @ invert(b), COVARIANCE) for b, T in pairwise(DRIVE)]
    ups = [Up(T[:3, :3] @ UP, 0.01) for T in DRIVE]
    keyframes = [
        SimpleNamespace(motion=m, up=u, retired=None)
        for m, u in zip([None, *motions], ups, strict=True)
    ]
    links, levels = factors_of(keyframes, SLOT, Up(UP, 0.01))
    # No motion ends at the first one, and none at or after the one that is left out counts.
    assert len(links.keyframes) == 2 and len(levels.keyframes) == 4
    for factors in (links, levels):
        np.testing.assert_allclose(factors.errors(in_problem()), 0.0, atol=1e-9)


def driven(retired=(), unmeasured=()):
    """Return keyframes of a drive, of which some are retired, or not tied to the one before."""
    motions = [None] + [RelativeMotion(T @ invert(b), COVARIANCE) for b, T in pairwise(DRIVE)]
    return [
        SimpleNamespace(
            motion=None if k in unmeasured else motion, up=None, retired=1 if k in retired else None
        )
        for k, motion in enumerate(motions)
    ]


def test_a_link_goes_past_keyframes_that_are_retired():
    keyframes = driven(retired=(2, 3))
    before, motion = motion_before(keyframes, 4)
    assert before == 1
    np.testing.assert_allclose(motion.T_now_before, DRIVE[4] @ invert(DRIVE[1]), atol=1e-9)
    # Three motions are less sure than one.
    assert np.linalg.eigvalsh(motion.covariance - COVARIANCE).min() > 0
    slot = np.array([0, 1, -1, -1, 2])
    (links,) = factors_of(keyframes, slot, None)
    np.testing.assert_array_equal(np.sort(links.keyframes, axis=None), [0, 1, 1, 2])
    np.testing.assert_allclose(links.errors(DRIVE[slot >= 0]), 0.0, atol=1e-9)


def test_a_link_ends_where_the_motion_was_not_measured():
    assert motion_before(driven(retired=(2, 3), unmeasured=(3,)), 4) == (2, None)
    assert motion_before(driven(), 0)[1] is None
    before, motion = motion_before(driven(retired=(0,)), 1)
    assert before == 0 and motion is not None


def test_a_loop_by_the_floor_ties_both_its_keyframes_wherever_they_are_in_a_problem():
    loops = [
        LoopEdge(i, j, DRIVE[i] @ invert(DRIVE[j]), i != 4) for i, j in ((3, 0), (1, 0), (4, 2))
    ]
    (links,) = loop_factors(loops, SLOT)
    assert len(links.keyframes) == 1
    np.testing.assert_allclose(links.errors(in_problem()), 0.0, atol=1e-9)
    np.testing.assert_allclose(links.errors(POSES[[0, 1, 2, 0]]), se3_logs_of(loops[0]), atol=1e-9)


def se3_logs_of(loop):
    """Return the twist by which other poses miss a loop of the last keyframe to the third."""
    return [se3_log(POSES[0] @ invert(POSES[2]) @ invert(loop.T_i_j))]


def test_a_keyframe_that_pitches_and_rolls_is_level_to_first_order():
    """The derivative of the tilt is that of its differences, wherever up is."""
    poses, h = DRIVE[:3], 1e-6
    levels = Levels.of([(k, Up(se3_exp(0.05 * RNG.normal(size=6))[:3, :3] @ T[:3, :3] @ UP, 0.01))
                        for k, T in enumerate(poses)], UP)[0]  # fmt: skip
    for axis in range(6):
        twist = h * np.eye(6)[axis]
        ahead, behind = (levels.errors(se3_exp(sign * twist) @ poses) for sign in (1, -1))
        np.testing.assert_allclose(
            levels.jacobians(poses)[:, 0, :, axis], (ahead - behind) / (2 * h), atol=1e-6
        )
