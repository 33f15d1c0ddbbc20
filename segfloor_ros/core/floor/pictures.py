"""Pictures of what the segmentation sees, for people."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, NOT_FLOOR, FloorObservation

_COLOURS_BGR = {FLOOR: (60, 200, 60), NO_EVIDENCE: (200, 120, 40), NOT_FLOOR: (60, 60, 200)}

_MOVING_BGR = (200, 40, 225)

MASK_COLOURS = {
    'floor': _COLOURS_BGR[FLOOR],
    'not floor': _COLOURS_BGR[NOT_FLOOR],
    'no evidence': _COLOURS_BGR[NO_EVIDENCE],
    'moving': _MOVING_BGR,
}
"""Blue, green, red of what `mask_overlay` tints."""


def mask_overlay(
    left: NDArray[np.uint8], mask: NDArray[np.uint8], moving: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Return the left image (H, W) uint8 tinted by the mask (H, W), as (H, W, 3) BGR: green is
    floor, blue no evidence, red not floor, and magenta what moves, the mask (H, W) of which is 255.
    """
    tint = np.zeros((*mask.shape, 3), np.uint8)
    for value, colour in _COLOURS_BGR.items():
        tint[mask == value] = colour
    if moving is not None:
        tint[moving > 0] = _MOVING_BGR
    return cv2.addWeighted(cv2.cvtColor(left, cv2.COLOR_GRAY2BGR), 0.65, tint, 0.35, 0)


def v_disparity_picture(observation: FloorObservation) -> NDArray[np.uint8]:
    """Return the filtered v-disparity with the floor's profile in green, (H, B, 3) BGR: rows are
    rows of the de-rolled image, columns bins of disparity; the brighter the more pixels.
    """
    counted, profile = observation.v_disparity, observation.profile_px
    height, bins = len(profile), counted.counts.shape[1]
    rows = np.arange(counted.first_row, counted.first_row + len(counted.counts))
    inside = (rows >= 0) & (rows < height)
    light = np.log1p(counted.counts[inside].astype(np.float64))
    grey = np.zeros((height, bins), np.uint8)
    grey[rows[inside]] = 255 * light / max(light.max(initial=0.0), 1e-6)
    picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    known = np.flatnonzero(np.isfinite(profile))
    if len(known):
        points = np.stack([counted.bins_per_px * profile[known], known], axis=1)
        line = np.rint(points).astype(np.int32)[:, None]
        cv2.polylines(picture, [line], False, _COLOURS_BGR[FLOOR], 1)
    return picture.astype(np.uint8)
