"""What the fields of a CameraInfo mean, by its message definition."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from segfloor_ros.core.camera.calibration import StereoCalibration
from segfloor_ros.core.camera.camera_info import eye_calibration
from segfloor_ros.core.camera.depth import depth_calibration
from segfloor_ros.core.camera.rectification import StereoRectifier
from segfloor_ros.core.errors import CalibrationError

WIDTH, HEIGHT, F, CX, CY, BASELINE_M = 1280, 960, 800.0, 630.0, 470.0, 0.12
K = (F, 0, CX, 0, F, CY, 0, 0, 1)
LEFT_P = (F, 0, CX, 0, 0, F, CY, 0, 0, 0, 1, 0)
RIGHT_P = (F, 0, CX, -F * BASELINE_M, 0, F, CY, 0, 0, 0, 1, 0)
NONE = {'k': (0.0,) * 9, 'r': (0.0,) * 9, 'p': (0.0,) * 12}
BAD_LENS = {'d': (1.0, 2.0), 'distortion_model': 'of another world'}


def roi(x: int = 0, y: int = 0, width: int = 0, height: int = 0) -> Any:
    return SimpleNamespace(x_offset=x, y_offset=y, width=width, height=height, do_rectify=False)


def info(**changes: Any) -> Any:
    values = {
        'width': WIDTH, 'height': HEIGHT, 'distortion_model': 'plumb_bob', 'd': (0.0,) * 5, 'k': K,
        'r': np.eye(3).ravel(), 'p': LEFT_P, 'binning_x': 0, 'binning_y': 0, 'roi': roi(),
    }  # fmt: skip
    return SimpleNamespace(**values | changes)


def pixel(P: np.ndarray, point: tuple[float, float, float]) -> np.ndarray:
    u, v, w = P @ (*point, 1.0)
    return np.array([u / w, v / w])


@pytest.mark.parametrize('is_rectified', [False, True])
@pytest.mark.parametrize(
    ('changes', 'size'),
    [
        ({}, (1280, 960)),
        ({'binning_x': 1, 'binning_y': 1}, (1280, 960)),
        ({'roi': roi(0, 0, 1280, 960)}, (1280, 960)),
        ({'binning_x': 2, 'binning_y': 2}, (640, 480)),
        ({'binning_x': 4, 'binning_y': 2}, (320, 480)),
        ({'roi': roi(100, 300, 800, 600)}, (800, 600)),
        ({'roi': roi(100, 600, 800, 300)}, (800, 300)),  # below the principal point
        ({'roi': roi(100, 300, 800, 600), 'binning_x': 2, 'binning_y': 2}, (400, 300)),
    ],
)
def test_a_part_of_the_image_keeps_what_its_pixels_look_at(changes, size, is_rectified) -> None:
    eye = eye_calibration(info(p=RIGHT_P, **changes), 'info', is_rectified)
    assert (eye.width, eye.height) == size
    part = info(**changes)
    corner = np.array([part.roi.x_offset, part.roi.y_offset])
    bins = np.maximum([part.binning_x, part.binning_y], 1)
    for point in ((0.3, -0.2, 2.0), (-1.0, 0.7, 5.0)):
        whole = pixel(np.reshape(RIGHT_P, (3, 4)), point)
        # Edges of pixels, not their centres, are divided.
        expected = (whole - corner + 0.5) / bins - 0.5
        np.testing.assert_allclose(pixel(eye.P, point), expected, atol=1e-9)
    if not is_rectified:
        ray = (0.3, -0.2, 2.0)
        expected = (pixel(np.reshape(LEFT_P, (3, 4)), ray) - corner + 0.5) / bins - 0.5
        np.testing.assert_allclose(pixel(np.c_[eye.K, np.zeros(3)], ray), expected, atol=1e-9)


@pytest.mark.parametrize(
    ('changes', 'is_rectified'),
    [
        ({'r': NONE['r']}, False),
        ({'p': NONE['p']}, False),
        ({'p': NONE['p'], 'r': NONE['r']}, False),
        ({'p': NONE['p'], 'r': NONE['r'], 'd': ()}, True),
        ({'k': NONE['k'], 'r': NONE['r']}, True),
        ({'k': NONE['k'], **BAD_LENS}, True),
        ({'r': (1.0,) * 9}, True),
    ],
)
def test_fields_without_values_are_not_asked_for_where_they_are_not_needed(
    changes, is_rectified
) -> None:
    eye = eye_calibration(info(**changes), 'info', is_rectified)
    np.testing.assert_array_equal(eye.K, np.reshape(K, (3, 3)))
    np.testing.assert_array_equal(eye.P, np.reshape(LEFT_P, (3, 4)))
    assert eye.is_rectified
    assert depth_calibration(eye).camera.fx == F


def test_rectified_images_keep_their_own_principal_points() -> None:
    """Without CALIB_ZERO_DISPARITY they differ between the eyes."""
    shifted = list(RIGHT_P)
    shifted[2] += 3.0
    eyes = (eye_calibration(info(p=p), 'info', is_rectified=True) for p in (LEFT_P, shifted))
    pair = StereoCalibration(*eyes)
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    image[400:500, 203:303] = 200
    _, right = StereoRectifier(pair).rectify(image, image)
    assert np.flatnonzero(right[450])[0] == 200


def changed(index: int, value: float, P: tuple[float, ...] = RIGHT_P) -> dict[str, Any]:
    return {'p': (*P[:index], value, *P[index + 1 :])}


@pytest.mark.parametrize(
    ('left', 'right', 'is_rectified', 'message'),
    [
        ({}, changed(1, 12.0), False, r'right: P\[1\] = 12, so P holds a skew or a rotation'),
        ({}, changed(4, -70.0), True, r'right: P\[4\] = -70, so P holds'),
        (changed(8, 0.09, LEFT_P), {}, False, r'left: P\[8\] = 0.09'),
        (changed(9, 0.09, LEFT_P), {}, True, r'left: P\[9\] = 0.09'),
        ({}, changed(10, 0.0), True, r'right: P\[10\] = 0'),
        ({'k': NONE['k']}, {}, False, r'left: K\[0\] = 0, so the camera is not calibrated'),
        ({'k': NONE['k'], 'p': NONE['p']}, {}, True, r'left: P\[0\] = 0, so .* not calibrated'),
        ({}, {'p': NONE['p']}, True, r'right: baseline is 0 m, .* is P\[3\] of the right'),
        ({}, {'p': (*LEFT_P[:7], -F * 0.12, *LEFT_P[8:])}, False, 'right: .* 0.12 m below .* one '
         'above the other is not supported'),
        ({}, {'p': (*LEFT_P[:7], F * 0.12, *LEFT_P[8:])}, True, 'right: .* 0.12 m above the left'),
        ({}, changed(3, -F * 0.00012), True, 'right: baseline is 0.00012 m; are lengths in'),
        ({}, changed(3, -F * 120.0), True, 'right: baseline is 120 m; are lengths in millimetres'),
        ({'roi': roi(640, 480, 640, 481)}, {}, True, r'left: roi, 640x481 from \(640, 480\), '
         'reaches beyond the image of 1280x960'),
        ({'binning_x': 2, 'binning_y': 2}, {}, True, 'left .of its 1280x960, by roi and binning. '
         'is for images of 640x480, right for 1280x960'),
    ],
)  # fmt: skip
def test_impossible_values_are_named(left, right, is_rectified, message) -> None:
    with pytest.raises(CalibrationError, match=message):
        StereoCalibration(
            eye_calibration(info(**left), 'left', is_rectified),
            eye_calibration(info(**{'p': RIGHT_P} | right), 'right', is_rectified),
        )


def test_a_pair_that_kitti_publishes_is_none_above_the_other() -> None:
    """Its P2 and P3 have small offsets along y and z."""
    left = (F, 0, CX, 45.38, 0, F, CY, -0.113, 0, 0, 1, 0.0038)
    right = (F, 0, CX, -337.3, 0, F, CY, 2.37, 0, 0, 1, 0.0049)
    eyes = (eye_calibration(info(p=p), 'info', is_rectified=True) for p in (left, right))
    assert StereoCalibration(*eyes).camera.baseline_m == pytest.approx((45.38 + 337.3) / F)
