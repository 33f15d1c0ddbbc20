"""How likely each pixel is floor: one log-likelihood ratio of all that is known of it.

A feature is a physical quantity over what it errs by, so that its weight holds for all cameras. The
weights are those of a logistic regression on pixels whose truth is known, as many of floor as of
anything else: `tools/fit_floor.py` makes them, and shows how well weights do that have not seen a
recording.

All pictures here are of half the resolution of the image, (h, w) float32.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.floor.disparity.matching import NOISE_PX, NOISE_SLOPE, SAME_PX, SIGMAS
from segfloor_ros.core.floor.disparity.profile import STEP_PX
from segfloor_ros.core.floor.mask.look import sigmas_off_floor
from segfloor_ros.core.floor.mask.painting import (
    LEAST_KNOWN,
    enlarged,
    mean_of_known,
    with_floor,
    without_floor,
)
from segfloor_ros.core.floor.mask.pixel_evidence import LEAST_FLOOR_PX
from segfloor_ros.core.geometry import Array

Picture = NDArray[np.float32]

WEIGHTS = {
    'one': 0.68,
    'above': -0.41,
    'rises': 0.88,
    'steep': -1.83,
    'on': 2.05,
    'matched': -1.48,
    'look': 0.93,
}
"""By feature, made by `tools/fit_floor.py`.

one: of a pixel that shows nothing. above: by how many sigmas it is higher than the floor around it.
rises, steep: log ratio of likelihoods that the disparity rises down the image as a floor's, or as
that of what is upright. on: share of what is around it that is on that floor, less that which is
off. matched: log ratio of the difference of both images on the floor to that at the matched
disparity. look: log ratio of how likely its brightness is of the floor to how often it is seen.
"""

_SURE, _UNLIKELY = (math.log(p / (1 - p)) for p in (0.95, 1 / 3))
"""Log odds: what is more likely floor than the first is floor, what is less likely than the second
is none."""

_LOCAL, _ROUNDS = (31, 15), 3
"""Columns and rows of the window in which the floor around a pixel is measured, and how often."""
_NOTHING = 0.02
"""So small a share of a window tells nothing."""
_NEAR, _WIDE = (5, 5), (9, 9)
"""Columns and rows of the windows over which pixels are averaged, and are counted."""
_MOST_SIGMAS, _MOST_NATS = 12.0, 6.0
"""No feature says more: what is wrong is then as wrong as it can be."""
_UNEVEN = 0.7, 2.8
"""How uneven floors are, in sigmas of a disparity, at least and at most."""
_RISE_SIGMA_PX = 0.7, 2.0
"""Error of the difference of two disparities, at least and at most."""
_BINS, _END = 2, 10
"""Of the histogram of brightness, per sigma of the floor's; it ends at so many sigmas."""
_LOOK_NATS = -4.0, 3.0
"""Bounds of what a look says."""


@dataclass(frozen=True)
class Seen:
    """What is known of each pixel.

    floor_px, disparity_px: disparity of the floor, and the matched one, 0 where none is. slope: of
    a floor's disparity, per row of the image. texture: as many times of what is surely no noise.
    lower: bool, what lies deeper than a robot may drop. grey: brightness, smoothed. better: log
    ratio of how much the images differ on the floor to how much they do as matched. noise_grey: of
    the images, 0 of depth that is measured. is_floor: bool, what is floor so far.
    """

    floor_px: Picture
    disparity_px: Picture
    slope: float
    texture: Picture
    lower: NDArray[np.bool_]
    grey: Picture
    better: Picture
    noise_grey: float
    is_floor: NDArray[np.bool_]


def known_weight(seen: Seen) -> Picture:
    """Return how well the disparity of each pixel is known (h, w), in [0, 1], 1 where as well as it
    can be: the bound of Cramer and Rao of what the block around a pixel shows.
    """
    weight: Picture = np.clip(2 * seen.texture - 1, 0, 1) * (seen.disparity_px > 0)
    slope = cv2.Sobel(seen.grey, cv2.CV_32F, 1, 0, ksize=1, scale=1 / (2 * STEP_PX))
    pixels = _NEAR[0] * _NEAR[1]
    power = cv2.boxFilter(slope * slope, -1, _NEAR, normalize=False)
    power -= np.float32(pixels * NOISE_SLOPE * seen.noise_grey**2)
    variance = np.float32(2 * seen.noise_grey**2) / np.maximum(power, np.float32(1e-3))
    return weight * (np.float32(NOISE_PX) / np.sqrt(np.float32(NOISE_PX**2) + variance))


def features(seen: Seen, weight: Picture) -> Picture:
    """Return the features (F, h, w) of all pixels, in the order of `WEIGHTS`. weight: as of
    `known_weight`.
    """
    known = (seen.disparity_px > 0).astype(np.float32)
    height, mostly_on = _local_height(seen, weight, known)
    rises = _rise(seen, weight, known)
    # What is as level as a floor is none where it is higher, and what stands on it is higher.
    is_higher = 1 - np.exp(-(np.maximum(height, 0) ** 2) / 2)
    rises *= np.where(rises > 0, np.exp(-(height**2) / 8), is_higher)
    positive = (np.maximum(values, 0) for values in (height, rises, -rises, mostly_on))
    look = _look(seen.grey, seen.is_floor)
    return np.stack([np.ones_like(known), *positive, seen.better * known, look])


def _spread(values: Picture, where: NDArray[np.bool_], bounds: tuple[float, float]) -> np.float32:
    """Return the standard deviation of some values by their median, within bounds; the least where
    there are none.
    """
    some = values[where]
    spread = 1.4826 * float(np.median(np.abs(some))) if len(some) else 0.0
    return np.float32(np.clip(spread, *bounds))


def _local_height(seen: Seen, weight: Picture, known: Picture) -> tuple[Picture, Picture]:
    """Return how high pixels are above the floor around them, in sigmas, and which share around
    each is on it, less that which is off it.

    The profile may lie above the ground beside a stone: at first what is lower counts as floor, but
    nothing that is higher.
    """
    above = np.clip((seen.disparity_px - seen.floor_px) / np.float32(NOISE_PX), -60, 60) * known
    floor, lowest = np.zeros_like(above), -60.0
    for _ in range(_ROUNDS):
        gap = above - floor
        on = weight * ((gap < SIGMAS * 1.5) & (gap > lowest))
        floor = cv2.blur(on * above, _LOCAL) / (cv2.blur(on, _LOCAL) + np.float32(_NOTHING))
        lowest = -SIGMAS * 1.5
    smooth = mean_of_known(above, known, _NEAR)[0] - floor
    even = (weight > LEAST_KNOWN) & (np.abs(smooth) < 3 * SIGMAS)
    height = (above - floor) / _spread(smooth, even, _UNEVEN)
    bounded = np.clip(height, -_MOST_SIGMAS, _MOST_SIGMAS) * weight
    on_off = np.where(np.abs(height) < SIGMAS, weight, -weight)
    near, wide = mean_of_known(bounded, known, _NEAR)[0], mean_of_known(on_off, known, _WIDE)[0]
    return near * known, wide


def _rise(seen: Seen, weight: Picture, known: Picture) -> Picture:
    """Return the log ratio of the likelihoods that disparities rise down the image as those of a
    floor and that they do not, as those of what is upright.

    They are compared over as many rows as it takes a floor to rise by more than noise.
    """
    rows = math.ceil(SAME_PX / seen.slope / STEP_PX)
    rows = max(1, min(rows, (len(known) - 1) // 2))
    far, near = np.s_[: -2 * rows], np.s_[2 * rows :]
    rise = seen.disparity_px[near] - seen.disparity_px[far]
    of_floor = seen.floor_px[near] - seen.floor_px[far]
    both = weight[rows:-rows] * known[near] * known[far]
    off = rise - of_floor
    sigma = _spread(off, (both > LEAST_KNOWN) & (np.abs(off) < 4 * SAME_PX), _RISE_SIGMA_PX)
    ratio = np.zeros_like(known)
    nats = of_floor * (2 * rise - of_floor) / (2 * sigma**2)
    ratio[rows:-rows] = np.clip(nats, -_MOST_NATS, _MOST_NATS) * both
    return mean_of_known(ratio, known, _NEAR)[0]


def _look(grey: Picture, is_floor: NDArray[np.bool_]) -> Picture:
    """Return the log ratio of how likely the brightness of each pixel is of the floor to how often
    one so far from the floor's is seen; 0 where no floor is known.
    """
    sigmas = sigmas_off_floor(grey, is_floor, STEP_PX)
    bins = np.clip(sigmas * _BINS + _END * _BINS + 0.5, 0, 2 * _END * _BINS).astype(np.intp)
    often = np.bincount(bins[::2, ::2].ravel(), minlength=2 * _END * _BINS + 1) + 1.0
    often = np.convolve(often, (0.25, 0.5, 0.25), 'same')
    log_often = np.log(often * (_BINS / often.sum())).astype(np.float32)
    ratio = -0.5 * sigmas**2 - np.float32(0.5 * math.log(2 * math.pi)) - log_often[bins]
    look: Picture = np.clip(ratio, *_LOOK_NATS) * is_floor.any()
    return look


class Likelihood:
    """Finds how likely the pixels of a frame are floor. weights: of the features, (F,); `WEIGHTS`
    where none are given."""

    def __init__(self, weights: Sequence[float] | Array | None = None) -> None:
        self.weights = np.array(list(WEIGHTS.values()) if weights is None else weights, np.float32)

    def weighed(self, mask: NDArray[np.uint8], seen: Seen) -> NDArray[np.uint8]:
        """Return a mask (R, W) without floor that is not likely, and with what surely is floor,
        where that is measured. What lies too low for a robot is a drop, or what a floor mirrors,
        and no floor however it looks.
        """
        known = known_weight(seen)
        log_ratio = np.tensordot(self.weights, features(seen, known), 1)
        judged = (known > LEAST_KNOWN) & (seen.floor_px > LEAST_FLOOR_PX)
        unlikely = judged & (log_ratio < _UNLIKELY)
        sure = judged & ~seen.lower & (log_ratio > _SURE)
        return with_floor(without_floor(mask, enlarged(unlikely, mask)), enlarged(sure, mask))
