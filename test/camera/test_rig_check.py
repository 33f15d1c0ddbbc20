"""What is wrong with a stereo rig shows in its images, within fifty frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from stereo_room import StereoRoom, planar_pose

from segfloor_ros.camera.model import StereoFrame
from segfloor_ros.camera.rig_check import SETTLED_FRAMES, InputFault, RigCheck

FRAME_S = 0.1


def pose(time_frames: float) -> np.ndarray:
    """A drive along an arc: 5 cm and a degree a frame."""
    return planar_pose(0.05 * time_frames, 0.0, np.radians(1.0) * time_frames)


@pytest.fixture(scope='module')
def frames() -> list[StereoFrame]:
    room = StereoRoom(seed=5)
    return [room.frame(i, pose(i)) for i in range(SETTLED_FRAMES)]


def faults(frames: list[StereoFrame]) -> dict[str, InputFault]:
    check = RigCheck()
    for frame in frames:
        check.see(frame)
    return check.faults


def late(frames: list[StereoFrame], lag_frames: float) -> list[StereoFrame]:
    """Let the right images be taken later or earlier than their stamps say."""
    room = StereoRoom(seed=5)
    return [
        replace(frame, right=room.frame(0, pose(frame.index - lag_frames)).right)
        for frame in frames
    ]


def test_a_good_rig_has_no_fault_moving_or_not(frames) -> None:
    assert faults(frames) == {}
    assert faults([replace(frames[0], stamp_ns=f.stamp_ns) for f in frames]) == {}


@pytest.mark.parametrize('rows', [3, -4])
def test_rows_that_are_off_are_counted(frames, rows) -> None:
    found = faults([replace(f, right=np.roll(f.right, rows, axis=0)) for f in frames])
    assert set(found) == {'rows_apart'}
    fault = found['rows_apart']
    assert fault.value == pytest.approx(abs(rows), abs=0.1)
    assert fault.unit == 'px'
    assert f'{abs(rows)}.0 rows apart' in fault.line()
    assert 'calibrate' in fault.remedy


def test_rows_that_are_off_are_taken_off_the_right_image(frames) -> None:
    check = RigCheck()
    for frame in frames[:11]:
        check.see(frame)
    assert check.corrected(frames[0]) is frames[0]
    check = RigCheck()
    off = [replace(f, right=np.roll(f.right, 3, axis=0)) for f in frames[:11]]
    for frame in off:
        check.see(frame)
    right = check.corrected(off[10]).right
    error = np.abs(right[8:-8].astype(float) - frames[10].right[8:-8])
    assert np.median(error) <= 1  # interpolated between rows where it is not exactly 3


def test_eyes_that_are_exchanged_are_named(frames) -> None:
    found = faults([replace(f, left=f.right, right=f.left) for f in frames])
    assert set(found) == {'eyes_swapped'}
    assert found['eyes_swapped'].value > 95
    assert 'exchange' in found['eyes_swapped'].remedy


@pytest.mark.parametrize('lag_frames', [1.0, 0.5, -1.0, 2.0])
def test_a_lag_between_the_eyes_is_measured(frames, lag_frames) -> None:
    found = faults(late(frames, lag_frames))
    assert set(found) == {'not_simultaneous'}
    fault = found['not_simultaneous']
    assert fault.value == pytest.approx(1e3 * lag_frames * FRAME_S, rel=0.1)
    assert fault.unit == 'ms'
    side = 'right' if lag_frames > 0 else 'left'
    assert f'the {side} one lags {abs(fault.value):.0f} ms' in fault.line()


def test_two_faults_are_both_found(frames) -> None:
    lagging = late(frames, 1.0)
    found = faults([replace(f, right=np.roll(f.right, 3, axis=0)) for f in lagging])
    assert found['rows_apart'].value == pytest.approx(3.0, abs=0.3)
    assert found['not_simultaneous'].value == pytest.approx(100.0, rel=0.1)


def test_images_that_show_nothing_have_no_fault(frames) -> None:
    blank: Callable[[StereoFrame], StereoFrame] = lambda f: replace(  # noqa: E731
        f, left=np.zeros_like(f.left), right=np.zeros_like(f.right)
    )
    assert faults([blank(f) for f in frames]) == {}
    assert faults([replace(f, right=np.zeros_like(f.right)) for f in frames]) == {}


def test_a_lag_is_said_of_five_looks_and_of_no_fewer(frames) -> None:
    """In few looks points move as they lie in the image, as what rectification leaves does."""
    lagging = late(frames, 1.0)
    assert 'not_simultaneous' not in faults(lagging[:40])
    assert set(faults(lagging[:41])) == {'not_simultaneous'}
