"""What is wrong with a stereo rig shows in its images, within fifty frames."""

from collections.abc import Callable
from dataclasses import replace
from itertools import islice, pairwise
from typing import Any

import cv2
import numpy as np
import pytest
from camera_recordings import opened
from chessboards import BASELINE_M, K_TRUE, draw, plain_texture
from chessboards import pose as board_pose
from stereo_room import CAMERA, StereoRoom, planar_pose

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import InputFault, StereoFrame
from segfloor_ros.core.geometry import make_transform
from segfloor_ros.core.plugins.rig.check import EVERY, RECENT, SETTLED_FRAMES, RigCheck

FRAME_S = 0.1


def pose(time_frames: float) -> np.ndarray:
    """A drive along an arc: 5 cm and a degree a frame."""
    return planar_pose(0.05 * time_frames, 0.0, np.radians(1.0) * time_frames)


def slowly(*values: float) -> list[Any]:
    """Return values whose tests run at night."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


@pytest.fixture(scope='module')
def frames() -> list[StereoFrame]:
    room = StereoRoom(seed=5)
    return [room.frame(i, pose(i)) for i in range(SETTLED_FRAMES)]


@pytest.fixture(scope='module')
def turning() -> list[StereoFrame]:
    """A turn of 75 degrees on the spot, in the middle of a short way."""
    room = StereoRoom(seed=5)
    turn = [planar_pose(0.01 * i, 0.0, np.radians(1.5) * i) for i in range(SETTLED_FRAMES)]
    return [room.frame(i, pose) for i, pose in enumerate(turn)]


def faults(frames: list[StereoFrame], camera: StereoCamera = CAMERA) -> dict[str, InputFault]:
    check = RigCheck(camera)
    for frame in frames:
        check.watch(frame)
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
    check = RigCheck(CAMERA)
    for frame in frames[:11]:
        check.see(frame)
    assert check.corrected(frames[0]) is frames[0]
    check = RigCheck(CAMERA)
    off = [replace(f, right=np.roll(f.right, 3, axis=0)) for f in frames[:11]]
    for frame in off:
        check.see(frame)
    right = check.corrected(off[10]).right
    error = np.abs(right[8:-8].astype(float) - frames[10].right[8:-8])
    assert np.median(error) <= 1  # interpolated between rows where it is not exactly 3


def with_rows(frames: list[StereoFrame], rows: Callable[[int], float]) -> list[StereoFrame]:
    return [replace(f, right=np.roll(f.right, round(rows(f.index)), axis=0)) for f in frames]


@pytest.mark.parametrize('seed', [1, 2])
def test_two_cameras_that_move_against_each_other_are_no_rig(frames, seed) -> None:
    shake_px = np.random.default_rng(seed).uniform(-10, 10, SETTLED_FRAMES // EVERY + 1)
    found = faults(with_rows(frames, lambda i: shake_px[i // EVERY]))
    assert set(found) == {'no_rig'}
    # Of the frames that are looked at, every tenth one; that before the first one is not known.
    assert found['no_rig'].value == pytest.approx(np.ptp(np.rint(shake_px[1:RECENT])), abs=0.5)
    assert 'are of no stereo camera' in found['no_rig'].line()


def test_images_that_do_not_belong_together_once_are_a_rig_all_the_same(frames) -> None:
    assert faults(with_rows(frames, lambda i: 8 if i // EVERY == 2 else 0)) == {}


def test_a_small_lag_of_a_rig_that_is_shaken_is_that_of_a_rig() -> None:
    """4 ms at 30 Hz, while rows move by up to 40 px a frame."""
    room, camera = StereoRoom(seed=5), CAMERA

    def shaken(time_frames: float) -> np.ndarray:
        tilt = 0.5 * np.sin(2 * np.pi * time_frames / 13)
        T = planar_pose(0.02 * time_frames, 0.0, 0.0)
        T[:3, :3] = T[:3, :3] @ cv2.Rodrigues(np.array([0.0, tilt, 0.0]))[0]
        return T

    taken = [
        replace(room.frame(i, shaken(i), 1 / FRAME_S), right=room.frame(i, shaken(i - 0.12)).right)
        for i in range(SETTLED_FRAMES)
    ]
    assert 'no_rig' not in faults(taken, camera)


@pytest.mark.slow
def test_the_figure_of_a_lag_stays_as_it_was_said(frames) -> None:
    check, said = RigCheck(CAMERA), set()
    room = StereoRoom(seed=5)
    more = [room.frame(i, pose(i)) for i in range(2 * SETTLED_FRAMES)]
    for frame in late(more, 1.0):
        check.see(frame)
        said |= {fault.line() for fault in check.faults.values()}
    assert len(said) == 1


def test_eyes_that_are_exchanged_are_named(frames) -> None:
    found = faults([replace(f, left=f.right, right=f.left) for f in frames])
    assert set(found) == {'eyes_swapped'}
    assert found['eyes_swapped'].value > 95
    assert 'exchange' in found['eyes_swapped'].remedy


def test_one_image_for_both_eyes_is_named(frames) -> None:
    found = faults([replace(f, right=f.left) for f in frames[:1]])
    assert set(found) == {'same_image'}
    assert 'one and the same' in found['same_image'].line()


def test_an_eye_that_is_upside_down_sees_different_things(frames) -> None:
    turned = [replace(f, right=f.right[::-1, ::-1].copy()) for f in frames]
    found = faults(turned)
    assert set(found) == {'different_views'}
    assert found['different_views'].value < 10
    assert 'turned' in found['different_views'].remedy


@pytest.mark.parametrize('lag_frames', [1.0, -1.0, *slowly(0.5, 2.0)])
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


def changed(
    frames: list[StereoFrame], change: Callable[[np.ndarray], np.ndarray]
) -> list[StereoFrame]:
    """Return the frames with both images changed."""
    return [replace(f, left=change(f.left), right=change(f.right)) for f in frames]


def test_images_without_texture_have_no_fault(frames) -> None:
    assert faults(changed(frames, lambda image: np.full_like(image, 128))) == {}
    assert faults([replace(f, right=np.full_like(f.right, 128)) for f in frames]) == {}


def test_images_that_are_out_of_focus_are_blurred(frames) -> None:
    found = faults(changed(frames, lambda image: cv2.GaussianBlur(image, (0, 0), 3)))
    assert set(found) == {'blurred'}
    assert found['blurred'].value > 5
    assert 'focus' in found['blurred'].line()
    one_eye = [replace(f, right=cv2.GaussianBlur(f.right, (0, 0), 3)) for f in frames]
    assert set(faults(one_eye)) == {'blurred'}


def test_a_moment_of_blur_or_darkness_is_no_fault(frames) -> None:
    for change in (lambda image: cv2.GaussianBlur(image, (0, 0), 3), lambda image: image // 10):
        assert faults([*changed(frames[:31], change), *frames[31:]]) == {}


def test_images_that_are_too_dark_or_too_bright_are_counted(frames) -> None:
    dark = faults(changed(frames, lambda image: image // 10))
    assert set(dark) == {'dark'}
    assert dark['dark'].value <= 25
    bright = faults(changed(frames, lambda image: np.minimum(image * 2.5, 255).astype(np.uint8)))
    assert set(bright) == {'saturated'}
    share = np.mean([frame.left >= 250 / 2.5 for frame in frames])
    assert bright['saturated'].value == pytest.approx(100 * share, abs=10)


@pytest.mark.parametrize('flickers', [False, True])
def test_eyes_of_different_exposure_are_compared(frames, flickers) -> None:
    def exposed(frame: StereoFrame) -> StereoFrame:
        if flickers and frame.index // 12 % 2:
            return replace(frame, left=np.rint(frame.left / 1.5).astype(np.uint8))
        return replace(frame, right=np.rint(frame.right / 1.5).astype(np.uint8))

    found = faults([exposed(frame) for frame in frames])
    assert set(found) == {'eyes_differ'}
    assert found['eyes_differ'].value == pytest.approx(1.5, abs=0.05)


@pytest.mark.parametrize('factor', [1.1, 0.5, *slowly(0.9, 2.0)])
def test_a_wrong_focal_length_shows_in_turns(turning, factor) -> None:
    assert faults(turning) == {}
    wrong = replace(CAMERA, fx=factor * CAMERA.fx, fy=factor * CAMERA.fy)
    found = faults(turning, wrong)
    assert set(found) == {'focal_length'}
    assert found['focal_length'].value == pytest.approx(100 * (factor - 1), abs=4)
    assert 'turns show 1' in found['focal_length'].line()  # 160 px


def test_nothing_is_said_of_motion_while_frames_are_skipped(turning) -> None:
    """Two frames, and three that are missing: how far the camera went is not known well enough."""
    wrong = replace(CAMERA, fx=0.8 * CAMERA.fx, fy=0.8 * CAMERA.fy)
    twice = [*turning, *(replace(f, stamp_ns=f.stamp_ns + 10**10) for f in turning[::-1])]
    assert set(faults(twice, wrong)) == {'focal_length'}
    assert faults([f for i, f in enumerate(twice) if i % 5 < 2], wrong) == {}


@pytest.mark.slow
def test_a_turn_after_a_long_way_shows_the_focal_length() -> None:
    """Once nothing was found in motion few frames are looked at, but turns are."""
    room = StereoRoom(seed=5)
    check = RigCheck(replace(CAMERA, fx=0.9 * CAMERA.fx, fy=0.9 * CAMERA.fy))
    straight, turn_rad = round(2.2 * SETTLED_FRAMES), np.radians(1.5)
    for i in range(straight):
        check.watch(room.frame(i, planar_pose(0.04 * i, 0.0, 0.0)))
    assert check.faults == {}
    for k in range(SETTLED_FRAMES // 2):
        pose = planar_pose(0.04 * straight + 0.01 * k, 0.0, turn_rad * k)
        check.watch(room.frame(straight + k, pose), turn_rad)
    assert set(check.faults) == {'focal_length'}


def test_a_wrong_focal_length_is_not_said_of_a_straight_drive() -> None:
    room = StereoRoom(seed=5)
    straight = [room.frame(i, planar_pose(0.03 * i, 0.0, 0.0)) for i in range(SETTLED_FRAMES)]
    assert faults(straight, replace(CAMERA, fx=1.2 * CAMERA.fx, fy=1.2 * CAMERA.fy)) == {}


@pytest.mark.parametrize('offset_px', [5, -5, 2])
@pytest.mark.parametrize('turn_deg', [0.0, *slowly(1.0)])
def test_a_principal_point_that_is_off_in_one_eye_shows_in_any_motion(turn_deg, offset_px) -> None:
    room = StereoRoom(seed=5)
    poses = [planar_pose(0.03 * i, 0.0, np.radians(turn_deg) * i) for i in range(SETTLED_FRAMES)]
    drive = [room.frame(i, pose) for i, pose in enumerate(poses)]
    found = faults([replace(f, right=np.roll(f.right, -offset_px, axis=1)) for f in drive])
    assert set(found) == {'principal_points'}
    fault = found['principal_points']
    assert fault.value == pytest.approx(offset_px, abs=0.3)
    assert f'{fault.value:+.1f} px' in fault.line()
    assert 'calibrate' in fault.remedy


def test_an_eye_that_is_rolled_and_zoomed_is_mended(frames) -> None:
    centre = (CAMERA.cx, CAMERA.cy)
    M = cv2.getRotationMatrix2D(centre, 2.0, 1.03)  # degrees, and 3 % larger
    M[1, 2] += 2.5
    check = RigCheck(CAMERA)
    off = [replace(f, right=cv2.warpAffine(f.right, M, f.right.shape[::-1])) for f in frames[:11]]
    for frame in off:
        check.see(frame)
    assert set(check.faults) == {'rows_apart'}
    right = check.corrected(off[10]).right
    inner = np.s_[30:-30, 30:-30]
    error = np.abs(right[inner].astype(float) - frames[10].right[inner])
    assert np.median(error) < 4  # interpolated twice
    assert np.median(error) < np.median(np.abs(off[10].right[inner] - 1.0 * right[inner])) / 4


def test_of_small_errors_the_rows_alone_are_taken_off(frames) -> None:
    turn_deg, larger, down_px = 0.2, 1.003, 0.4
    M = cv2.getRotationMatrix2D((CAMERA.cx, CAMERA.cy), turn_deg, larger)
    M[1, 2] += down_px
    check = RigCheck(CAMERA)
    off = [replace(f, right=cv2.warpAffine(f.right, M, f.right.shape[::-1])) for f in frames[:21]]
    for frame in off:
        check.see(frame)
    assert check.faults == {}
    before_px, after_px = (
        moved_px(frames[20].right, right)
        for right in (off[20].right, check.corrected(off[20]).right)
    )
    # Down, for each pixel to the right, and for each down.
    rows_off = [down_px, -np.radians(turn_deg), larger - 1]
    columns_off = [0.0, larger - 1, np.radians(turn_deg)]
    tolerance = 0.05, 6e-4, 6e-4
    assert (np.abs(before_px - (columns_off, rows_off)) < tolerance).all()
    assert (np.abs(after_px - (columns_off, np.zeros(3))) < tolerance).all()


def moved_px(image: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return columns and rows (2, 3) by which points are further in another image: in the middle,
    and more for each pixel to the right and down.
    """
    points = cv2.goodFeaturesToTrack(image, 500, 0.01, 5)
    found, status, _ = cv2.calcOpticalFlowPyrLK(image, other, points, None)
    here, there = points[status == 1], found[status == 1]
    off = there - here
    near = np.abs(off).max(axis=1) < 2
    A = np.column_stack([np.ones(near.sum()), here[near] - (CAMERA.cx, CAMERA.cy)])
    return np.linalg.lstsq(A, off[near], rcond=None)[0].T


def test_a_chessboard_that_fills_the_view_is_no_fault() -> None:
    K = K_TRUE * np.array([[2.0], [2.0], [1.0]])
    camera = StereoCamera(640, 480, K[0, 0], K[1, 1], K[0, 2], K[1, 2], BASELINE_M)
    generator, board = np.random.default_rng(0), plain_texture()
    T_right_left = make_transform(np.eye(3), np.array([-BASELINE_M, 0, 0]))
    seen = []
    for index in range(RECENT):
        T = board_pose(generator, BASELINE_M / 2, np.array([0.03, 0.03, 0.05]))
        left, right = (draw(board, at, K, (640, 480)) for at in (T, T_right_left @ T))
        noisy = np.stack([left, right]) + generator.normal(0, 2, (2, 480, 640))
        seen.append(StereoFrame(index, index * 10**8, *np.clip(noisy, 0, 255).astype(np.uint8)))
    assert faults([frame for frame in seen for _ in range(EVERY)], camera) == {}


def test_a_lag_is_said_of_five_looks_and_of_no_fewer(frames) -> None:
    """In few looks points move as they lie in the image, as what rectification leaves does."""
    lagging = late(frames, 1.0)
    assert 'not_simultaneous' not in faults(lagging[:40])
    assert set(faults(lagging[:41])) == {'not_simultaneous'}


def to_and_fro(frames: list[StereoFrame], times: int) -> list[StereoFrame]:
    """Drive a way forth and back, so many times."""
    way = [*frames, *frames[::-1]] * times
    return [replace(f, stamp_ns=round(1e9 * FRAME_S * i)) for i, f in enumerate(way)]


def test_a_camera_that_is_knocked_on_its_way_is_noticed_by_a_few_looks(frames) -> None:
    check = RigCheck(CAMERA)
    for frame in to_and_fro(frames, 2):
        check.watch(frame)
    assert check.frames < 3 * SETTLED_FRAMES
    assert check.faults == {}
    knocked = [replace(f, right=np.roll(f.right, 3, axis=0)) for f in frames]
    for frame in to_and_fro(knocked, 3):
        check.watch(frame)
    assert 'rows_apart' in check.faults


@pytest.mark.slow
def test_a_lag_shows_within_fifty_frames_of_motion_however_long_the_camera_stood(frames) -> None:
    standing = [frames[0]] * 3 * SETTLED_FRAMES
    drive = [*standing, *late(frames, 1.0)]
    drive = [replace(f, stamp_ns=round(1e9 * FRAME_S * i)) for i, f in enumerate(drive)]
    assert set(faults(drive)) == {'not_simultaneous'}


def both(change: Callable[[np.ndarray], np.ndarray]) -> Callable[..., list[StereoFrame]]:
    return lambda frames: changed(frames, change)


def right(change: Callable[[np.ndarray], np.ndarray]) -> Callable[..., list[StereoFrame]]:
    return lambda frames: [replace(f, right=change(f.right)) for f in frames]


def rolled(image: np.ndarray) -> np.ndarray:
    centre = image.shape[1] / 2, image.shape[0] / 2
    M = cv2.getRotationMatrix2D(centre, 2.0, 1.0)  # degrees
    return cv2.warpAffine(image, M, image.shape[::-1], borderMode=cv2.BORDER_REPLICATE)


DAMAGES: dict[str, tuple[str, Callable[[list[StereoFrame]], list[StereoFrame]]]] = {
    'three rows': ('rows_apart', right(lambda image: np.roll(image, 3, axis=0))),
    'a roll of two degrees': ('rows_apart', right(rolled)),
    'eyes exchanged': (
        'eyes_swapped',
        lambda frames: [replace(f, left=f.right, right=f.left) for f in frames],
    ),
    'one image twice': ('same_image', lambda frames: [replace(f, right=f.left) for f in frames]),
    'an eye upside down': ('different_views', right(lambda image: image[::-1, ::-1].copy())),
    'a frame late': (
        'not_simultaneous',
        lambda frames: [replace(f, right=b.right) for b, f in pairwise(frames)],
    ),
    'principal point +5 px': ('principal_points', right(lambda image: np.roll(image, -5, axis=1))),
    'principal point -5 px': ('principal_points', right(lambda image: np.roll(image, 5, axis=1))),
    'out of focus': ('blurred', both(lambda image: cv2.GaussianBlur(image, (0, 0), 3))),
    'a tenth of the light': ('dark', both(lambda image: image // 10)),
    'one eye darker': ('eyes_differ', right(lambda image: (image / 1.5).astype(np.uint8))),
}
"""Of each damage the fault that it is, and what it does to the frames."""


@pytest.mark.slow
@pytest.mark.parametrize('recording', ['corridor', 'library', 'kitti06'])
def test_each_damage_of_a_real_camera_is_one_line_within_fifty_frames(
    shared_data, recording
) -> None:
    """The eyes of the library's camera start to move after some looks: it is begun there."""
    source = opened(shared_data / recording)
    start = 80 if recording == 'library' else 0
    drive = list(islice(source.frames(), start, start + SETTLED_FRAMES + 1))
    assert faults(drive, source.camera) == {}
    for damage, (name, change) in DAMAGES.items():
        found = faults(change(drive)[:SETTLED_FRAMES], source.camera)
        assert set(found) == {name}, damage
        line = found[name].line()
        assert '\n' not in line
        assert ';' in line
        assert name == 'same_image' or any(c.isdigit() for c in line), damage
