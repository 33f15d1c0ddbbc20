"""The recordings beside the repository: counts, stamps, pixels and epipolar lines."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_recordings import opened
from test_bag_writer import assert_same_recording

from segfloor_ros.apps.calibration import Board, calibrate_folder
from segfloor_ros.apps.recordings import StereoSource
from segfloor_ros.apps.recordings.bag_writer import ImageCoding, convert
from segfloor_ros.core.contracts import StereoFrame


def frame_of(source: StereoSource, index: int) -> StereoFrame:
    frames = source.frames()
    try:
        return next(frame for frame in frames if frame.index == index)
    finally:
        frames.close()  # type: ignore[attr-defined]


def row_differences_px(frame: StereoFrame) -> np.ndarray:
    """Return the differences in rows (n,) of ORB matches between both images, at full size."""
    orb = cv2.ORB_create(3000, nlevels=1, fastThreshold=10)
    left_points, left_words = orb.detectAndCompute(frame.left, None)
    right_points, right_words = orb.detectAndCompute(frame.right, None)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    matches = [m for m in matcher.match(left_words, right_words) if m.distance < 30]
    assert len(matches) > 50
    ends = []
    for image, points, numbers in (
        (frame.left, left_points, [m.queryIdx for m in matches]),
        (frame.right, right_points, [m.trainIdx for m in matches]),
    ):
        uv = np.array([points[number].pt for number in numbers], np.float32).reshape(-1, 1, 2)
        end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 0.01)
        ends.append(cv2.cornerSubPix(image, uv, (3, 3), (-1, -1), end).reshape(-1, 2))
    return ends[0][:, 1] - ends[1][:, 1]


def board_rows_px(image: np.ndarray) -> np.ndarray:
    """Return the rows (54,) of the corners of the chessboard."""
    found, corners = cv2.findChessboardCorners(image, (9, 6))
    assert found
    end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
    return cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), end).reshape(-1, 2)[:, 1]


@pytest.mark.slow
def test_corridor_is_read_as_it_is(shared_data: Path) -> None:
    folder = shared_data / 'corridor'
    source = opened(folder)
    assert (source.frame_count, source.rate_hz) == (255, 10.0)
    assert source.camera.baseline_m == pytest.approx(0.12)
    assert (source.camera.fx, source.camera.cx, source.camera.cy) == pytest.approx((320, 320, 240))
    frame = frame_of(source, 0)
    for image, name in ((frame.left, 'image_0'), (frame.right, 'image_1')):
        expected = cv2.imread(str(folder / name / '000000.png'), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(image, expected)
    assert frame_of(source, 254).stamp_ns == 25_400_000_000


def test_kitti06_has_its_times_and_baseline(shared_data: Path) -> None:
    source = opened(shared_data / 'kitti06')
    stamps = [pair.stamp_ns for pair in source.raw_pairs()]
    assert len(stamps) == source.frame_count == 51
    assert stamps[:3] == [0, 103_600_000, 207_200_000]
    assert (source.camera.width, source.camera.height) == (1226, 370)
    assert source.camera.baseline_m == pytest.approx(0.537, abs=1e-3)


@pytest.mark.slow
def test_library_comes_in_natural_order_and_rectified(shared_data: Path) -> None:
    folder = shared_data / 'library'
    source = opened(folder)
    pairs = list(source.raw_pairs())
    assert len(pairs) == source.frame_count == 346
    assert [pair.stamp_ns for pair in pairs[:3]] == [0, 100_000_000, 200_000_000]
    for index in (1, 9, 99, 345):  # left2, left10, left100, left346
        expected = cv2.imread(str(folder / 'left' / f'left{index + 1}.jpg'), cv2.IMREAD_GRAYSCALE)
        np.testing.assert_array_equal(pairs[index].left, expected)
    # Where the images are sharp the matches lie on one row; blur scatters them about it.
    assert np.median(np.abs(row_differences_px(frame_of(source, 0)))) < 0.5
    for index in (100, 200, 300):
        assert abs(np.median(row_differences_px(frame_of(source, index)))) < 0.5


def test_euroc_is_rectified(shared_data: Path) -> None:
    source = opened(shared_data / 'euroc_tiny')
    frames = list(source.frames())
    assert len(frames) == source.frame_count == 12
    assert frames[0].stamp_ns == 1403715273262142976
    assert source.rate_hz == pytest.approx(20.0, rel=1e-3)
    assert source.camera.baseline_m == pytest.approx(0.110, abs=5e-4)  # Burri et al. 2016
    for frame in (frames[0], frames[-1]):
        assert np.median(np.abs(row_differences_px(frame))) < 0.5
    raw = next(source.raw_pairs())
    unrectified = StereoFrame(raw.index, raw.stamp_ns, raw.left, raw.right)
    assert np.median(np.abs(row_differences_px(unrectified))) > 2.0


def test_a_fisheye_of_16_bits_is_rectified(shared_data: Path) -> None:
    source = opened(shared_data / 'tumvi')
    camera, raw_fx = source.camera, source.calibration.left.K[0, 0]
    assert camera.baseline_m == pytest.approx(0.101, abs=5e-4)  # Schubert et al. 2018
    assert camera.fx == pytest.approx(0.7 * raw_fx, rel=0.01)
    frame = frame_of(source, 8)
    assert np.median(np.abs(row_differences_px(frame))) < 0.5
    # No lamp or window hides the floor: less than a tenth is white, and what is dark is not black.
    assert np.mean(frame.left == 255) < 0.1
    assert np.percentile(frame.left, 5) > 16
    assert [sensor.name for sensor in source.sensors if sensor.used] == ['imu']
    # Held about level: what an IMU feels lies along the image's vertical.
    felt = np.mean([sample.accel_m_s2 for sample in source.sensors[0].read()], axis=0)
    assert -felt[1] / np.linalg.norm(felt) > 0.99


@pytest.mark.slow
@pytest.mark.parametrize('name', ['library', 'euroc_tiny', 'tumvi'])
def test_real_recordings_survive_the_round_trip(
    shared_data: Path, tmp_path: Path, name: str
) -> None:
    source = opened(shared_data / name)
    convert(source, tmp_path / 'copy.mcap', ImageCoding.raw)
    assert_same_recording(source, opened(tmp_path / 'copy.mcap'))


def test_the_chessboard_camera_is_that_of_opencv(shared_data: Path, tmp_path: Path) -> None:
    result = calibrate_folder(shared_data / 'chessboard', Board(9, 6, 0.025), out=tmp_path)
    assert len(result.views) == 13
    storage = cv2.FileStorage(str(shared_data / 'chessboard' / 'intrinsics.yml'), 0)
    published_fx = storage.getNode('M1').mat()[0, 0]
    for eye in (result.calibration.left, result.calibration.right):
        assert eye.K[0, 0] == pytest.approx(published_fx, rel=0.01)
    assert result.rms_px < 0.5
    assert result.epipolar_rms_px < 0.5
    source = opened(
        shared_data / 'chessboard',
        left_calibration=str(tmp_path / 'left.yaml'),
        right_calibration=str(tmp_path / 'right.yaml'),
    )
    assert source.frame_count == 13
    # The board is found again in the rectified images, and its corners on the same rows.
    frame = frame_of(source, 0)
    rows = [board_rows_px(image) for image in (frame.left, frame.right)]
    assert np.sqrt(np.mean((rows[0] - rows[1]) ** 2)) < 0.5
