"""Floor where the image alone cannot tell: gaps between floor, and what was seen before."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.floor.evidence import FloorView
from segfloor_ros.floor.observation import FLOOR, NO_EVIDENCE, NOT_FLOOR
from segfloor_ros.floor.profile import FloorProfile
from segfloor_ros.geometry import Array

_MIN_REGION_PX = 40
_MIN_SLOPE = 1.5
"""Grey levels per pixel at half resolution; weaker edges bound no region."""
_EDGE_SLOPE = 24
"""Sobel response of the weakest edge that counts: 3 grey levels per row."""


def fill_gaps(
    view: FloorView, profile: FloorProfile, mask: NDArray[np.uint8], gap_m: float
) -> NDArray[np.uint8]:
    """Return the mask with NO_EVIDENCE turned to floor along rows, between two floor pixels that
    are at most `gap_m` apart.
    """
    height, width = mask.shape
    rows = np.arange(height) + view.first_row
    disparity = np.nan_to_num(profile.at_rows(rows))
    longest = gap_m * view.camera.fx / view.camera.disparity_times_depth * disparity
    known = mask != NO_EVIDENCE
    columns = np.arange(width, dtype=np.int32)
    left = np.maximum.accumulate(np.where(known, columns, 0), axis=1)
    right = np.minimum.accumulate(np.where(known, columns, width - 1)[:, ::-1], axis=1)[:, ::-1]
    row_index = np.arange(height)[:, None]
    between = (mask[row_index, left] == FLOOR) & (mask[row_index, right] == FLOOR)
    filled = mask.copy()
    filled[~known & between & (right - left <= longest[:, None])] = FLOOR
    return filled


def fill_regions(
    mask: NDArray[np.uint8],
    image: NDArray[np.uint8],
    consistent: NDArray[np.bool_],
    min_share: float,
) -> NDArray[np.uint8]:
    """Return the mask with NO_EVIDENCE turned to floor in regions that look alike, continue
    floor, and that the images do not contradict (`consistent`).

    A region is bounded by edges of the image stronger than the floor's own; floor by evidence must
    be in `min_share` of its columns. Within it a pixel becomes floor below floor, the next evidence up its
    column, or between floor on its left and right. Half the resolution does.
    """
    step = 2
    small = mask[::step, ::step]
    floor = small == FLOOR
    if np.count_nonzero(floor) < _MIN_REGION_PX:
        return mask
    smooth = cv2.blur(image, (5, 5))[::step, ::step]
    slope = cv2.magnitude(
        cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8),
        cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8),
    )
    limit = max(_MIN_SLOPE, float(np.percentile(slope[floor][::7], 90)))
    alike = (small != NOT_FLOOR) & consistent[::step, ::step] & (slope < limit)
    count, region = cv2.connectedComponents(
        cv2.erode(alike.astype(np.uint8), np.ones((3, 3), np.uint8)), connectivity=4
    )
    supported = np.bincount(region[floor], minlength=count)
    columns = np.broadcast_to(np.arange(small.shape[1]), small.shape)
    spread = np.zeros((2, count, small.shape[1]), np.bool_)
    spread[0, region, columns] = True
    spread[1, region[floor], columns[floor]] = True
    wide = spread[1].sum(axis=1) >= min_share * spread[0].sum(axis=1)
    good = (supported >= _MIN_REGION_PX) & wide
    good[0] = False
    inside = cv2.dilate(good[region].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    fill = inside & alike & (small == NO_EVIDENCE) & (_under_floor(small) | _between_floor(small))
    filled = mask.copy()
    grown = cv2.resize(fill.astype(np.uint8), mask.shape[::-1], interpolation=cv2.INTER_NEAREST)
    filled[(grown > 0) & (mask == NO_EVIDENCE)] = FLOOR
    return filled


def _under_floor(mask: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Tell where the next evidence up the column is floor."""
    return _last_known(mask) == FLOOR


def _between_floor(mask: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Tell where the next evidence to the left and to the right is floor."""
    left = _last_known(mask.T).T
    right = _last_known(mask[:, ::-1].T).T[:, ::-1]
    return (left == FLOOR) & (right == FLOOR)


def _last_known(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return per pixel the last evidence at or before it, down its column."""
    rows = np.arange(mask.shape[0], dtype=np.int32)[:, None]
    last = np.maximum.accumulate(np.where(mask != NO_EVIDENCE, rows, 0), axis=0)
    return np.take_along_axis(mask, last, axis=0)


def trim_to_edges(
    mask: NDArray[np.uint8], image: NDArray[np.uint8], reach_px: int
) -> NDArray[np.uint8]:
    """Return the mask without floor that only borrowed its texture from the floor below it.

    Texture is measured over a window, so below a blank wall floor reaches up to `reach_px` rows
    too high. There it is cut off at the strongest edge between the two, and where there is none,
    where the texture is its own.
    """
    floor = (mask == FLOOR).astype(np.uint8)
    nothing = (mask == NO_EVIDENCE).astype(np.uint8)
    upward = np.ones((reach_px + 1, 1), np.uint8)
    below_blank = cv2.dilate(nothing, upward, anchor=(0, reach_px)) & floor
    if not below_blank.any():
        return mask
    smooth = cv2.GaussianBlur(image, (3, 5), 0)
    slope = cv2.absdiff(
        cv2.Sobel(smooth, cv2.CV_16S, 0, 1, borderType=cv2.BORDER_REPLICATE), np.array([0.0])
    )
    slope[below_blank == 0] = 0
    strongest = cv2.dilate(slope, np.ones((2 * reach_px + 1, 1), np.uint8))
    edge = ((slope == strongest) & (slope >= _EDGE_SLOPE)).astype(np.uint8)
    under_edge = cv2.dilate(edge, upward, anchor=(0, reach_px))
    trimmed = mask.copy()
    trimmed[(below_blank > 0) & (under_edge == 0)] = NO_EVIDENCE
    return trimmed


def floor_positions(view: FloorView, rows: Array, columns: Array) -> Array:
    """Return where the rays of pixels meet the floor, (N, 2) in the base's plane, in metres."""
    camera, mount = view.camera, view.mount
    rays = camera.back_project(np.stack([columns, rows], axis=1), np.ones(len(rows)))
    depth = -mount.height_m / np.minimum(rays @ mount.up_in_camera, -1e-6)
    T_base_left = mount.T_base_left
    return (rays * depth[:, None]) @ T_base_left[:2, :3].T + T_base_left[:2, 3]


def floor_pixels(view: FloorView, xy_base: Array) -> Array:
    """Return the pixels (N, 2) of positions (N, 2) on the floor; outside the image where behind."""
    T_base_left = view.mount.T_base_left
    points = np.concatenate([xy_base, np.zeros((len(xy_base), 1))], axis=1) - T_base_left[:3, 3]
    in_camera = points @ T_base_left[:3, :3]
    in_front = in_camera[:, 2] > 0.05
    in_camera[~in_front] = (-1e6, -1e6, 1.0)
    return view.camera.project(in_camera)[:, :2]
