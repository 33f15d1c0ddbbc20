"""Rectified images against the picture that an ideal camera would have taken."""

import dataclasses

import numpy as np
import pytest
from camera_recordings import calibration, grey_pairs
from numpy.typing import NDArray
from test_stereo_calibration import COEFFICIENTS, T_RIGHT_LEFT, project, raw_eye

from segfloor_ros.apps.recordings.extrinsics import calibration_from_extrinsics
from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.camera.rectification import StereoRectifier
from segfloor_ros.core.errors import CalibrationError


def brightness(rays: NDArray[np.floating]) -> NDArray[np.uint8]:
    """A scene at infinity: brightness (n,) by the direction of rays (n, 2) = (x/z, y/z)."""
    values = 127 + 100 * np.sin(9 * rays[:, 0]) * np.cos(7 * rays[:, 1])
    return np.round(values).astype(np.uint8)


def pixel_grid(width: int, height: int) -> NDArray[np.float64]:
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    return np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)


def small_eye(model: str, cx: float) -> EyeCalibration:
    """A quarter of the size, for speed."""
    eye = raw_eye(model, cx)
    K = np.diag([0.25, 0.25, 1.0]) @ eye.K
    return dataclasses.replace(eye, width=160, height=120, K=K, P=np.hstack([K, np.zeros((3, 1))]))


def raw_image(eye: EyeCalibration) -> NDArray[np.uint8]:
    """What the raw camera sees of the scene: the distortion is inverted pixel by pixel, by
    fixed-point iteration of OpenCV's forward projection.
    """
    pixels = pixel_grid(eye.width, eye.height)
    focal = eye.K[[0, 1], [0, 1]]
    rays = (pixels - eye.K[:2, 2]) / focal
    for _ in range(40):
        points = np.column_stack([rays, np.ones(len(rays))])
        rays = rays - (project(eye, points).reshape(-1, 2) - pixels) / focal
    return brightness(rays).reshape(eye.height, eye.width)


def ideal_image(eye: EyeCalibration) -> NDArray[np.uint8]:
    """What the rectified camera sees of the scene."""
    pixels = np.column_stack([pixel_grid(eye.width, eye.height), np.ones(eye.width * eye.height)])
    rays = pixels @ np.linalg.inv(eye.P[:, :3]).T @ eye.R  # R.T @ ray, for rows
    return brightness(rays[:, :2] / rays[:, 2:]).reshape(eye.height, eye.width)


@pytest.mark.parametrize('model', COEFFICIENTS)
def test_rectified_images_are_those_of_the_ideal_camera(model: str) -> None:
    eyes = small_eye(model, 320.0), small_eye(model, 330.0)
    pair = calibration_from_extrinsics(*eyes, T_RIGHT_LEFT)
    images = StereoRectifier(pair).rectify(raw_image(pair.left), raw_image(pair.right))
    for image, eye in zip(images, (pair.left, pair.right), strict=True):
        assert image.dtype == np.uint8
        inner = np.s_[10:-10, 10:-10]
        error = np.abs(image[inner].astype(int) - ideal_image(eye)[inner])
        assert np.percentile(error, 99) <= 2


def test_what_lies_beyond_the_lens_of_a_fisheye_is_no_image() -> None:
    """Of k1 = -0.2 the radius falls again from 1 / sqrt(0.6) rad = 74 degrees on."""
    K = np.array([[60.0, 0.0, 79.5], [0.0, 60.0, 59.5], [0.0, 0.0, 1.0]])
    P = np.array([[10.0, 0.0, 79.5, 0.0], [0.0, 10.0, 59.5, 0.0], [0.0, 0.0, 1.0, 0.0]])
    left = EyeCalibration(160, 120, K, [-0.2, 0.0, 0.0, 0.0], np.eye(3), P, 'equidistant')
    right = dataclasses.replace(left, P=P - [[1.0 * (i == 3) for i in range(4)], [0] * 4, [0] * 4])
    raw = np.full((120, 160), 200, np.uint8)
    view, _ = StereoRectifier(StereoCalibration(left, right)).rectify(raw, raw)
    pixels = pixel_grid(160, 120) - (79.5, 59.5)
    angle = np.degrees(np.arctan(np.linalg.norm(pixels, axis=1) / 10)).reshape(120, 160)
    assert (view[angle > 76] == 0).all()
    assert (view[angle < 72] == 200).all()


def test_rectified_pairs_pass_through() -> None:
    left, right = grey_pairs(1)[0]
    images = StereoRectifier(calibration()).rectify(left, right)
    assert images[0] is left
    assert images[1] is right


def test_a_shifted_principal_point_shifts_the_right_image_only() -> None:
    left_eye, right_eye = calibration().left, calibration().right
    P = right_eye.P.copy()
    P[0, 2] += 3.0
    pair = StereoCalibration(left_eye, dataclasses.replace(right_eye, K=P[:, :3], P=P))
    left, right = grey_pairs(1)[0]
    images = StereoRectifier(pair).rectify(left, right)
    np.testing.assert_array_equal(images[0], left)
    np.testing.assert_array_equal(images[1][:, :-3], right[:, 3:])
    assert not images[1][:, -3:].any()


def test_images_of_another_size_are_refused() -> None:
    left, right = grey_pairs(1, width=60)[0]
    with pytest.raises(CalibrationError, match=r'left image is 60x48, but left is .* 64x48'):
        StereoRectifier(calibration()).rectify(left, right)
