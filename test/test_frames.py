import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from segfloor_ros.core.geometry import HISTORY_NS, make_transform, rotation_angle
from segfloor_ros.core.twists import between
from segfloor_ros.nodes.frame_tree import FrameTree

S = 1_000_000_000


def at(x: float, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    return make_transform(Rotation.from_euler('z', yaw).as_matrix(), np.array([x, y, 0.0]))


def test_frames_are_found_up_and_down_the_tree() -> None:
    tree = FrameTree()
    tree.add_fixed('base', 'mast', at(0.0, 0.0, np.pi / 2))
    left, right = at(1.0, 0.0, 0.7), at(2.0, 0.5, -0.3)
    tree.add_fixed('mast', 'left', left)
    tree.add_fixed('mast', 'right', right)
    # The mast points to the base's left: its x is the base's y.
    T_base_left = tree.lookup('base', 'left')
    assert T_base_left is not None
    np.testing.assert_allclose(T_base_left[:3, 3], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(left @ tree.lookup('left', 'right'), right, atol=1e-12)
    np.testing.assert_allclose(tree.lookup('left', 'base') @ T_base_left, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(tree.lookup('left', 'left'), np.eye(4))
    assert tree.root_of('right') == 'base'


def test_what_is_not_connected_is_not_found() -> None:
    tree = FrameTree()
    tree.add_fixed('base', 'left', at(1.0))
    tree.add_fixed('other', 'island', at(1.0))
    assert tree.lookup('base', 'island') is None
    assert tree.lookup('base', 'unheard_of') is None
    assert tree.root_of('unheard_of') == 'unheard_of'


def test_between_two_times_position_and_turn_are_interpolated() -> None:
    tree = FrameTree()
    tree.add_moving(10 * S, 'odom', 'base', at(0.0, 0.0, 0.0))
    tree.add_moving(12 * S, 'odom', 'base', at(4.0, 2.0, 0.8))
    at_a_quarter = tree.lookup('odom', 'base', 10 * S + S // 2)
    np.testing.assert_allclose(at_a_quarter, at(1.0, 0.5, 0.2), atol=1e-12)
    np.testing.assert_allclose(tree.lookup('odom', 'base', 10 * S), at(0.0))
    np.testing.assert_allclose(tree.lookup('odom', 'base'), at(4.0, 2.0, 0.8))
    assert tree.lookup('odom', 'base', 9 * S) is None
    assert tree.lookup('odom', 'base', 13 * S) is None


def test_a_frame_turns_about_an_axis_of_its_own_between_two_poses() -> None:
    T_a, T_b = (
        make_transform(Rotation.from_rotvec(turn).as_matrix(), np.array(at_m))
        for turn, at_m in (((0.0, 0.5, 1.2), (1.0, 0.0, 0.0)), ((0.9, 0.0, -0.4), (3.0, 2.0, 1.0)))
    )
    np.testing.assert_allclose(between(T_a, T_b, 1.0), T_b, atol=1e-12)
    half = between(T_a, T_b, 0.5)
    np.testing.assert_allclose(half[:3, 3], [2.0, 1.0, 0.5])
    angles = [rotation_angle(T[:3, :3].T @ half[:3, :3]) for T in (T_a, T_b)]
    assert angles == pytest.approx([rotation_angle(T_a[:3, :3].T @ T_b[:3, :3]) / 2] * 2)


def test_only_ten_seconds_are_kept_and_a_jump_back_begins_anew() -> None:
    tree = FrameTree()
    for second in range(30):
        tree.add_moving(second * S, 'odom', 'base', at(second))
    assert tree.lookup('odom', 'base', 29 * S - HISTORY_NS) is not None
    assert tree.lookup('odom', 'base', 28 * S - HISTORY_NS) is None
    tree.add_moving(29 * S - S // 10, 'odom', 'base', at(99.0))
    np.testing.assert_allclose(tree.lookup('odom', 'base'), at(29.0))
    tree.add_moving(3 * S, 'odom', 'base', at(33.0))
    np.testing.assert_allclose(tree.lookup('odom', 'base'), at(33.0))
    assert tree.lookup('odom', 'base', 29 * S) is None


def test_a_circle_of_frames_has_an_end() -> None:
    tree = FrameTree()
    tree.add_fixed('a', 'b', at(1.0))
    tree.add_fixed('b', 'a', at(1.0))
    assert tree.lookup('a', 'c') is None
    assert tree.root_of('a') == 'b'


@pytest.mark.parametrize('fixed_first', [True, False])
def test_the_latest_word_on_a_parent_counts(fixed_first) -> None:
    tree = FrameTree()
    words = [
        lambda: tree.add_fixed('base', 'left', at(1.0)),
        lambda: tree.add_fixed('mast', 'left', at(2.0)),
    ]
    for word in words if fixed_first else reversed(words):
        word()
    assert tree.root_of('left') == ('mast' if fixed_first else 'base')
