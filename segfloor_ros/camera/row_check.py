"""Whether a stereo pair is rectified: a point of the scene stands in the same row of both."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

FEATURES = 800
LEVELS = 2
MIN_MATCHES = 40
BEST_SHARE = 0.5
MAX_DISPARITY_SHARE = 0.4
MAX_ROWS_APART_SHARE = 0.15


def rows_apart_px(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> tuple[float, int] | None:
    """Return by how many rows matching corners of two grey images (H, W) differ, in the median, and
    how many they are; None where too few match to tell.
    """
    orb = cv2.ORB_create(FEATURES, nlevels=LEVELS)
    (left_points, left_words), (right_points, right_words) = (
        orb.detectAndCompute(image, None) for image in (left, right)
    )
    if left_words is None or right_words is None:
        return None
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(left_words, right_words)
    matches = sorted(matches, key=lambda m: m.distance)[: round(BEST_SHARE * len(matches))]
    apart = np.array(
        [np.subtract(left_points[m.queryIdx].pt, right_points[m.trainIdx].pt) for m in matches]
    ).reshape(-1, 2)
    height, width = left.shape
    possible = (apart[:, 0] > -2) & (apart[:, 0] < MAX_DISPARITY_SHARE * width)
    possible &= np.abs(apart[:, 1]) < MAX_ROWS_APART_SHARE * height
    if possible.sum() < MIN_MATCHES:
        return None
    return float(np.median(np.abs(apart[possible, 1]))), int(possible.sum())
