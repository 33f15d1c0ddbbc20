"""Plain floor is continued to the foot of what stands on it, and no farther."""

import numpy as np
import pytest
from floor_scenes import CAMERA, MOUNT

from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, NOT_FLOOR, Mount
from segfloor_ros.core.floor.disparity.matching import NOISE_PX, SIGMAS
from segfloor_ros.core.floor.disparity.profile import FloorLine, FloorProfile, FloorView
from segfloor_ros.core.floor.mask.filling import fill_to_contact
from segfloor_ros.core.floor.mask.pixel_evidence import (
    Comparison,
    FrameEvidence,
    Heights,
    _below_contact,
)
from segfloor_ros.core.floor.pair import Pair
from segfloor_ros.core.floor.settings import FloorSegmentationSettings

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


@pytest.mark.parametrize('error_px', [-NOISE_PX, 0.0, NOISE_PX])
@pytest.mark.parametrize('pitch_rad', [0.0, 0.3, 0.7])
def test_what_stands_ends_at_its_foot_but_for_the_error_of_its_disparity(pitch_rad, error_px):
    """Of an upright face only what is higher than 4 cm is seen."""
    mount, foot_row = Mount(0.6, pitch_rad), 400
    view, line = FloorView.of(CAMERA, mount, FIRST_ROW), FloorLine.of(CAMERA, mount)
    grid = np.arange(np.ceil(line.horizon), CAMERA.height)
    profile = FloorProfile(line, float(grid[0]), line.slope * (grid - line.horizon), 1000.0)
    depth_m = CAMERA.disparity_times_depth / profile.at_rows(np.array([foot_row]))
    foot = CAMERA.back_project(np.array([[CAMERA.cx, foot_row]]), depth_m)
    face = foot + np.linspace(0.25, 0.04, 300)[:, None] * mount.up_in_camera
    _, row, right = CAMERA.project(face).T
    rows = np.arange(FIRST_ROW, CAMERA.height)
    face_px = np.interp(rows, row, CAMERA.cx - right, left=0, right=0)
    seen_px = np.where(face_px > 0, face_px + error_px, 0).astype(np.float32)
    disparity = np.repeat(seen_px[:, None], len(view.columns), axis=1)
    pair = Pair(*6 * [None], 0.0, 1.0, texture=np.full(disparity.shape, 2.0))
    heights = Heights.of(view, profile, pair, disparity, 128, FloorSegmentationSettings())
    frame = FrameEvidence(view, profile, pair, disparity, heights, None)
    low = (disparity > 0) & heights.above & heights.near
    last = FIRST_ROW + np.flatnonzero(_below_contact(frame, low).all(axis=1)).max()
    assert abs(last - foot_row) < SIGMAS * NOISE_PX / line.slope + 1
