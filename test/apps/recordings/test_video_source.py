"""Side-by-side videos."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_recordings import HEIGHT, MS, WIDTH, calibration, opened

from segfloor_ros.apps.recordings import opening as device
from segfloor_ros.apps.recordings.calibration_files import write_ros_calibration
from segfloor_ros.apps.recordings.opening import is_device
from segfloor_ros.core.errors import CalibrationError, InputError


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
    ('name', 'expected'),
    [
        ('0', True),
        ('/dev/video2', True),
        ('0,2', True),
        ('video2', False),
        ('0,', False),
        ('', False),
    ],
)
def test_devices_are_told_by_their_name(name: str, expected: bool) -> None:
    assert is_device(Path(name)) == expected


class Camera:
    """A stand-in for a camera on a USB port, of which there is none where tests run."""

    grabs_left = 10**9
    closed_for = 0
    """So many times it cannot be opened once its grabs are used up; then it is back."""

    asked: dict[int, dict[int, float]]

    def __init__(self, number: int) -> None:
        self.number, self.set_values = number, Camera.asked.setdefault(number, {})

    def isOpened(self) -> bool:
        if Camera.grabs_left > 0:
            return True
        Camera.closed_for -= 1
        if Camera.closed_for < 0:
            Camera.grabs_left = 10**9
        return Camera.grabs_left > 0

    def set(self, what: int, value: float) -> None:
        self.set_values[what] = value

    def grab(self) -> bool:
        Camera.grabs_left -= 1
        return Camera.grabs_left >= 0

    def retrieve(self) -> tuple[bool, np.ndarray]:
        width = int(self.set_values[cv2.CAP_PROP_FRAME_WIDTH])
        image = np.full((HEIGHT, width, 3), 50 + self.number, np.uint8)
        image[:, WIDTH:] += 20
        return True, image

    def release(self) -> None:
        pass


@pytest.fixture
def plugged_in(tmp_path, monkeypatch):
    write_calibrations(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cv2, 'VideoCapture', Camera)
    monkeypatch.setattr(device, 'RETRY_S', 0.0)
    monkeypatch.setattr(device, 'PATIENCE_S', 0.2)
    monkeypatch.setattr(Camera, 'grabs_left', 10**9)
    monkeypatch.setattr(Camera, 'closed_for', 0)
    monkeypatch.setattr(Camera, 'asked', {}, raising=False)


@pytest.mark.parametrize(('name', 'grey'), [('3', (53, 73)), ('3,5', (53, 55))])
def test_a_device_shows_both_eyes_side_by_side_and_two_devices_one_each(
    plugged_in, name, grey
) -> None:
    pairs = opened(Path(name), exposure_s=0.004, rate_hz=30.0).frames()
    first, second = next(pairs), next(pairs)
    assert (first.left.mean(), first.right.mean()) == grey
    assert second.stamp_ns > first.stamp_ns
    for asked in Camera.asked.values():
        assert asked[cv2.CAP_PROP_FRAME_WIDTH] == (WIDTH if ',' in name else 2 * WIDTH)
        assert asked[cv2.CAP_PROP_FPS] == 30.0
        # V4L2 counts in 0.1 ms, and only a manual exposure is kept.
        assert asked[cv2.CAP_PROP_EXPOSURE] == pytest.approx(40.0)
        assert asked[cv2.CAP_PROP_AUTO_EXPOSURE] == device.V4L2_MANUAL
    pairs.close()


def test_a_camera_that_comes_back_goes_on_and_one_that_does_not_ends(plugged_in, caplog) -> None:
    source = opened(Path('3'))
    Camera.grabs_left, Camera.closed_for = 2, 3
    frames = source.frames()
    indices = [next(frames).index for _ in range(5)]
    assert indices == [0, 1, 2, 3, 4]
    assert 'sends no images any more' in caplog.text and 'is back after' in caplog.text
    frames.close()
    caplog.clear()
    Camera.grabs_left, Camera.closed_for = 2, 10**9
    assert len(list(source.frames())) == 2
    assert 'did not come back within' in caplog.text
