"""The comparison of a stereo pair with earlier views."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from stereo_room import CAMERA

from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.core.plugins.moving.moving_regions import MovingRegions
from segfloor_ros.core.plugins.moving.scene_flow import FlowVotes

FACTOR = 2
"""The images are twice as wide as those that are searched."""

WALL_PX, NEARER_PX = 4.0, 12.0


def pair(texture, disparity_px):
    """A wall that fills both images at a disparity of the shrunk image."""
    shift = round(FACTOR * disparity_px)
    left = texture[:, 100 : 100 + CAMERA.width]
    return left, texture[:, 100 + shift : 100 + shift + CAMERA.width]


def noise(width):
    grey = np.random.default_rng(2).normal(128, 40, (CAMERA.height // FACTOR, width // FACTOR))
    big = grey.repeat(FACTOR, axis=0).repeat(FACTOR, axis=1)
    return np.clip(big, 0, 255).astype(np.uint8)


@pytest.fixture
def regions():
    """Five earlier views of a wall from here."""
    made = MovingRegions(CAMERA)
    wall = np.full((CAMERA.height // FACTOR, CAMERA.width // FACTOR), WALL_PX, np.float32)
    for _ in range(5):
        made.remember(SimpleNamespace(T_camera_world=np.eye(4)), wall)
    return made


def found_share(regions, texture, disparity_px, alike=1.0):
    """Shares found of a thing before the wall, and beside it. disparity_px: of the thing. alike:
    how much of it the right image shows there.
    """
    left, right = (image.copy() for image in pair(texture, WALL_PX))
    thing = np.s_[40:200, 120:200]
    other = np.flip(texture)[40:200, 120:200]
    columns = np.arange(120, 200) - round(FACTOR * disparity_px)
    right[40:200, columns] = alike * left[thing] + (1 - alike) * other
    regions.measure(left, right)
    seen = np.full((CAMERA.height // FACTOR, CAMERA.width // FACTOR), WALL_PX, np.float32)
    seen[20:100, 60:100] = NEARER_PX
    found = regions.find(seen, np.eye(4), None)
    return (found[20:100, 60:100] > 0).mean(), (found[:, 110:] > 0).mean()


def test_what_stands_in_front_of_what_was_seen_moves(regions):
    inside, outside = found_share(regions, noise(600), NEARER_PX)
    assert inside > 0.95 and outside == 0


def test_what_a_single_view_saw_through_does_not_move():
    made = MovingRegions(CAMERA)
    wall = np.full((CAMERA.height // FACTOR, CAMERA.width // FACTOR), WALL_PX, np.float32)
    for disparity in (wall, np.zeros_like(wall)):
        made.remember(SimpleNamespace(T_camera_world=np.eye(4)), disparity)
    assert found_share(made, noise(600), NEARER_PX) == (0.0, 0.0)


def test_a_match_that_the_pair_does_not_show_does_not_move(regions):
    inside, _ = found_share(regions, noise(600), NEARER_PX, alike=0.4)
    assert inside == 0


def test_a_pattern_that_repeats_does_not_move(regions):
    tile = noise(round(FACTOR * (NEARER_PX - WALL_PX)))
    inside, _ = found_share(regions, np.tile(tile, 40)[:, :600], NEARER_PX)
    assert inside == 0


def test_a_thing_of_which_most_corners_moved_moves_as_a_whole_where_it_stood_before():
    made = MovingRegions(CAMERA)
    seen = np.full((CAMERA.height // FACTOR, CAMERA.width // FACTOR), WALL_PX, np.float32)
    seen[20:100, 60:100] = NEARER_PX
    for _ in range(5):
        made.remember(SimpleNamespace(T_camera_world=np.eye(4)), seen)
    made.measure(*pair(noise(600), WALL_PX))
    moving, still = np.zeros(seen.shape, np.uint8), np.zeros(seen.shape, np.uint8)
    moving[50:60, 75:85] = still[50:60, 120:130] = 1
    found = made.find(seen, np.eye(4), None, FlowVotes(moving, still, moving | still))
    assert (found[30:90, 64:96] > 0).mean() > 0.95
    assert not found[:, 110:].any()
    others = moving | still
    others[25:45, 62:98] = 1
    for stands in (others - moving, still):  # they stand still, or were not found again
        found = made.find(seen, np.eye(4), None, FlowVotes(moving, stands, others))
        assert (found[30:90, 64:96] > 0).mean() < 0.2


def test_a_strip_no_wider_than_a_block_does_not_move(regions):
    regions.measure(*pair(noise(600), NEARER_PX))
    seen = np.full((CAMERA.height // FACTOR, CAMERA.width // FACTOR), WALL_PX, np.float32)
    seen[20:100, 60:64] = NEARER_PX
    assert not regions.find(seen, np.eye(4), None).any()


def test_points_are_seen_through_where_the_image_shows_what_is_behind_them(regions):
    wall = np.full((CAMERA.height // FACTOR, CAMERA.width // FACTOR), WALL_PX, np.float32)
    depth_m = CAMERA.disparity_times_depth / FACTOR / np.array([WALL_PX, NEARER_PX, 2.0])
    points = np.stack([np.zeros(3), np.zeros(3), depth_m], axis=1)
    np.testing.assert_array_equal(regions.seen_through(wall, points), [False, True, False])


def test_the_feet_below_shins_that_move_are_left_out_too(regions):
    disparity = np.full((CAMERA.height // FACTOR, CAMERA.width // FACTOR), NEARER_PX, np.float32)
    moving, low = np.zeros(disparity.shape, np.uint8), np.zeros(disparity.shape, bool)
    moving[40:60, 70:80] = 255
    np.testing.assert_array_equal(regions._with_feet(moving, disparity, low), moving)
    low[50:] = True
    found = regions._with_feet(moving, disparity, low)
    foot_px = 0.2 * CAMERA.fx / CAMERA.disparity_times_depth * NEARER_PX
    below = np.flatnonzero(found[:, 75])
    assert below.min() == 40
    assert 0.75 * foot_px < below.max() - 59 <= foot_px
    assert not found[45, :69].any()


def with_thing(columns):
    """A frame of the wall with a thing before it."""
    left, right = pair(noise(600), WALL_PX)
    shift = round(FACTOR * (NEARER_PX - WALL_PX))
    thing = np.flip(left[40:200, columns], axis=0)
    left, right = left.copy(), right.copy()
    left[40:200, columns] = thing
    start = columns.start - shift - round(FACTOR * WALL_PX)
    right[40:200, start : start + thing.shape[1]] = thing
    return StereoFrame(0, 0, left, right)


def test_what_is_found_once_does_not_move_yet(regions):
    empty = StereoFrame(0, 0, *pair(noise(600), WALL_PX))
    at_first, then, alone = slice(120, 200), slice(130, 210), slice(230, 310)
    shares = []
    for frame in (empty, with_thing(at_first), with_thing(then), empty, with_thing(alone)):
        moving = regions.search(frame, np.eye(4), np.eye(4), None).moving
        shares.append((moving[30:90, 68:100] > 0).mean())
        assert not moving[:, 125:].any()
    assert shares[0] == shares[1] == shares[3] == 0
    assert shares[2] > 0.9


def test_eyes_of_different_brightness_see_the_same_wall(regions):
    shade = cv2.GaussianBlur(noise(600).astype(np.float32), (0, 0), 15.0)
    shade *= 40 / shade.std()
    texture = shade - shade.mean() + 128 + 0.05 * noise(600)
    left, right = (np.clip(image, 0, 255).astype(np.uint8) for image in pair(texture, WALL_PX))
    darker = cv2.addWeighted(right, 0.8, right, 0.0, -20.0)
    for _ in range(3):
        found = regions.search(StereoFrame(0, 0, left, darker), np.eye(4), np.eye(4), None)
        assert not found.moving.any()
    assert (np.abs(found.disparity - WALL_PX) < 0.5).mean() > 0.9


@pytest.mark.parametrize(('rate_hz', 'between'), [(3, 3), (10, 3), (30, 8)])
def test_a_fast_camera_is_not_searched_more_often(rate_hz, between):
    made, texture = MovingRegions(CAMERA), noise(600)
    searched = []
    for k in range(4 * between):
        stamp_ns = (1 + k) * 1_000_000_000 // rate_hz
        if made.is_due(stamp_ns, is_keyframe=k == 0, is_tracked=True):
            frame = StereoFrame(k, stamp_ns, *pair(texture, WALL_PX))
            made.search(frame, np.eye(4), np.eye(4), None)
            searched.append(k)
    assert searched == [0, between, 2 * between, 3 * between]
