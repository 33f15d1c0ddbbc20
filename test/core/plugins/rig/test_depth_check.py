"""Depth that does not belong to its image shows at the edges."""

import cv2
import numpy as np
import pytest
from camera_recordings import opened

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import InputFault, StereoFrame
from segfloor_ros.core.plugins.rig.check import RigCheck

WIDTH, HEIGHT = 640, 480
FRAME_NS = 33_000_000
FRAMES = 120


class Boxes:
    """Boxes before a textured wall, seen by a camera that looks around; depth has holes."""

    def __init__(self) -> None:
        rng = np.random.default_rng(3)
        self._rng = rng
        self._wall = rng.integers(90, 130, (HEIGHT // 4, 2 * WIDTH // 4)).astype(np.uint8)
        self._boxes = [
            (rng.uniform(0.1, 1.6), rng.uniform(0.1, 0.7), rng.uniform(15, 60), rng.integers(256))
            for _ in range(14)
        ]

    def frame(self, index: int, depth_at: float | None = None) -> StereoFrame:
        """Return image and disparity; depth_at: when the disparity is measured instead."""
        image, _ = self._seen(index)
        _, disparity = self._seen(index if depth_at is None else depth_at)
        return StereoFrame(index, index * FRAME_NS, image, disparity)

    def _seen(self, index: float) -> tuple[np.ndarray, np.ndarray]:
        left_px = 300 + 200 * np.sin(index / 9.0) + 60 * np.sin(index / 3.1)
        wall = cv2.resize(self._wall, (2 * WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        image = np.roll(wall, -int(left_px / 4), axis=1)[:, :WIDTH].copy()
        disparity = np.full((HEIGHT, WIDTH), 8.0, np.float32)
        for x, y, near_px, grey in sorted(self._boxes, key=lambda box: box[2]):
            corner = int(x * WIDTH - left_px * (0.25 + near_px / 1000)), int(y * HEIGHT)
            other = corner[0] + int(1.5 * near_px), corner[1] + int(2 * near_px)
            cv2.rectangle(image, corner, other, int(grey), -1)
            cv2.rectangle(disparity, corner, other, float(near_px), -1)
        disparity[self._rng.random((HEIGHT, WIDTH)) < 0.02] = 0
        return image, disparity


def faults(frames: list[StereoFrame]) -> dict[str, InputFault]:
    check = RigCheck(StereoCamera(WIDTH, HEIGHT, 500.0, 500.0, 320.0, 240.0, 0.075))
    for frame in frames:
        check.see(frame)
    return check.faults


@pytest.fixture(scope='module')
def boxes() -> Boxes:
    return Boxes()


def with_depth(frames: list[StereoFrame], change) -> list[StereoFrame]:
    return [StereoFrame(f.index, f.stamp_ns, f.left, change(f.right)) for f in frames]


def test_depth_that_belongs_to_its_image_has_no_fault(boxes) -> None:
    frames = [boxes.frame(i) for i in range(FRAMES)]
    assert faults(frames) == {}
    assert (
        faults(
            [
                StereoFrame(i, i * FRAME_NS, f.left, f.right)
                for i, f in enumerate(frames[:1] * FRAMES)
            ]
        )
        == {}
    )


@pytest.mark.parametrize('shift', [(0, 12), (8, 0), (-20, 10)])
def test_depth_that_is_shifted_is_found_with_its_shift(boxes, shift) -> None:
    frames = [boxes.frame(i) for i in range(50)]
    found = faults(with_depth(frames, lambda d: np.roll(d, shift, axis=(1, 0))))
    assert set(found) == {'depth_unaligned'}
    assert found['depth_unaligned'].value == pytest.approx(np.hypot(*shift), abs=3)
    assert 'registered' in found['depth_unaligned'].line()


def test_depth_of_another_field_of_view_is_found(boxes) -> None:
    zoom = np.array([[1.08, 0, -0.04 * WIDTH], [0, 1.08, -0.04 * HEIGHT]])
    frames = [boxes.frame(i) for i in range(50)]
    found = faults(
        with_depth(
            frames, lambda d: cv2.warpAffine(d, zoom, d.shape[::-1], flags=cv2.INTER_NEAREST)
        )
    )
    assert set(found) == {'depth_unaligned'}
    assert '0.92 times' in found['depth_unaligned'].finding


def test_depth_of_a_lens_that_is_not_that_of_the_image_is_found(boxes) -> None:
    """As a RealSense gives it that is not told to register depth to colour."""
    wide = 1 / 1.59
    zoom = np.array([[wide, 0, (1 - wide) * WIDTH / 2 + 6], [0, wide, (1 - wide) * HEIGHT / 2]])
    found = faults(
        with_depth(
            [boxes.frame(i) for i in range(50)],
            lambda d: cv2.warpAffine(d, zoom, d.shape[::-1], flags=cv2.INTER_NEAREST),
        )
    )
    assert set(found) == {'depth_unaligned'}
    assert '1.60 times as large' in found['depth_unaligned'].finding
    assert found['depth_unaligned'].line().startswith('image and depth are not aligned')


@pytest.mark.parametrize('lag', [1, 2])
def test_depth_that_is_late_is_found_with_its_lag(boxes, lag) -> None:
    found = faults([boxes.frame(i, i - lag) for i in range(FRAMES)])
    assert set(found) == {'not_simultaneous'}
    assert found['not_simultaneous'].value == pytest.approx(lag * FRAME_NS * 1e-6, abs=1)
    assert 'the depth one lags' in found['not_simultaneous'].line()


@pytest.mark.slow
@pytest.mark.parametrize(('shift_px', 'expected'), [(0, set()), (20, {'depth_unaligned'})])
def test_depth_of_a_real_camera(shared_data, shift_px, expected) -> None:
    frames = list(opened(shared_data / 'kitchen').frames())[:60]
    found = faults(with_depth(frames, lambda d: np.roll(d, shift_px, axis=1)))
    assert set(found) == expected
