"""Disparities of shifted pictures and the range that geometry asks for."""

import cv2
import numpy as np
import pytest

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import Mount
from segfloor_ros.core.floor.disparity.matching import (
    DisparityMatcher,
    TwoScaleMatcher,
    disparity_range,
    equal_exposure,
)


def shifted_pair(shift_px: int, height: int = 80, width: int = 240):
    rng = np.random.default_rng(3)
    wide = rng.integers(20, 235, (height, width + shift_px)).astype(np.uint8)
    return wide[:, :width], wide[:, shift_px : shift_px + width]


def test_a_shift_is_found_up_to_the_last_column_the_right_image_reaches():
    left, right = shifted_pair(20)
    disparity = DisparityMatcher(64).compute(left, right)
    assert disparity.dtype == np.float32
    # 64 columns would stay empty without the padding; the right image reaches column 20.
    inner = disparity[5:-5, 26:-6]
    assert np.mean(np.abs(inner - 20) < 0.5) > 0.99
    assert np.all(disparity[:, :15] == 0)


def test_without_texture_there_is_hardly_a_match():
    grey = np.full((80, 240), 128, np.uint8)
    disparity = DisparityMatcher(32).compute(grey, grey)
    assert np.mean(disparity > 0) < 0.01


def test_range_covers_the_nearest_floor():
    # Level camera 0.30 m high: the last row, 239 px below the centre, sees the floor at
    # 0.30 * 320 / 239 m, where the disparity is 239 * 0.12 / 0.30 = 95.6 px.
    camera = StereoCamera(640, 480, 320.0, 320.0, 320.0, 240.0, 0.12)
    assert disparity_range(camera, Mount(0.30), share=1.0) == 96
    assert disparity_range(camera, Mount(0.30), share=1.15) == 112
    assert disparity_range(camera, None) == 160


def test_range_never_exceeds_half_the_image():
    camera = StereoCamera(320, 240, 250.0, 250.0, 160.0, 120.0, 0.5)
    assert disparity_range(camera, Mount(0.1, 0.5)) == 160


def test_exposure_is_made_equal_only_where_it_differs():
    left, right = shifted_pair(4)
    assert equal_exposure(left, right) is right
    dark = (right * 0.6).astype(np.uint8)
    adapted = equal_exposure(left, dark)
    assert adapted.mean() == pytest.approx(left.mean(), abs=1.0)
    assert adapted.std() == pytest.approx(left.std(), rel=0.03)


def test_two_scales_find_what_one_finds():
    # Three bands of one picture: far, near, and far again with something near in it.
    rng = np.random.default_rng(5)
    shifts = np.full((120, 1), 12)
    shifts[60:] = 80
    wide = cv2.GaussianBlur(rng.normal(size=(120, 500)), (0, 0), 1.5)
    wide = np.clip(128 + 40 * wide / wide.std(), 0, 255).astype(np.uint8)
    left = wide[:, :400].copy()
    right = np.take_along_axis(wide, np.arange(400) + shifts, axis=1)
    near = wide[::-1][20:50, 400:500]
    left[20:50, 230:330], right[20:50, 150:250] = near, near  # 80 px within the far rows
    matcher = TwoScaleMatcher(112)
    assert matcher.num_disparities == 128
    disparity = matcher.compute(left, right, fine_rows=60)
    assert np.mean(np.abs(disparity[5:15, 30:-10] - 12) < 0.2) > 0.95
    assert np.mean(np.abs(disparity[66:-5, 100:-10] - 80) < 1.0) > 0.95
    assert np.mean(np.abs(disparity[26:44, 240:320] - 80) < 1.0) > 0.9


@pytest.mark.parametrize('shift_px', [20, 40])
def test_a_short_range_takes_one_scale(shift_px):
    left, right = shifted_pair(shift_px)
    matcher = TwoScaleMatcher(48)
    assert matcher.num_disparities == 48
    whole = DisparityMatcher(48).compute(left, right)
    assert np.median(whole[:, 60:]) == pytest.approx(shift_px, abs=0.1)
    assert np.array_equal(matcher.compute(left, right, fine_rows=10), whole)
