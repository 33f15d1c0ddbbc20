"""The pose graph on rings of poses whose truth is known."""

import numpy as np
from scipy.spatial.transform import Rotation

from segfloor_ros.core.geometry import invert, make_transform
from segfloor_ros.core.slam.places.loop_closing import PoseGraph, optimise
from segfloor_ros.core.twists import se3_exp, se3_log, se3_logs

COUNT = 60


def ring():
    """Cameras T_camera_world around a circle of 5 m radius, looking along it."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, COUNT, endpoint=False):
        R = Rotation.from_euler('y', -angle).as_matrix()
        poses.append(invert(make_transform(R, 5 * np.array([np.cos(angle), 0.0, np.sin(angle)]))))
    return np.stack(poses)


def drifted(truth, twist):
    """The same motions, each with an error."""
    poses = [truth[0]]
    for k in range(1, COUNT):
        poses.append(se3_exp(twist) @ truth[k] @ invert(truth[k - 1]) @ poses[-1])
    return np.stack(poses)


def graph(poses, loops, robust):
    """Links between neighbours as the poses say, and loops (i, j, T_i_j)."""
    i, j = np.arange(1, COUNT), np.arange(COUNT - 1)
    T = np.concatenate([poses[i] @ invert(poses[j]), np.stack([T for _, _, T in loops])])
    i, j = np.append(i, [a for a, _, _ in loops]), np.append(j, [b for _, b, _ in loops])
    sigma = np.tile([0.01] * 3 + [0.002] * 3, (len(i), 1))
    is_robust = np.zeros(len(i), bool)
    is_robust[COUNT - 1 :] = robust
    return PoseGraph(poses, i, j, T, sigma, is_robust)


def errors_m(poses, truth):
    return np.linalg.norm(invert(poses)[:, :3, 3] - invert(truth)[:, :3, 3], axis=1)


def test_logarithms_of_many_are_those_of_each():
    twists = np.random.default_rng(0).normal(size=(20, 6))
    twists[0] = 0.0
    twists[1] *= 1e-6
    T = se3_exp(twists)
    np.testing.assert_allclose(se3_logs(T), [se3_log(one) for one in T], atol=1e-9)


def test_a_loop_takes_a_constant_drift_away():
    truth = ring()
    poses = drifted(truth, np.array([0.004, 0.001, 0.003, 0.0002, 0.0015, -0.0003]))
    before = errors_m(poses, truth)
    loops = [(COUNT - 1, 0, truth[-1] @ invert(truth[0]))]
    after, weight = optimise(graph(poses, loops, [False]))
    assert before.max() > 0.3
    assert errors_m(after, truth).max() < 0.3 * before.max()
    np.testing.assert_array_equal(after[0], poses[0])
    np.testing.assert_array_equal(weight, 1.0)


def test_without_contradiction_nothing_moves():
    truth = ring()
    after, _ = optimise(graph(truth, [(40, 3, truth[40] @ invert(truth[3]))], [True]))
    np.testing.assert_allclose(after, truth, atol=1e-9)


def test_a_loop_that_contradicts_the_others_loses_its_weight():
    truth = ring()
    true_loops = [(k, 0, truth[k] @ invert(truth[0])) for k in (COUNT - 1, COUNT - 2)]
    false_loop = (30, 0, truth[5] @ invert(truth[0]))
    poses = drifted(truth, np.array([0.002, 0.0, 0.001, 0.0, 0.001, 0.0]))
    after, weight = optimise(graph(poses, [*true_loops, false_loop], [False, False, True]))
    assert weight[-1] < 0.01
    assert errors_m(after, truth).max() < 0.1
