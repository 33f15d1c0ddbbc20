"""Corners followed back to earlier images."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from stereo_room import CAMERA

from segfloor_ros.core.geometry import Array, make_transform
from segfloor_ros.core.plugins.moving.scene_flow import (
    FlowView,
    FlowVotes,
    SceneFlow,
    SmallCamera,
    static_scale,
)

SMALL = SmallCamera(CAMERA)
WALL_PX, NEARER_PX = 4.0, 12.0
STEP_NS = 300_000_000
THING = (slice(30, 80), slice(60, 90))


def texture(seed: int) -> np.ndarray:
    width, height = SMALL.size
    grey = np.random.default_rng(seed).normal(0, 1, (height, 2 * width))
    soft = cv2.GaussianBlur(grey, (0, 0), 1.2)
    return np.clip(128 + 40 * soft / soft.std(), 0, 255).astype(np.uint8)


WALL, CLOTH = texture(1), texture(2)


def view(index: int, thing_at_px: int = 0, wall_at_px: int = 0, x_m: float = 0.0) -> FlowView:
    """A wall with a thing before it, both shifted to the right, seen by a camera at x."""
    width, height = SMALL.size
    left = WALL[:, 60 - wall_at_px : 60 - wall_at_px + width].copy()
    disparity = np.full((height, width), WALL_PX, np.float32)
    rows, columns = THING
    moved = slice(columns.start + thing_at_px, columns.stop + thing_at_px)
    left[rows, moved] = CLOTH[rows, columns]
    disparity[rows, moved] = NEARER_PX
    pose = make_transform(np.eye(3), np.array([x_m, 0.0, 0.0]))
    return FlowView(index * STEP_NS, left, disparity, pose)


def votes(*views: FlowView) -> FlowVotes:
    flow = SceneFlow(SMALL)
    for v in views[:-1]:
        flow.remember(v)
    return flow.votes(views[-1])


def shift_px(disparity: float, x_m: float) -> int:
    return round(x_m * SMALL.focal[0] * disparity / SMALL.disparity_m)


def share(mask: np.ndarray, columns: slice) -> float:
    return float((mask[THING[0], columns] > 0).mean())


def test_what_has_moved_on_is_found_although_its_place_was_never_seen_empty():
    found = votes(view(0), view(1, thing_at_px=7))
    assert share(found.moving, slice(67, 97)) > 0.1
    assert not found.moving[:, 105:].any()
    assert share(found.still, slice(110, 140)) > 0.1


def test_what_the_camera_passes_stands_still():
    x_m = 4.0 * SMALL.disparity_m / (SMALL.focal[0] * WALL_PX)
    wall, thing = shift_px(WALL_PX, x_m), shift_px(NEARER_PX, x_m)
    assert thing == 12 and wall == 4
    found = votes(view(0), view(1, -thing, -wall, x_m))
    assert not found.moving.any()
    assert share(found.still, slice(48, 78)) > 0.1


def test_what_moves_along_with_the_camera_moves():
    x_m = 4.0 * SMALL.disparity_m / (SMALL.focal[0] * WALL_PX)
    found = votes(view(0), view(1, 0, -shift_px(WALL_PX, x_m), x_m))
    assert share(found.moving, slice(60, 90)) > 0.1
    assert not found.moving[:, 100:].any()


def test_a_few_corners_that_moved_among_many_that_are_not_found_again_are_wrong():
    second = view(1, thing_at_px=7)
    for rows in (slice(30, 43), slice(67, 80)):
        second.left[rows, 67:97] = texture(3)[rows, 67:97]
    found = votes(view(0), second)
    assert not found.moving.any()
    assert share(found.all, slice(67, 97)) > 0.1


def test_where_everything_seems_to_move_nothing_does():
    wrong: Array = make_transform(np.eye(3), np.array([0.0, 0.15, 0.0]))
    first, second = view(0), view(1)
    lifted = FlowView(second.stamp_ns, second.left, second.disparity, wrong)
    assert not votes(first, lifted).moving.any()


def test_where_the_pose_is_in_doubt_what_moved_still_does():
    wrong: Array = make_transform(np.eye(3), np.array([0.0, 0.15, 0.0]))
    first, second = view(0), view(1, thing_at_px=5)
    moving = np.zeros(first.left.shape, np.uint8)
    moving[THING] = 255
    lifted = replace(second, T_odom_camera=wrong)
    found = votes(replace(first, moving=moving), lifted)
    assert share(found.moving, slice(65, 95)) > 0.1
    assert not found.moving[:, 100:].any()


def test_tolerances_grow_with_what_the_static_scene_differs_by():
    rng = np.random.default_rng(4)
    ratios = np.abs(rng.normal(0, 0.2, 2000))
    assert static_scale(ratios) == static_scale(np.zeros(0)) == 1.0
    # Blur five times as bad; a third moves.
    moving = np.where(np.arange(2000) % 3 == 0, 40.0, 5 * ratios)
    assert 3.0 < static_scale(moving) < 5.0
    assert static_scale(5 * ratios) == pytest.approx(3.0, abs=0.3)
