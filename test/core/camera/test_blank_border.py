"""The black border of rectified images, and what is made of it."""

import cv2
import numpy as np

from segfloor_ros.core.camera.pixels import BlankBorder


def bordered(seed=0):
    """A noisy image whose lower corners and left edge are black, and what is black."""
    rng = np.random.default_rng(seed)
    image = rng.integers(1, 255, (120, 160), dtype=np.uint8)
    v, u = np.mgrid[:120, :160]
    black = (v > 119 - (u - 80) ** 2 / 200) | (u < 6)
    image[black] = 0
    return image, black


def test_the_border_and_a_margin_around_it_are_found():
    image, black = bordered()
    image[40:60, 70:90] = 0  # black, but part of the scene
    border = BlankBorder().see(image) > 0
    assert border[black].mean() > 0.99  # all but slivers one pixel high
    assert not border[20:85, 45:115].any()


def test_images_without_a_border_have_none():
    image, _ = bordered()
    assert BlankBorder().see(np.maximum(image, 3)) is None
    image = np.maximum(image, 3)
    image[::9, 0] = 0
    assert BlankBorder().see(image) is None


def test_a_dark_thing_that_touches_the_border_belongs_to_the_scene():
    image, _ = bordered()
    border = BlankBorder()
    before = border.see(image)
    dark = image.copy()
    dark[70:, 20:60] = 0  # a tyre that drives into the view
    for _ in range(2):
        border.see(image)
    np.testing.assert_array_equal(border.see(dark), before)
    # One that is there from the first image on counts as border until it has moved.
    border = BlankBorder()
    assert border.see(dark)[75, 40]
    for _ in range(3):
        np.testing.assert_array_equal(border.see(image), before)
    np.testing.assert_array_equal(border.see(dark), before)


def test_one_image_that_is_spoilt_takes_no_border_away():
    image, _ = bordered()
    border = BlankBorder()
    before = border.see(image)
    border.see(np.maximum(image, 200))
    np.testing.assert_array_equal(border.see(image), before)
    # Images of another size have a border of their own, also if their halves are as large.
    assert border.see(image[:119]).shape == (119, 160)


def test_images_that_were_compressed_have_their_border_too():
    border = BlankBorder()
    for seed in range(20):
        image, black = bordered(seed)
        image = cv2.GaussianBlur(image, (9, 9), 3)
        image[black] = 0
        packed = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, 40])[1]
        found = border.see(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE))
    assert found is not None and (found[black] > 0).mean() > 0.7
    assert not found[20:85, 45:115].any()
