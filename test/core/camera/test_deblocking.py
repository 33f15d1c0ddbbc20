"""The block grid of compressed images: seen where there is one, smoothed, real edges kept."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from camera_recordings import calibration

from segfloor_ros.core.camera.calibration import StereoCalibration
from segfloor_ros.core.camera.rectification import StereoRectifier, deblocked, is_blocky


def weak_texture(seed: int = 0) -> np.ndarray:
    """Return a smooth picture (240, 320) that hardly survives compression."""
    noise = np.random.default_rng(seed).normal(size=(240, 320)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 6)
    return np.clip(np.rint(120 + 6 * smooth / smooth.std()), 0, 255).astype(np.uint8)


def compressed(image: np.ndarray, quality: int) -> np.ndarray:
    _, data = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)


def noisy(image: np.ndarray, sigma: float = 1.5) -> np.ndarray:
    noise = np.random.default_rng(1).normal(0, sigma, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def test_the_grid_is_seen_only_where_there_is_one():
    for image in (weak_texture(), noisy(weak_texture()), np.full((240, 320), 7, np.uint8)):
        assert not is_blocky(image)
    assert is_blocky(compressed(weak_texture(), 30))
    assert is_blocky(compressed(noisy(weak_texture()), 50))


def test_an_image_without_a_grid_is_left_as_it_is():
    image = noisy(weak_texture())
    assert deblocked(image) is image


@pytest.mark.parametrize('seed', [0, 7])
def test_smoothing_brings_the_picture_back_nearer_to_the_truth(seed):
    truth = weak_texture(seed).astype(float)
    blocky = compressed(weak_texture(seed), 20)
    smooth = deblocked(blocky)
    assert not is_blocky(smooth)
    assert np.abs(smooth - truth).mean() < 0.8 * np.abs(blocky - truth).mean()


def test_edges_stronger_than_blocks_stay():
    image = compressed(weak_texture(), 20)
    image[:, 160:] = np.clip(image[:, 160:].astype(int) + 60, 0, 255)  # on the grid
    step = image[:, 160].astype(int) - image[:, 159]
    smooth = deblocked(image)
    assert np.abs(smooth[:, 160].astype(int) - smooth[:, 159] - step).mean() < 2


def test_sizes_that_are_no_multiple_of_a_block():
    for height, width in ((233, 317), (225, 316), (239, 313), (16, 16), (5, 7)):
        image = compressed(weak_texture(), 20)[:height, :width]
        assert deblocked(image).shape == (height, width)


def test_images_are_deblocked_before_they_are_rectified():
    eyes = calibration()
    sized = (replace(eye, width=320, height=240) for eye in (eyes.left, eyes.right))
    rectifier = StereoRectifier(StereoCalibration(*sized))
    blocky = compressed(weak_texture(), 20)
    for image in rectifier.rectify(blocky, blocky.copy()):
        assert not is_blocky(image)
