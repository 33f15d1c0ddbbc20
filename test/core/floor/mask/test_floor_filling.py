"""What is filled in and what is dropped, on masks drawn by hand and in a scene."""

import numpy as np
import pytest
from floor_scenes import CAMERA, FLOORS, MOUNT, Patch, Scene, box, floor_patch, wall

from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, NOT_FLOOR
from segfloor_ros.core.floor.mask.filling import drop_islands
from segfloor_ros.core.floor.pair import image_slope
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings


def test_patches_much_smaller_than_the_floor_are_dropped():
    mask = np.full((120, 200), NO_EVIDENCE, np.uint8)
    mask[60:, :100] = FLOOR  # 6000 pixels
    mask[10:40, 150:180] = FLOOR  # 900, a sixth
    mask[90:100, 180:190] = FLOOR  # 100, a sixtieth
    mask[80:110, 192:] = NOT_FLOOR
    dropped = drop_islands(mask)
    assert (dropped[90:100, 180:190] == NO_EVIDENCE).all()
    others = np.ones(mask.shape, bool)
    others[90:100, 180:190] = False
    np.testing.assert_array_equal(dropped[others], mask[others])


def test_no_floor_and_floor_with_a_hole_stay_as_they_are():
    for value in (NO_EVIDENCE, FLOOR):
        mask = np.full((40, 40), value, np.uint8)
        mask[20, 20] = NO_EVIDENCE
        np.testing.assert_array_equal(drop_islands(mask), mask)


@pytest.mark.parametrize('floor_kind', FLOORS)
def test_a_blank_board_of_the_shade_of_the_floor_is_not_filled(floor_kind):
    """Floor is seen left and right of it, and nothing tells the two apart but the texture."""
    width_m, ahead_m, grey = 1.6, 1.5, floor_kind.get('grey', 120.0)
    corner = (ahead_m, -width_m / 2, 0.0)
    board = Patch(corner, (0, width_m, 0), (0, 0, 1.5), False, grey=grey, contrast=0.0)
    scene = Scene([floor_patch(**floor_kind), wall(4.0), board])
    left, right, floor, _ = scene.render()
    mask = FloorSegmentation(CAMERA, FloorSegmentationSettings()).process(left, right, MOUNT).mask
    # No more than three rows at its foot.
    assert ((mask == FLOOR) & ~floor).sum() < 3 * CAMERA.fx * width_m / ahead_m


@pytest.mark.parametrize('floor_kind', FLOORS)
@pytest.mark.parametrize('contrast', [2.0, 3.0])
def test_a_near_board_of_hardly_any_texture_is_not_filled(floor_kind, contrast):
    """What it shows is too little to deny the floor; its disparities say that it stands."""
    grey, shared = floor_kind.get('grey', 120.0), {'seed': 7, 'contrast': contrast}
    board = Patch((0.7, -1.5, 0.0), (0, 1.6, 0), (0, 0, 1.5), False, grey=grey, **shared)
    scene = Scene([floor_patch(**floor_kind), wall(4.0), board])
    left, right, floor, depth = scene.render()
    mask = FloorSegmentation(CAMERA, FloorSegmentationSettings()).process(left, right, MOUNT).mask
    assert (mask == FLOOR)[~floor & (depth < 0.8)].mean() < 0.02


@pytest.mark.parametrize('floor_kind', FLOORS)
def test_a_wall_right_beside_the_camera_is_not_filled(floor_kind):
    """So near and so askew it is not matched, and it has hardly more texture than noise."""
    faint = {'grey': floor_kind.get('grey', 120.0), 'contrast': 10.0, 'seed': 9}
    beside = Patch((-0.5, -0.2, 0.0), (4.5, 0, 0), (0, 0, 1.5), False, **faint)
    *images, floor, depth = Scene([floor_patch(**floor_kind), wall(4.0), beside]).render()
    rng = np.random.default_rng(1)
    left, right = (
        np.clip(np.rint(image + rng.normal(0, 3, image.shape)), 0, 255).astype(np.uint8)
        for image in images
    )
    mask = FloorSegmentation(CAMERA, FloorSegmentationSettings()).process(left, right, MOUNT).mask
    assert (mask == FLOOR)[~floor & (depth < 0.8)].mean() < 0.05
    assert (mask == FLOOR)[floor & (depth > 0.5) & (depth < 3.0)].mean() > 0.95


def test_the_slope_of_an_image_does_not_depend_on_where_it_lies_in_memory() -> None:
    """So that two runs give the same bytes; of a ramp it is known."""
    image = np.random.default_rng(1).integers(0, 255, (240, 318)).astype(np.uint8)
    found = set()
    for offset in range(0, 64, 4):
        memory = np.zeros(image.size + 128, np.uint8)
        start = -memory.ctypes.data % 64 + offset
        copy = memory[start : start + image.size].reshape(image.shape)
        copy[:] = image
        held = [np.empty(offset + 1, np.float32)]  # moves what is allocated next
        found.add(image_slope(copy).tobytes())
        del held
    assert len(found) == 1
    ramp = np.tile(np.arange(0, 240, 2, dtype=np.uint8), (80, 1))
    np.testing.assert_array_equal(image_slope(ramp)[5:-5, 5:-5], 4.0)


@pytest.mark.parametrize('height_m', [0.02, 0.03])
def test_floor_among_what_is_climbed_is_no_island_of_the_mask(height_m):
    """A robot climbs the rim of a slab, and drives on behind it; the mask has no floor there."""
    side_m, count = 0.1, 5
    at = [(1.0 + side_m * i, side_m * (j - 2)) for i in range(count) for j in range(count)]
    rim = [xy for i, xy in enumerate(at) if {*divmod(i, count)} & {0, count - 1}]
    things = [part for x, y in rim for part in box(x, y, side_m, height_m, contrast=45.0)]
    left, right, *_ = Scene([floor_patch(), *things, wall(3.0)]).render()
    mask = FloorSegmentation(CAMERA, FloorSegmentationSettings()).process(left, right, MOUNT).mask
    # Of a patch no more is left than what is sampled otherwise here.
    assert np.count_nonzero(drop_islands(mask) != mask) < 50
