"""What does not look like floor is floor only where that was measured."""

import numpy as np
import pytest
from floor_scenes import FLOORS, Scene, box, floor_patch, wall

from segfloor_ros.core.contracts import FLOOR
from segfloor_ros.core.floor.mask.look import unlike_floor
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings


def floor_image(rng, sigma):
    ramp = np.linspace(90, 150, 320)
    return np.clip(ramp + rng.normal(0, sigma, (160, 320)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize('sigma', [2.0, 8.0])
def test_a_dark_thing_is_odd_and_light_that_changes_slowly_is_not(sigma):
    image = floor_image(np.random.default_rng(1), sigma)
    image[60:100, 100:160] = 10
    floor = np.ones(image.shape, bool)
    floor[55:105, 95:165] = False
    odd = unlike_floor(image, floor)
    assert odd[65:95, 105:155].all()
    assert odd[floor].mean() < 0.08


def test_what_was_taken_for_floor_does_not_hide_itself():
    image = floor_image(np.random.default_rng(2), 4.0)
    image[60:80, 100:130] = 10
    odd = unlike_floor(image, np.ones(image.shape, bool))
    assert odd[63:77, 103:127].all()


def test_what_is_nearly_a_quarter_as_wide_as_the_image_does_not_hide_itself():
    image = floor_image(np.random.default_rng(2), 4.0)
    image[60:130, 120:190] = 40
    odd = unlike_floor(image, np.ones(image.shape, bool))
    assert odd[65:125, 125:185].mean() > 0.98
    assert odd[:, :115].mean() < 0.08


def test_where_no_floor_is_known_nothing_is_odd():
    image = floor_image(np.random.default_rng(3), 4.0)
    assert not unlike_floor(image, np.zeros(image.shape, bool)).any()


def test_how_floor_looks_is_known_the_less_the_farther_off_the_less_of_it_is_seen():
    """A patch of floor does not tell how light falls at the other end of the image."""
    image = floor_image(np.random.default_rng(4), 4.0)
    image[:, 250:] //= 3
    little, much = np.zeros(image.shape, bool), np.zeros(image.shape, bool)
    little[130:154, :40], much[:, :200] = True, True
    assert unlike_floor(image, little)[:, 260:].mean() < 0.05
    assert unlike_floor(image, much)[:, 260:].mean() > 0.95


@pytest.mark.parametrize('floor_kind', FLOORS)
def test_a_plain_dark_thing_right_ahead_is_not_filled_as_floor(floor_kind):
    """It has no disparity of its own, and floor all around it."""
    dark = {'contrast': 0.0, 'grey': 12.0}
    things = [box(x_m, y_m, 0.2, 0.06, **dark) for x_m, y_m in ((0.8, 0.1), (1.3, -0.3))]
    scene = Scene([floor_patch(**floor_kind), *(side for one in things for side in one), wall(4.0)])
    left, right, floor, depth = scene.render()
    stage = FloorSegmentation(scene.camera, FloorSegmentationSettings())
    called = stage.process(left, right, scene.mount).mask == FLOOR
    thing = ~floor & (depth < 1.6)
    assert thing.sum() > 1000
    assert (called & thing).sum() < 0.02 * thing.sum()
    wanted = floor & (depth > 0.5) & (depth < 3.0)
    assert (called & wanted).sum() > 0.9 * wanted.sum()


@pytest.mark.parametrize('floor_kind', FLOORS)
def test_dark_things_in_little_light_are_not_floor(floor_kind):
    """Their disparities are smeared with those of the floor, which they hardly differ from."""
    dark = {'contrast': 10.0, 'grey': 20.0}
    things = [box(x_m, y_m, 0.25, 0.05, **dark) for x_m, y_m in ((0.8, 0.1), (1.3, -0.3))]
    scene = Scene([floor_patch(**floor_kind), *(side for one in things for side in one), wall(4.0)])
    *images, floor, depth = scene.render()
    rng = np.random.default_rng(0)
    left, right = (
        np.clip(np.rint(0.35 * image + rng.normal(0, 2, image.shape)), 0, 255).astype(np.uint8)
        for image in images
    )
    stage = FloorSegmentation(scene.camera, FloorSegmentationSettings())
    called = stage.process(left, right, scene.mount).mask == FLOOR
    thing = ~floor & (depth < 1.6)
    assert (called & thing).sum() < 0.02 * thing.sum()
    wanted = floor & (depth > 0.5) & (depth < 3.0)
    assert (called & wanted).sum() > 0.9 * wanted.sum()
