"""Disparities of what shows no point yet, on images whose disparity is known by construction."""

import cv2
import numpy as np
import pytest
from hand_made_maps import CAMERA

from segfloor_ros.core.contracts import NO_POINT, StereoFrame
from segfloor_ros.core.slam.mapping.keyframe_mapping import LocalMapper
from segfloor_ros.core.slam.rig import Observations, Rig
from segfloor_ros.core.slam.sparse_map import SparseMap
from segfloor_ros.core.slam.tracking.images import Features, Images
from segfloor_ros.core.slam.tracking.patch_alignment import guess_disparity
from segfloor_ros.core.slam.tracking.track import ObservedFeatures


def shifted_pair(width, height, disparity):
    """A random texture, and the same moved left by a disparity (H, W)."""
    rng = np.random.default_rng(5)
    left = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), 2.0)
    left = np.clip(128 + 300 * left, 0, 255).astype(np.uint8)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    right = cv2.remap(
        left, (u + disparity).astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR
    )
    return left, right


@pytest.mark.parametrize('width', [320, 640, 1241])
def test_disparities_are_right_to_two_pixels_at_every_image_size(width):
    truth = 0.07 * width
    left, right = shifted_pair(width, 240, truth)
    uv = np.random.default_rng(1).uniform([0.15 * width, 20], [0.85 * width, 220], (400, 2))
    error = guess_disparity(left, right, uv) - truth
    assert np.mean(np.abs(error) < 2.0 * max(1, width / 640)) > 0.95


def test_the_left_edge_is_matched_where_the_other_eye_sees_it():
    left, right = shifted_pair(640, 240, 4.0)
    uv = np.stack([np.full(20, 30.0), np.linspace(30, 210, 20)], axis=1)
    np.testing.assert_allclose(guess_disparity(left, right, uv), 4.0, atol=2.0)


def test_nothing_is_guessed_where_there_is_nothing_to_see():
    grey = np.full((240, 640), 90, np.uint8)
    uv = np.array([[100.0, 100.0], [500.0, 30.0]])
    assert np.isnan(guess_disparity(grey, grey, uv)).all()


def test_what_hides_a_point_from_one_eye_does_not_give_it_a_disparity():
    left, right = shifted_pair(640, 240, 9.0)
    uv = np.random.default_rng(2).uniform([100, 30], [540, 210], (200, 2))
    is_known = np.arange(len(uv)) % 2 == 0
    observed = ObservedFeatures(
        Features(
            uv.astype(np.float32), np.zeros(len(uv), np.uint8), np.zeros((len(uv), 32), np.uint8)
        ),
        Observations(np.column_stack([uv, np.full(len(uv), np.nan)]), np.ones((len(uv), 3))),
        np.where(is_known, 0, NO_POINT).astype(np.int32),
    )
    frame = StereoFrame(0, 0, left, right)
    mapper = LocalMapper(SparseMap(Rig(CAMERA)))
    mapper.measure_stereo(frame, Images.of(frame, CAMERA), observed)
    disparity = observed.observations.uvd_px[:, 2]
    assert np.isnan(disparity[is_known]).all()
    found = disparity[~is_known]
    assert np.isfinite(found).mean() > 0.8
    np.testing.assert_allclose(found[np.isfinite(found)], 9.0, atol=0.2)
