"""Pictures of what the segmentation did, for people."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.floor.observation import FLOOR, NO_EVIDENCE, NOT_FLOOR, FloorObservation

_COLOURS_BGR = {FLOOR: (60, 200, 60), NO_EVIDENCE: (200, 120, 40), NOT_FLOOR: (60, 60, 200)}


def mask_overlay(left: NDArray[np.uint8], mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the left image (H, W) uint8 tinted by the mask (H, W), as (H, W, 3) BGR: green is
    floor, blue no evidence, red not floor.
    """
    tint = np.zeros((*mask.shape, 3), np.uint8)
    for value, colour in _COLOURS_BGR.items():
        tint[mask == value] = colour
    return cv2.addWeighted(cv2.cvtColor(left, cv2.COLOR_GRAY2BGR), 0.65, tint, 0.35, 0)


def v_disparity_picture(observation: FloorObservation) -> NDArray[np.uint8]:
    """Return the v-disparity of what is not upright with the floor's profile in green, (H, D, 3)
    BGR: rows are image rows, columns disparities in half pixels.
    """
    disparity, mask = observation.disparity_px, observation.mask
    height = disparity.shape[0]
    width = 2 * int(np.ceil(observation.max_disparity_px)) + 1
    rows, columns = np.nonzero((disparity > 0) & (mask != NOT_FLOOR))
    bins = np.rint(2 * disparity[rows, columns]).astype(np.intp)
    counts = np.bincount(rows * width + bins, minlength=height * width)[: height * width]
    brightness = np.log1p(counts) / max(np.log1p(counts.max()), 1.0) * 255
    grey = brightness.reshape(height, width).astype(np.uint8)
    picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    known = np.nonzero(np.isfinite(observation.profile_px))[0]
    if len(known):
        points = np.stack([2 * observation.profile_px[known], known], axis=1)
        line = np.rint(points).astype(np.int32)[:, None]
        cv2.polylines(picture, [line], False, (0, 220, 0), 1)
    return picture
