"""How likely each pixel is floor: one log-likelihood ratio of all that is known of it.

A feature is a physical quantity over what it errs by, so that its weight holds for all cameras. The
weights are those of a logistic regression on pixels whose truth is known, as many of floor as of
anything else: `tools/fit_floor.py` makes them, and shows how well weights do that have not seen a
recording.

All pictures here are of half the resolution of the image, (h, w) float32.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import FLOOR, NOT_FLOOR
from segfloor_ros.core.floor.disparity.matching import (
    COARSE_BLOCK_PX,
    MEAN_NOISE,
    NOISE_PX,
    NOISE_SLOPE,
    SAME_PX,
    SIGMAS,
)
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

WEIGHTS = {'one': 0.87, 'above': -0.38, 'rises': 1.49, 'steep': -1.34, 'on': 1.11, 'look': 1.35}
"""By feature, made by `tools/fit_floor.py`.

one: of a pixel that shows nothing. above: by how many sigmas it is higher than the floor around it.
rises, steep: log ratio of likelihoods that the disparity rises down the image as a floor's, or as
that of what is upright. on: share of what is around it that is on that floor, less that which is
off. look: log likelihood of its brightness as of the floor.
"""

_OF_HEIGHT = [list(WEIGHTS).index(name) for name in ('above', 'steep')]
_SURE = math.log(0.95 / 0.05)
"""Log odds of what is surely floor; what is less likely than not is none."""
_CARRY_PX = 20.0
"""So far a likelihood is carried where no edge is, in pixels of these pictures."""

_LOCAL, _ROUNDS = (31, 15), 8
"""Columns and rows of the window in which the floor around a pixel is measured, and how often."""
_NOTHING, _DENSE = 0.02, 0.5
"""A share of a window that tells nothing, and one that ground reaches where both cameras see it:
elsewhere some is matched by chance."""
_BLOCK, _NEAR, _WIDE = (COARSE_BLOCK_PX, COARSE_BLOCK_PX), (5, 5), (9, 9)
"""Columns and rows of the block that is matched, and of the windows over which pixels are averaged,
and are counted."""
_MOST_SIGMAS, _MOST_NATS = 12.0, 6.0
"""No feature says more: what is wrong is then as wrong as it can be."""
_UNEVEN_PX, _RISE_SIGMA_PX = (MEAN_NOISE * NOISE_PX, 1.4), (0.7, 2.0)
"""How uneven the disparities of floors are, at least, as neighbours err together, and at most; and
the error of the difference of two.
"""
_BINS, _END = 2, 10
"""Of the histogram of brightness, per sigma of the floor's; it ends at so many sigmas."""
_FOREIGN, _UNSEEN = 0.05, 0.2
"""Share of a floor that may look like anything; of what stands, like anything or like the floor, as
not all of it is known."""


@dataclass(frozen=True)
class Seen:
    """What is known of each pixel.

    floor_px, disparity_px: disparity of the floor, and the matched one, 0 where none is. slope: of
    a floor's disparity, per row of the image. texture: as many times of what is surely no noise.
    lower: bool, what lies deeper than a robot may drop. left_only: bool, what the right camera does
    not see if it is floor. grey: brightness, smoothed. noise_grey: of the images, 0 of depth that
    is measured. step: what a robot climbs, over how much higher the camera is. mask: uint8, what is
    floor so far, and what is not.
    """

    floor_px: Picture
    disparity_px: Picture
    slope: float
    texture: Picture
    lower: NDArray[np.bool_]
    left_only: NDArray[np.bool_]
    grey: Picture
    noise_grey: float
    step: float
    mask: NDArray[np.uint8]


def known_weight(seen: Seen) -> Picture:
    """Return how well the disparity of each pixel is known (h, w), in [0, 1], 1 where as well as it
    can be: the bound of Cramer and Rao of what the block around a pixel shows.
    """
    weight: Picture = np.clip(2 * seen.texture - 1, 0, 1) * (seen.disparity_px > 0)
    slope = cv2.Sobel(seen.grey, cv2.CV_32F, 1, 0, ksize=1, scale=1 / (2 * STEP_PX))
    power = cv2.boxFilter(slope * slope, -1, _BLOCK, normalize=False)
    power -= np.float32(_BLOCK[0] * _BLOCK[1] * NOISE_SLOPE * seen.noise_grey**2)
    variance = np.float32(2 * seen.noise_grey**2) / np.maximum(power, np.float32(1e-3))
    return weight * (np.float32(NOISE_PX) / np.sqrt(np.float32(NOISE_PX**2) + variance))


def features(seen: Seen, weight: Picture) -> tuple[Picture, NDArray[np.bool_]]:
    """Return the features (F, h, w) of all pixels, in the order of `WEIGHTS`, and what is no higher
    than a robot climbs (h, w). weight: as of `known_weight`.
    """
    known = (seen.disparity_px > 0).astype(np.float32)
    height, mostly_on, is_low = _height(seen, weight, known)
    rises = _rise(seen, weight, known)
    # What is as level as a floor is none where it is higher, and what stands on it is higher.
    is_level = np.exp(-(height**2) / 2)
    rises *= np.where(rises > 0, is_level, (1 - is_level) * (height > 0))
    positive = (np.maximum(values, 0) for values in (height, rises, -rises, mostly_on))
    return np.stack([np.ones_like(known), *positive, _look(seen)]), is_low


def _spread(values: Picture, where: NDArray[np.bool_], bounds: tuple[float, float]) -> np.float32:
    """Return the standard deviation of some values by their median, within bounds; the least where
    there are none.
    """
    some = values[where]
    spread = 1.4826 * float(np.median(np.abs(some))) if len(some) else 0.0
    return np.float32(np.clip(spread, *bounds))


def _height(
    seen: Seen, weight: Picture, known: Picture
) -> tuple[Picture, Picture, NDArray[np.bool_]]:
    """Return how high blocks of pixels are above the floor around them, in sigmas; which share
    around each is on it, less that which is off it; and what is no higher than a robot climbs.

    The error is that of this very floor: how blocks differ from the floor around them. The profile
    may lie above the ground beside a stone: at first what is lower counts as floor, but nothing
    that is higher.
    """
    most_px = _MOST_SIGMAS * SAME_PX
    above = np.clip(seen.disparity_px - seen.floor_px, -most_px, most_px) * known
    share = cv2.blur(weight, _BLOCK)
    # Each counts by the inverse of its variance.
    squares = weight * weight
    mean = cv2.blur(squares * above, _BLOCK)
    mean /= np.maximum(cv2.blur(squares, _BLOCK), np.float32(1e-6))
    floor, sigma, lowest = np.zeros_like(above), NOISE_PX, -2 * most_px
    for _ in range(_ROUNDS):
        gap = mean - floor
        on = share * ((gap < SIGMAS * sigma) & (gap > lowest))
        floor = cv2.blur(on * mean, _LOCAL) / (cv2.blur(on, _LOCAL) + np.float32(_NOTHING))
        gap = mean - floor
        even = (share > LEAST_KNOWN) & (np.abs(gap) < SIGMAS * SAME_PX)
        sigma = float(_spread(gap, even, _UNEVEN_PX))
        lowest = -SIGMAS * sigma
    height = np.clip(gap / np.float32(sigma), -_MOST_SIGMAS, _MOST_SIGMAS)
    is_low = gap < np.minimum(np.float32(seen.step) * (seen.floor_px + floor), most_px / 2)
    on_off = np.where(np.abs(height) < SIGMAS, weight, -weight)
    mostly_on = mean_of_known(on_off, known, _WIDE)[0]
    return height * np.minimum(share / np.float32(LEAST_KNOWN), 1), mostly_on, is_low


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


def _look(seen: Seen) -> Picture:
    """Return the log ratio of how often the brightness of each pixel is seen of the floor and of
    what stands on it; 0 where no floor is known.
    """
    is_floor = seen.mask == FLOOR
    sigmas = sigmas_off_floor(seen.grey, is_floor, STEP_PX)
    bins = np.clip(sigmas * _BINS + (_END * _BINS + 0.5), 0, 2 * _END * _BINS).astype(np.intp)
    number = 2 * _END * _BINS + 1
    prior, found = np.full(number, 1 / number), []
    for some, other in ((is_floor, _FOREIGN), (seen.mask == NOT_FLOOR, _UNSEEN)):
        counts = np.convolve(np.bincount(bins[some], minlength=number), (0.25, 0.5, 0.25), 'same')
        # The fewer are seen the more counts what is known before.
        share = (1 - other) / (counts.sum() + number)
        found.append(share * (counts + number * prior) + other * prior)
        prior = (prior + found[0]) / 2
    look: Picture = np.log(found[0] / found[1]).astype(np.float32)[bins]
    return look * np.float32(sigmas.any())


def _with_border(part: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a part of the picture with its border: there the block that is matched holds both, and
    the foot of a thing is no higher than the floor.
    """
    return cv2.dilate(part.view(np.uint8), np.ones(_BLOCK, np.uint8)) > 0


class Likelihood:
    """Finds how likely the pixels of a frame are floor. weights: of the features, (F,); `WEIGHTS`
    where none are given."""

    def __init__(self, weights: Array | None = None) -> None:
        self.weights = np.array(list(WEIGHTS.values()) if weights is None else weights, np.float32)

    def weighed(
        self, mask: NDArray[np.uint8], seen: Seen
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return a mask (R, W) without floor that is not likely, or too far to be judged, and with
        what surely is floor, where that is measured, or carried to what only the left camera sees;
        and what is none only as it is higher, though no higher than a robot climbs (R, W). What
        lies too low for a robot is a drop, or what a floor mirrors, and no floor however it looks.
        """
        known = known_weight(seen)
        every, is_low = features(seen, known)
        log_ratio = np.tensordot(self.weights, every, 1)
        near_enough = seen.floor_px > LEAST_FLOOR_PX
        judged = (known > LEAST_KNOWN) & near_enough
        unlikely = judged & (log_ratio < 0)
        of_height = np.tensordot(self.weights[_OF_HEIGHT], every[_OF_HEIGHT], 1)
        climbed = unlikely & is_low & (log_ratio > of_height)
        is_higher = judged & (log_ratio < -_SURE) & (every[1] > SIGMAS)
        blocked = (unlikely & ~climbed) | _with_border(is_higher & ~climbed)
        unlikely |= _with_border(is_higher)
        climbed = unlikely & ~blocked & (seen.mask != NOT_FLOOR)
        sure = judged & ~seen.lower & (log_ratio > _SURE)
        one_sided = seen.left_only & near_enough & ~judged
        # What both cameras see there is a drop, if it is more than some matches by chance.
        shown = mean_of_known(known, (seen.texture > 1).astype(np.float32), _WIDE)[0]
        counts = judged & ~(seen.left_only & (shown < _DENSE))
        values = np.where(seen.lower, np.float32(-_MOST_NATS), log_ratio)
        carried = carry(values, known * counts, seen)
        carried += every[-1] / 2
        unlikely |= ~near_enough | (one_sided & (carried < 0))
        sure |= one_sided & (carried > _SURE)
        sure &= ~unlikely
        found = with_floor(without_floor(mask, enlarged(unlikely, mask)), enlarged(sure, mask))
        return found, enlarged(climbed, mask)


def carry(log_ratio: Picture, weight: Picture, seen: Seen) -> Picture:
    """Return the log ratio of what is known to the right of each pixel (h, w), which edges of the
    image keep from spreading; toward 0 where nothing is near. weight: of what is known.

    Along rows, as the normalised convolution of Gastal and Oliveira, Domain Transform for
    Edge-Aware Image and Video Processing (2011). What stands is no floor, however little of it is
    measured.
    """
    stands = seen.mask == NOT_FLOOR
    weight = np.where(stands, np.float32(1), weight)
    bounded = np.clip(np.where(stands, -_MOST_NATS, log_ratio), -_MOST_NATS, _MOST_NATS)
    level = np.log(cv2.blur(seen.grey, (5, 5)) + 8)
    step = np.abs(np.diff(level, axis=1, append=level[:, -1:]))
    own = float(np.median(step[weight * bounded > LEAST_KNOWN].tolist() or 1.0))
    kept = np.exp(-1 / _CARRY_PX - np.maximum(step / (2 * max(own, 1e-3)) - 1, 0))
    parts = np.stack([cv2.blur(part, (5, 15)) for part in (bounded * weight, weight)])
    for column in reversed(range(parts.shape[2] - 1)):
        parts[..., column] += kept[:, column] * parts[..., column + 1]
    return np.asarray(parts[0] / (parts[1] + np.float32(_NOTHING)))
