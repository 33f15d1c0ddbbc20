"""Plain floor is continued to the foot of what stands on it, and no farther."""

import numpy as np
import pytest
from floor_scenes import CAMERA, MOUNT

from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, NOT_FLOOR
from segfloor_ros.core.floor.disparity.profile import FloorLine, FloorProfile, FloorView
from segfloor_ros.core.floor.mask.filling import fill_to_contact
from segfloor_ros.core.floor.mask.pixel_evidence import Comparison, FrameEvidence
from segfloor_ros.core.floor.pair import Pair

FIRST_ROW = 200
SEEN_ROW, CONTACT_ROW = 160, 80  # of the view: floor is seen from the one, a wall up to the other


def filled(
    wall_px_of_floor: float,
    seen_row: int = SEEN_ROW,
    has_texture: bool = True,
    alike_rows: int = 1000,
) -> np.ndarray:
    """Return what is filled below a wall, its disparity as a multiple of the floor's there.

    seen_row: from where on floor is seen. has_texture: the wall. alike_rows: how many of the lowest
    look like floor.
    """
    view = FloorView.of(CAMERA, MOUNT, FIRST_ROW)
    line = FloorLine.of(CAMERA, MOUNT)
    grid = np.arange(np.ceil(line.horizon), CAMERA.height)
    profile = FloorProfile(line, float(grid[0]), line.slope * (grid - line.horizon), 1000.0)
    shape = view.derolled.shape
    rows = np.broadcast_to(np.arange(shape[0])[:, None], shape)
    wall = rows < CONTACT_ROW
    mask = np.full(shape, NO_EVIDENCE, np.uint8)
    mask[rows >= seen_row], mask[wall] = FLOOR, NOT_FLOOR
    foot_px = float(profile.at_rows(np.array([FIRST_ROW + CONTACT_ROW]))[0])
    disparity = np.where(wall, wall_px_of_floor * foot_px, 0).astype(np.float32)
    floor_px = profile.at_pixels(view.derolled[::2, :: 2 // view.step])
    compared = Comparison(floor_px, wall, wall, wall, ~wall)
    plain = ~wall[::2, :: 2 // view.step]
    may_begin = (rows >= shape[0] - alike_rows)[::2, :: 2 // view.step]
    pair = Pair(*6 * [None], 0.0, 1.0, texture=np.where(wall & has_texture, 2.0, 0.0))
    frame = FrameEvidence(view, profile, pair, disparity, None, compared)
    result = fill_to_contact(frame, mask, plain, may_begin)
    assert not result[rows[::2, :: 2 // view.step] < CONTACT_ROW].any()
    return result[CONTACT_ROW // 2 : SEEN_ROW // 2]


def test_floor_goes_on_to_the_foot_of_a_wall():
    assert filled(1.0).all()


@pytest.mark.parametrize('ratio', [1.3, 0.4])
def test_not_where_the_wall_stands_nearer_or_is_far_behind(ratio):
    assert not filled(ratio).any()


def test_it_may_begin_at_the_lower_edge_of_the_image():
    assert filled(1.0, seen_row=1000).all()
    assert not filled(1.3, seen_row=1000).any()


def test_it_does_not_begin_with_what_mostly_does_not_look_like_the_floor():
    assert filled(1.0, alike_rows=0).all()
    for few in (0, 12, 60):
        assert not filled(1.0, seen_row=1000, alike_rows=few).any()


def test_not_below_what_has_no_disparity():
    assert not filled(0.0).any()


def test_not_below_a_blank_wall():
    """Its disparities are of noise, and its foot may be anywhere below it."""
    assert not filled(1.0, has_texture=False).any()
