"""Input that is unusual but honest ends in a right result, or in one clear line."""

from dataclasses import replace

import numpy as np
import pytest
from floor_scenes import MOUNT, SMALL_CAMERA, Scene, floor_patch, wall

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import FLOOR, NOT_FLOOR, Mount
from segfloor_ros.core.errors import CalibrationError
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings

SETTINGS = FloorSegmentationSettings()


def camera(width: int, height: int, cy: float | None = None) -> StereoCamera:
    """A camera that sees 90 degrees."""
    cy = height / 2 if cy is None else cy
    return StereoCamera(width, height, width / 2, width / 2, width / 2, cy, 0.12)


def noise(of: StereoCamera, shift_px: int = 5) -> tuple[np.ndarray, np.ndarray]:
    left = np.random.default_rng(0).integers(0, 255, (of.height, of.width)).astype(np.uint8)
    return left, np.roll(left, -shift_px, axis=1)


def images(kind: str, of: StereoCamera) -> tuple[np.ndarray, np.ndarray]:
    shape = of.height, of.width
    if kind == 'noise':
        return noise(of)
    grey = np.full(shape, 255 if kind == 'white' else 0, np.uint8)
    return grey, np.full(shape, np.nan, np.float32) if kind == 'no depth' else grey


@pytest.mark.parametrize('kind', ['noise', 'black', 'white', 'no depth'])
@pytest.mark.parametrize('pitch_rad', [-1.4, -0.6])
def test_a_camera_that_looks_up_sees_no_floor(pitch_rad, kind):
    left, right = images(kind, SMALL_CAMERA)
    stage = FloorSegmentation(SMALL_CAMERA, SETTINGS)
    seen = stage.process(left, right, replace(MOUNT, pitch_rad=pitch_rad))
    assert not (seen.mask == FLOOR).any()
    assert not np.nan_to_num(seen.scan.ranges_m).any()


@pytest.mark.parametrize('pitch_rad', [0.9, 1.2])
def test_a_camera_that_looks_down_sees_floor(pitch_rad):
    """No floor is searched at such a pitch; here it is given."""
    mount = Mount(1.0, pitch_rad)
    left, right, floor, _ = Scene([floor_patch()], SMALL_CAMERA, mount).render()
    seen = FloorSegmentation(SMALL_CAMERA, SETTINGS).process(left, right, mount)
    assert (seen.mask == FLOOR)[floor].mean() > 0.9


@pytest.mark.parametrize('kind', ['noise', 'black', 'white', 'no depth'])
@pytest.mark.parametrize('pitch_rad', [0.12, 1.2])
@pytest.mark.parametrize('size', [(1, 1), (5, 3), (64, 31), (161, 17), (321, 241), (322, 33)])
def test_images_of_any_size_have_a_mask(size, pitch_rad, kind):
    small = camera(*size)
    stage = FloorSegmentation(small, SETTINGS)
    seen = stage.process(*images(kind, small), Mount(0.3, pitch_rad))
    assert seen.mask.shape == size[::-1]
    if kind != 'noise':
        assert not (seen.mask == FLOOR).any()


@pytest.mark.parametrize(('width', 'height'), [(320, 30), (321, 241)])
def test_floor_is_seen_in_flat_and_odd_images(width, height):
    mount = Mount(0.3, 0.3)
    flat = StereoCamera(width, height, 160.0, 160.0, 160.0, height / 2, 0.12)
    left, right, floor, _ = Scene([floor_patch(), wall()], flat, mount).render()
    called = FloorSegmentation(flat, SETTINGS).process(left, right, mount).mask == FLOOR
    assert (called & floor).sum() > 0.8 * floor.sum()
    assert (called & floor).sum() > 0.98 * called.sum()


@pytest.mark.parametrize('cy', [-2000.0, -50.0, 300.0, 2000.0])
def test_the_horizon_may_be_outside_the_image(cy):
    other = camera(320, 240, cy)
    seen = FloorSegmentation(other, SETTINGS).process(*noise(other), MOUNT)
    assert not (seen.mask == FLOOR).any()
    if cy > other.height:
        assert (seen.mask == NOT_FLOOR).all()


def test_floor_is_seen_below_a_horizon_above_the_image():
    other = camera(320, 240, -50.0)
    left, right, floor, _ = Scene([floor_patch()], other, MOUNT).render()
    seen = FloorSegmentation(other, SETTINGS).process(left, right, MOUNT)
    assert (seen.mask == FLOOR)[floor].mean() > 0.9


def test_a_base_on_its_back_sees_no_floor_where_the_map_has_it_level():
    T_map_base = np.diag([1.0, -1.0, -1.0, 1.0])
    T_map_base[2, 3] = -5.0
    seen = FloorSegmentation(SMALL_CAMERA, SETTINGS).process(
        *noise(SMALL_CAMERA), MOUNT, T_map_base
    )
    assert not (seen.mask == FLOOR).any()


def test_a_mount_that_turns_the_camera_upside_down_is_refused_in_one_line():
    stage = FloorSegmentation(SMALL_CAMERA, SETTINGS)
    with pytest.raises(CalibrationError, match='exchange left and right'):
        stage.process(*noise(SMALL_CAMERA), replace(MOUNT, roll_rad=np.pi))
