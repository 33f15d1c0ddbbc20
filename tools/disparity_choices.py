"""What each choice of the disparity costs and brings, on pairs whose disparity is known.

Scharstein, Szeliski, High-Accuracy Stereo Depth Maps Using Structured Light (2003): cones, teddy.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.errors import InputError
from segfloor_ros.core.floor.disparity.matching import DisparityMatcher, TwoScaleMatcher
from segfloor_ros.core.floor.settings import FloorSegmentationSettings

TRUTH_STEPS_PER_PX = 4
NUM_DISPARITIES = 64
REPETITIONS = 5
_VISIBLE_PX = 1.0
"""Where both true disparities differ by more, the right camera does not see the pixel."""

Match = Callable[[NDArray[np.uint8], NDArray[np.uint8]], NDArray[np.float32]]


@dataclass(frozen=True)
class TruePair:
    """A rectified grey pair (H, W) uint8 with the true disparity (H, W) float32 of the left image;
    counted: (H, W) bool, where it is known and the right camera sees the pixel, too.
    """

    name: str
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    disparity_px: NDArray[np.float32]
    counted: NDArray[np.bool_]


@dataclass(frozen=True)
class DisparityScore:
    """Shares of the counted pixels: bad_half, bad_1, bad_2, whose disparity is missing or off by
    more than 0.5, 1 or 2 px; wrong_2, of those matched, off by more than 2 px; matched. time_ms:
    median.
    """

    choice: str
    pair: str
    bad_half: float
    bad_1: float
    bad_2: float
    wrong_2: float
    matched: float
    time_ms: float


def choices(settings: FloorSegmentationSettings) -> dict[str, Match]:
    """Return ways to match by name: the one in use, and what one choice at a time changes."""

    def matcher(mode: int = cv2.STEREO_SGBM_MODE_SGBM_3WAY, check: bool = True) -> Match:
        return DisparityMatcher(NUM_DISPARITIES, mode=mode, left_right_check=check).compute

    usual = matcher()
    return {
        'three paths (in use)': usual,
        'five paths': matcher(cv2.STEREO_SGBM_MODE_SGBM),
        'eight paths': matcher(cv2.STEREO_SGBM_MODE_HH),
        'four paths': matcher(cv2.STEREO_SGBM_MODE_HH4),
        'without left-right check': matcher(check=False),
        'without sub-pixel steps': lambda left, right: np.rint(usual(left, right)),
        'left border left out': lambda left, right: _without_border(usual(left, right)),
        'images enlarged twice': _enlarged(),
        'half the resolution': lambda left, right: _halved(settings, left, right),
    }


def read_pairs(folder: Path) -> list[TruePair]:
    """Return the pairs in the subfolders of a folder: im2.png, im6.png, disp2.png, disp6.png, as
    published. Raises InputError.
    """
    pairs = [_read_pair(file.parent) for file in sorted(folder.glob('*/disp2.png'))]
    if not pairs:
        raise InputError(f'{folder}: no folder in it has disp2.png; expected cones/, teddy/')
    return pairs


def score(choice: str, match: Match, pair: TruePair) -> DisparityScore:
    """Match a pair and compare with its truth. With one thread of OpenCV the time is what is spent
    computing.
    """
    clock = time.thread_time if cv2.getNumThreads() == 1 else time.perf_counter
    durations = []
    for _ in range(REPETITIONS):
        start = clock()
        found = match(pair.left, pair.right)
        durations.append(1e3 * (clock() - start))
    found, true = found[pair.counted], pair.disparity_px[pair.counted]
    matched = found > 0
    error = np.where(matched, np.abs(found - true), np.inf)
    return DisparityScore(
        choice,
        pair.name,
        bad_half=float(np.mean(error > 0.5)),
        bad_1=float(np.mean(error > 1)),
        bad_2=float(np.mean(error > 2)),
        wrong_2=float(np.mean(error[matched] > 2)) if matched.any() else 0.0,
        matched=float(np.mean(matched)),
        time_ms=float(np.median(durations)),
    )


def visible(left_px: NDArray[np.float32], right_px: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Tell which pixels (H, W) of the left image the right camera sees, from the true disparities
    of both; 0 where they are not known.
    """
    height, width = left_px.shape
    at = np.arange(width) - np.rint(left_px).astype(np.intp)
    there = right_px[np.arange(height)[:, None], np.clip(at, 0, width - 1)]
    same = np.abs(there - left_px) <= _VISIBLE_PX
    result: NDArray[np.bool_] = (left_px > 0) & (there > 0) & (at >= 0) & same
    return result


def _read_pair(folder: Path) -> TruePair:
    images: list[NDArray[np.uint8]] = []
    for name in ('im2.png', 'im6.png', 'disp2.png', 'disp6.png'):
        image = cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)
        if image is None or (images and image.shape != images[0].shape):
            raise InputError(f'{folder / name}: not an image of the size of the others')
        images.append(image.astype(np.uint8))
    left_px, right_px = (
        image.astype(np.float32) / np.float32(TRUTH_STEPS_PER_PX) for image in images[2:]
    )
    return TruePair(folder.name, images[0], images[1], left_px, visible(left_px, right_px))


def _without_border(disparity: NDArray[np.float32]) -> NDArray[np.float32]:
    disparity[:, :NUM_DISPARITIES] = 0
    return disparity


def _enlarged() -> Match:
    matcher = DisparityMatcher(2 * NUM_DISPARITIES)

    def match(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        size = (2 * left.shape[1], 2 * left.shape[0])
        large = [cv2.resize(image, size).astype(np.uint8) for image in (left, right)]
        return matcher.compute(large[0], large[1])[::2, ::2] / np.float32(2)

    return match


def _halved(
    settings: FloorSegmentationSettings, left: NDArray[np.uint8], right: NDArray[np.uint8]
) -> NDArray[np.float32]:
    near = TwoScaleMatcher(NUM_DISPARITIES, coarse_above_px=8.0)
    return near.compute(left, right, fine_rows=0)
