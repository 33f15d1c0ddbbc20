"""Calibrations of all models and files, checked by projecting points with independent means."""

import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from camera_recordings import (
    BASELINE_M,
    FX,
    HEIGHT,
    P_LEFT,
    P_RIGHT,
    WIDTH,
    K,
    calibration,
    kitti_line,
    sensor_yaml,
)
from scipy.spatial.transform import Rotation

from segfloor_ros.apps.calibration import rectified_pixels
from segfloor_ros.apps.recordings.calibration_files import (
    find_calibration,
    given_calibration,
    read_calibration,
    read_kitti_calibration,
    write_ros_calibration,
)
from segfloor_ros.apps.recordings.extrinsics import calibration_from_extrinsics
from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.errors import CalibrationError
from segfloor_ros.core.geometry import make_transform, transform_points

COEFFICIENTS = {
    'plumb_bob': (-0.25, 0.06, 0.001, -0.0008, 0.002),
    'rational_polynomial': (0.3, 0.02, 0.0005, -0.0003, 0.001, 0.6, 0.1, 0.004),
    'equidistant': (0.02, -0.005, 0.003, -0.001),
}
T_RIGHT_LEFT = make_transform(
    Rotation.from_euler('xyz', [1.5, -2.0, 1.0], degrees=True).as_matrix(),
    np.array([-0.11, 0.004, -0.003]),
)


def raw_eye(model: str, cx: float = 320.0, origin: str = 'eye') -> EyeCalibration:
    K = np.array([[300.0, 0.0, cx], [0.0, 302.0, 236.0], [0.0, 0.0, 1.0]])
    P = np.hstack([K, np.zeros((3, 1))])
    return EyeCalibration(640, 480, K, COEFFICIENTS[model], np.eye(3), P, model, origin)


def project(eye: EyeCalibration, points: np.ndarray) -> np.ndarray:
    """Project points (n, 3) of the raw optical frame with OpenCV's forward model."""
    zero = np.zeros(3)
    if eye.distortion_model == 'equidistant':
        pixels, _ = cv2.fisheye.projectPoints(points.reshape(-1, 1, 3), zero, zero, eye.K, eye.D)
    else:
        pixels, _ = cv2.projectPoints(points, zero, zero, eye.K, eye.D)
    return pixels.reshape(-1, 1, 2)


@pytest.mark.parametrize('model', COEFFICIENTS)
def test_points_seen_by_both_eyes_lie_on_one_row_at_the_disparity_of_their_depth(
    model: str,
) -> None:
    pair = calibration_from_extrinsics(raw_eye(model), raw_eye(model, 330.0), T_RIGHT_LEFT)
    points_left = np.random.default_rng(1).uniform((-1, -0.8, 2), (1, 0.8, 6), (50, 3))
    points_right = transform_points(T_RIGHT_LEFT, points_left)
    uv_left = rectified_pixels(pair.left, project(pair.left, points_left))
    uv_right = rectified_pixels(pair.right, project(pair.right, points_right))
    depth_m = (points_left @ pair.left.R.T)[:, 2]
    assert pair.camera.baseline_m == pytest.approx(np.linalg.norm(T_RIGHT_LEFT[:3, 3]))
    np.testing.assert_allclose(uv_left[:, 1], uv_right[:, 1], atol=1e-3)
    disparity = pair.camera.disparity_times_depth / depth_m
    np.testing.assert_allclose(uv_left[:, 0] - uv_right[:, 0], disparity, atol=1e-3)
    # Back-projection gives the point back, in the rectified left frame.
    points = pair.camera.back_project(uv_left, depth_m)
    np.testing.assert_allclose(points, points_left @ pair.left.R.T, atol=1e-4)


@pytest.mark.parametrize('model', COEFFICIENTS)
def test_ros_files_return_every_number(tmp_path: Path, model: str) -> None:
    pair = calibration_from_extrinsics(raw_eye(model), raw_eye(model, 330.0), T_RIGHT_LEFT)
    left, right = tmp_path / 'left.yaml', tmp_path / 'right.yaml'
    write_ros_calibration(left, pair.left, 'left')
    write_ros_calibration(right, pair.right, 'right')
    again = read_calibration(left, right)
    assert again.camera == pair.camera
    for eye, other in ((again.left, pair.left), (again.right, pair.right)):
        assert (eye.width, eye.height, eye.distortion_model) == (640, 480, model)
        for name in 'KDRP':
            np.testing.assert_array_equal(getattr(eye, name), getattr(other, name))


def test_kitti_projections_give_focal_length_and_baseline(tmp_path: Path) -> None:
    path = tmp_path / 'calib.txt'
    path.write_text(kitti_line('P0', P_LEFT) + kitti_line('P1', P_RIGHT))
    pair = read_kitti_calibration(path, WIDTH, HEIGHT)
    assert pair.is_rectified
    assert (pair.camera.width, pair.camera.height) == (WIDTH, HEIGHT)
    assert (pair.camera.fx, pair.camera.cx, pair.camera.cy) == (FX, 32.0, 24.0)
    assert pair.camera.baseline_m == pytest.approx(BASELINE_M)


def test_kitti_colour_cameras_have_the_baseline_between_each_other(tmp_path: Path) -> None:
    # The projections are relative to camera 0: 0.06 m and -0.48 m along x, fx = 50.
    P2, P3 = P_LEFT.copy(), P_LEFT.copy()
    P2[:, 3], P3[:, 3] = (50 * 0.06, 0.2, 0.003), (-50 * 0.48, 0.1, 0.002)
    path = tmp_path / 'calib.txt'
    path.write_text(kitti_line('P2', P2) + kitti_line('P3', P3))
    pair = read_kitti_calibration(path, WIDTH, HEIGHT, (2, 3))
    assert pair.camera.baseline_m == pytest.approx(0.54)
    assert pair.left.P[0, 3] == 0.0
    np.testing.assert_allclose(pair.right.P[:, 3], [-50 * 0.54, 0.0, 0.0])


def test_euroc_poses_give_the_baseline(tmp_path: Path) -> None:
    # Both cameras look along the body's x; the right one is 0.2 m to the body's right (-y).
    R_body_eye = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    left, right = tmp_path / 'cam0.yaml', tmp_path / 'cam1.yaml'
    left.write_text(sensor_yaml(make_transform(R_body_eye, np.array([0.1, 0.3, 0.0]))))
    right.write_text(sensor_yaml(make_transform(R_body_eye, np.array([0.1, 0.1, 0.0]))))
    pair = read_calibration(left, right)
    assert pair.left.distortion_model == 'plumb_bob'
    assert pair.camera.baseline_m == pytest.approx(0.2)
    np.testing.assert_allclose(pair.left.R, np.eye(3), atol=1e-12)


KALIBR = """
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.02, -0.005, 0.003, -0.001]
  distortion_model: equidistant
  intrinsics: [300.0, 302.0, 320.0, 236.0]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1: {rows}
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [0.02, -0.005, 0.003, -0.001]
  distortion_model: equidistant
  intrinsics: [300.0, 302.0, 330.0, 236.0]
  resolution: [640, 480]
"""


def kalibr_file(folder: Path, old: str = '', new: str = '') -> Path:
    text = KALIBR.replace('{rows}', str(T_RIGHT_LEFT.tolist()))
    path = folder / 'camchain.yaml'
    path.write_text(text.replace(old, new, 1))
    return path


def test_kalibr_files_hold_both_cameras(tmp_path: Path) -> None:
    path = kalibr_file(tmp_path)
    model = 'equidistant'
    expected = calibration_from_extrinsics(raw_eye(model), raw_eye(model, 330.0), T_RIGHT_LEFT)
    given = given_calibration(StereoCameraSettings(left_calibration=str(path)))
    found = find_calibration('drive', (tmp_path,), StereoCameraSettings())
    for pair in (read_calibration(path, path), given, found):
        assert pair is not None
        assert pair.camera.baseline_m == pytest.approx(expected.camera.baseline_m)
        for eye, other in ((pair.left, expected.left), (pair.right, expected.right)):
            for name in 'KRP':
                np.testing.assert_allclose(getattr(eye, name), getattr(other, name), atol=1e-9)
            assert eye.distortion_model == model
            np.testing.assert_array_equal(eye.D, [0.02, -0.005, 0.003, -0.001])


@pytest.mark.parametrize(
    ('old', 'new', 'message'),
    [
        ('pinhole', 'ds', 'camchain.yaml, cam0: unknown camera model ds; calibrate it as pinhole'),
        ('equidistant', 'fov', 'cam0: unknown distortion model fov; known are plumb_bob'),
        ('T_cn_cnm1', 'T', 'cam1: T_cn_cnm1 is missing'),
        ('intrinsics', 'focal', 'cam0: intrinsics is missing'),
        ('cam0', 'camera0', 'camchain.yaml: cam0 is missing'),
    ],
)
def test_faults_in_kalibr_files_are_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = kalibr_file(tmp_path, old, new)
    with pytest.raises(CalibrationError, match=message):
        read_calibration(path, path)


def test_the_view_of_a_fisheye_keeps_its_share_of_the_resolution_in_the_middle() -> None:
    model = 'equidistant'
    pair = calibration_from_extrinsics(raw_eye(model), raw_eye(model, 330.0), T_RIGHT_LEFT)
    # Two directions a degree apart, around the middle of the view.
    middle = np.array([pair.camera.width - 1, pair.camera.height - 1]) / 2
    for eye in (pair.left, pair.right):
        ray = np.linalg.solve(eye.P[:, :3], [*middle, 1.0])
        turned = Rotation.from_rotvec([0.0, np.radians(1.0), 0.0]).apply(ray)
        raw = project(eye, np.array([ray, turned]) @ eye.R)
        view = rectified_pixels(eye, raw)
        size_px = [np.linalg.norm(uv[1].ravel() - uv[0].ravel()) for uv in (view, raw)]
        assert size_px[0] / size_px[1] == pytest.approx(0.7, abs=0.02)


def test_a_fisheye_is_rectified_whatever_its_coefficients() -> None:
    eye = dataclasses.replace(raw_eye('equidistant'), D=np.zeros(4))
    assert not eye.is_rectified
    assert dataclasses.replace(eye, distortion_model='plumb_bob').is_rectified


def test_coefficients_that_a_driver_fills_up_with_zeros_are_taken() -> None:
    eye = dataclasses.replace(raw_eye('equidistant'), D=[0.1, 0.02, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(eye.D, [0.1, 0.02, 0.0, 0.0])
    with pytest.raises(CalibrationError, match='equidistant has 4 coefficients, not 5'):
        dataclasses.replace(eye, D=[0.1, 0.02, 0.0, 0.0, 0.3])


def test_right_intrinsics_become_the_left_ones_and_the_baseline_stays() -> None:
    left, right = calibration().left, calibration().right
    P = right.P.copy()
    P[0, 2] += 3.0  # principal points apart, as without CALIB_ZERO_DISPARITY
    pair = StereoCalibration(left, dataclasses.replace(right, K=P[:, :3], P=P))
    np.testing.assert_allclose(pair.right.P, right.P)
    assert pair.left.is_rectified
    assert not pair.right.is_rectified  # its pixels have to be shifted by 3


def test_rectified_images_have_the_projection_as_intrinsics() -> None:
    pair = calibration(distorted=True)
    assert not pair.is_rectified
    assert pair.rectified().is_rectified
    assert pair.rectified().camera == pair.camera


def test_calibrations_cannot_be_changed() -> None:
    eye = calibration().left
    with pytest.raises(ValueError, match='read-only'):
        eye.K[0, 0] = 1.0


def test_no_distortion_coefficients_mean_none() -> None:
    eye = dataclasses.replace(calibration().left, D=[], distortion_model='')
    assert eye.is_rectified
    assert eye.distortion_model == 'plumb_bob'


def with_entry(array: np.ndarray, index: tuple[int, int], value: float) -> np.ndarray:
    changed = array.copy()
    changed[index] = value
    return changed


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'K': with_entry(K, (0, 0), 0.0)}, r'eye: K\[0\] = 0, so .* calibrate the pair first'),
        ({'P': np.zeros((3, 4))}, r'eye: P\[0\] = 0, so .* calibrate'),
        ({'K': with_entry(K, (1, 1), np.nan)}, 'eye: K holds values that are not finite; calib'),
        ({'D': [0.1, np.inf, 0, 0, 0]}, 'eye: D holds values that are not finite'),
        ({'D': [0.1, 0.2, 0.3]}, 'eye: plumb_bob has 4 or 5 coefficients, not 3'),
        ({'K': np.eye(4)}, 'eye: K has 16 numbers instead of 9'),
        ({'R': np.zeros((3, 3))}, 'eye: the rectification R is not a rotation; calibrate'),
        ({'distortion_model': 'mei'}, 'eye: unknown distortion model mei; known are plumb_bob'),
        ({'width': 0}, 'eye: image size 0x48 is impossible'),
        ({'width': 30}, r'eye: the principal point \(32, 24\) lies outside .* 30x48; use the'),
    ],
)
def test_impossible_eyes_are_refused(changes: dict[str, Any], message: str) -> None:
    eye = dataclasses.replace(calibration().left, origin='eye')
    with pytest.raises(CalibrationError, match=message):
        dataclasses.replace(eye, **changes)


@pytest.mark.parametrize('offset', [0.0, 5.0])
def test_zero_and_negative_baselines_are_refused(offset: float) -> None:
    right = calibration().right
    P = with_entry(right.P, (0, 3), offset)
    with pytest.raises(CalibrationError, match=r'right: baseline .* must be positive: are left'):
        StereoCalibration(calibration().left, dataclasses.replace(right, P=P))


def test_a_baseline_in_millimetres_is_refused() -> None:
    right = calibration().right
    P = with_entry(right.P, (0, 3), 1000 * right.P[0, 3])
    with pytest.raises(CalibrationError, match=r'right: baseline is .*; are lengths in millimetre'):
        StereoCalibration(calibration().left, dataclasses.replace(right, P=P))


def test_eyes_of_different_size_are_refused() -> None:
    right = dataclasses.replace(calibration().right, width=80)
    with pytest.raises(CalibrationError, match='left is for images of 64x48, right for 80x48'):
        StereoCalibration(calibration().left, right)


def test_eyes_of_different_models_have_no_common_rectification() -> None:
    eyes = raw_eye('plumb_bob', origin='one'), raw_eye('equidistant', origin='other')
    with pytest.raises(CalibrationError, match='one is plumb_bob, other is equidistant; both'):
        calibration_from_extrinsics(*eyes, T_RIGHT_LEFT)


@pytest.mark.parametrize(
    ('old', 'new', 'message'),
    [
        ('image_width: 64', 'image_width: wide', "left.yaml, image_width = 'wide': expected a wh"),
        ('projection_matrix', 'projection', 'left.yaml: projection_matrix is missing; a stereo'),
        ('camera_matrix', 'camera', 'left.yaml: camera_matrix is missing'),
        ('data: [50.0, ', 'data: [', 'left.yaml, camera_matrix: expected 9 numbers, found 8'),
        ('data: [50.0, ', 'data: [wide, ', 'left.yaml, camera_matrix: expected finite numbers'),
        ('data: [50.0, ', 'data: [0.0, ', r'left.yaml: K\[0\] = 0, so .* calibrate the pair'),
        ('image_width: 64', '{', 'left.yaml, line 4: not valid YAML'),
    ],
)
def test_faults_in_ros_files_are_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    left, right = tmp_path / 'left.yaml', tmp_path / 'right.yaml'
    write_ros_calibration(left, calibration().left, 'left')
    write_ros_calibration(right, calibration().right, 'right')
    text = left.read_text()
    assert old in text
    left.write_text(text.replace(old, new, 1))
    with pytest.raises(CalibrationError, match=message):
        read_calibration(left, right)


def test_missing_and_empty_files_are_named(tmp_path: Path) -> None:
    left, right = tmp_path / 'left.yaml', tmp_path / 'right.yaml'
    with pytest.raises(CalibrationError, match=r'left.yaml: the calibration is missing; put it'):
        read_calibration(left, right)
    left.write_text('')
    with pytest.raises(CalibrationError, match=r'left.yaml: expected a calibration'):
        read_calibration(left, right)
    with pytest.raises(CalibrationError, match=r'calib.txt: the calibration is missing'):
        read_kitti_calibration(tmp_path / 'calib.txt', WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('P0: 1 2 3\n', 'calib.txt, P0: expected 12 numbers, found 3'),
        (kitti_line('P0', P_LEFT), 'calib.txt: no line P1: with the projection of camera 1'),
        (
            kitti_line('P0', P_LEFT) + kitti_line('P1', P_LEFT),
            'calib.txt, P1: baseline is 0 m, it must be positive',
        ),
    ],
)
def test_faults_in_kitti_files_are_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / 'calib.txt'
    path.write_text(text)
    with pytest.raises(CalibrationError, match=message):
        read_kitti_calibration(path, WIDTH, HEIGHT)


def test_faults_in_euroc_files_are_named(tmp_path: Path) -> None:
    left, right = tmp_path / 'cam0.yaml', tmp_path / 'cam1.yaml'
    text = sensor_yaml(np.eye(4))
    right.write_text(text)
    left.write_text(text.replace('intrinsics', 'internals'))
    with pytest.raises(CalibrationError, match=r'cam0.yaml: intrinsics is missing'):
        read_calibration(left, right)
    left.write_text(text)
    with pytest.raises(CalibrationError, match=r'cam1.yaml: the right camera is at \(0, 0, 0\)'):
        read_calibration(left, right)
