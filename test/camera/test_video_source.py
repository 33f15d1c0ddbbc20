"""Side-by-side videos."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_recordings import HEIGHT, MS, WIDTH, calibration, opened

from segfloor_ros.camera.calibration.files import write_ros_calibration
from segfloor_ros.camera.sources.opening import is_device
from segfloor_ros.errors import CalibrationError, InputError


def write_video(path: Path, count: int, rate_hz: float = 20.0, width: int = WIDTH) -> Path:
    """Frame i is 40 + 20 i on the left and 15 brighter on the right."""
    codec = cv2.VideoWriter_fourcc(*'MJPG')
    video = cv2.VideoWriter(str(path), codec, rate_hz, (2 * width, HEIGHT))
    assert video.isOpened()
    for i in range(count):
        image = np.full((HEIGHT, 2 * width, 3), 40 + 20 * i, np.uint8)
        image[:, width:] += 15
        video.write(image)
    video.release()
    return path


def write_calibrations(folder: Path) -> None:
    write_ros_calibration(folder / 'left.yaml', calibration().left, 'left')
    write_ros_calibration(folder / 'right.yaml', calibration().right, 'right')


def test_videos_are_cut_in_halves_and_stamped_by_their_rate(tmp_path: Path) -> None:
    write_calibrations(tmp_path)
    source = opened(write_video(tmp_path / 'drive.avi', 5))
    assert (source.frame_count, source.rate_hz) == (5, 20.0)
    frames = list(source.frames())
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    assert [frame.stamp_ns for frame in frames] == [i * 50 * MS for i in range(5)]
    for i, frame in enumerate(frames):
        assert frame.left.shape == frame.right.shape == (HEIGHT, WIDTH)
        assert abs(float(frame.left.mean()) - (40 + 20 * i)) < 3  # JPEG
        assert abs(float(frame.right.mean()) - (55 + 20 * i)) < 3


def test_a_given_rate_stamps_the_frames(tmp_path: Path) -> None:
    write_calibrations(tmp_path)
    source = opened(write_video(tmp_path / 'drive.avi', 3), rate_hz=10.0)
    assert [frame.stamp_ns for frame in source.frames()] == [0, 100 * MS, 200 * MS]


def test_faults_of_videos_are_named(tmp_path: Path) -> None:
    path = write_video(tmp_path / 'drive.avi', 2, width=80)
    with pytest.raises(CalibrationError, match=r'drive.avi: no calibration; put left.yaml and'):
        opened(path)
    write_calibrations(tmp_path)
    with pytest.raises(CalibrationError, match=r'frame 0 is 80x48, but .*left.yaml is .* 64x48'):
        opened(path)
    path.write_bytes(b'no video')
    with pytest.raises(InputError, match=r'drive.avi: cannot open the video; is it there and'):
        opened(path)


@pytest.mark.parametrize('name', ['7', '/dev/video7'])
def test_a_device_that_is_not_there_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    write_calibrations(tmp_path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=f'{name}: cannot open the device; is it there and read'):
        opened(Path(name))


@pytest.mark.parametrize(
    ('name', 'expected'), [('0', True), ('/dev/video2', True), ('video2', False), ('', False)]
)
def test_devices_are_told_by_their_name(name: str, expected: bool) -> None:
    assert is_device(name) == expected
