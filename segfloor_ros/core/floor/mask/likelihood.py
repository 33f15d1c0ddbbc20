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

from segfloor_ros.core.contracts import FLOOR, NOT_FLOOR
from segfloor_ros.core.floor.disparity.matching import (
    BLOCK_PX,
    COARSE_BLOCK_PX,
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

WEIGHTS = {
    'one': 1.27,
    'above': -0.34,
    'rises': 1.27,
    'steep': -1.17,
    'on': 1.61,
    'matched': -1.14,
    'look': 0.95,
}
"""By feature, made by `tools/fit_floor.py`.

one: of a pixel that shows nothing. above: by how many sigmas it is higher than the floor around it.
rises, steep: log ratio of likelihoods that the disparity rises down the image as a floor's, or as
that of what is upright. on: share of what is around it that is on that floor, less that which is
off. matched: log ratio of the difference of both images on the floor to that at the matched
disparity. look: log ratio of how likely its brightness is of the floor to how often it is seen.
"""

_HEIGHT, _LOOK = (list(WEIGHTS).index(name) for name in ('above', 'look'))

_SURE = math.log(0.95 / 0.05)
"""Log odds of what is surely floor; what is less likely than not is none."""
_CARRY_PX = 20.0
"""So far a likelihood is carried where no edge is, in pixels of these pictures."""

_LOCAL, _ROUNDS = (31, 15), 4
"""Columns and rows of the window in which the floor around a pixel is measured, and how often."""
_NOTHING = 0.02
"""So small a share of a window tells nothing."""
_BLOCK, _NEAR, _WIDE = (COARSE_BLOCK_PX, COARSE_BLOCK_PX), (5, 5), (9, 9)
"""Columns and rows of the block that is matched, and of the windows over which pixels are averaged,
and are counted."""
_MOST_PX, _MOST_SIGMAS, _MOST_NATS = 30.0, 12.0, 6.0
"""No feature says more: what is wrong is then as wrong as it can be."""
_WELL_KNOWN = 0.3
"""What is known as well as this on average says all that it can."""
_UNEVEN_PX = 0.05, 1.4
"""How uneven the disparities of floors are, at least and at most."""
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
    lower: bool, what lies deeper than a robot may drop. left_only: bool, what the right camera does
    not see if it is floor. grey: brightness, smoothed. better: log
    ratio of how much the images differ on the floor to how much they do as matched. noise_grey: of
    the images, 0 of depth that is measured. mask: uint8, what
    is floor so far, and what is not.
    """

    floor_px: Picture
    disparity_px: Picture
    slope: float
    texture: Picture
    lower: NDArray[np.bool_]
    left_only: NDArray[np.bool_]
    grey: Picture
    better: Picture
    noise_grey: float
    mask: NDArray[np.uint8]

    @property
    def is_floor(self) -> NDArray[np.bool_]:
        """What is floor so far."""
        return self.mask == FLOOR


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
    one = np.ones_like(known)
    height, mostly_on = _height(seen, weight)
    rises = _rise(seen, weight, known)
    # What is as level as a floor is none where it is higher, and what stands on it is higher.
    is_level = np.exp(-(height**2) / 2)
    rises *= np.where(rises > 0, is_level, (1 - is_level) * (height > 0))
    positive = (np.maximum(values, 0) for values in (height, rises, -rises, mostly_on))
    look = _look(seen.grey, seen.is_floor)
    return np.stack([one, *positive, seen.better * known, look])


def _spread(values: Picture, where: NDArray[np.bool_], bounds: tuple[float, float]) -> np.float32:
    """Return the standard deviation of some values by their median, within bounds; the least where
    there are none.
    """
    some = values[where]
    spread = 1.4826 * float(np.median(np.abs(some))) if len(some) else 0.0
    return np.float32(np.clip(spread, *bounds))


def _height(seen: Seen, weight: Picture) -> tuple[Picture, Picture]:
    """Return how high blocks of pixels are above the floor around them, in sigmas, and which share
    around each is on it, less that which is off it.

    The error is that of this very floor: how blocks differ from the floor around them. The profile
    may lie above the ground beside a stone: at first what is lower counts as floor, but nothing
    that is higher.
    """
    known = (seen.disparity_px > 0).astype(np.float32)
    above = np.clip(seen.disparity_px - seen.floor_px, -_MOST_PX, _MOST_PX) * known
    share = cv2.blur(weight, _BLOCK)
    mean = cv2.blur(weight * above, _BLOCK) / np.maximum(share, np.float32(_NOTHING))
    floor, sigma, lowest = np.zeros_like(above), NOISE_PX, -_MOST_PX
    for _ in range(_ROUNDS):
        gap = mean - floor
        on = share * ((gap < SIGMAS * sigma) & (gap > lowest))
        floor = cv2.blur(on * mean, _LOCAL) / (cv2.blur(on, _LOCAL) + np.float32(_NOTHING))
        gap = mean - floor
        even = (share > LEAST_KNOWN) & (np.abs(gap) < SIGMAS * SAME_PX)
        sigma = float(_spread(gap, even, _UNEVEN_PX))
        lowest = -SIGMAS * sigma
    height = np.clip(gap / np.float32(sigma), -_MOST_SIGMAS, _MOST_SIGMAS)
    on_off = np.where(np.abs(height) < SIGMAS, weight, -weight)
    mostly_on = mean_of_known(on_off, known, _WIDE)[0]
    return height * np.minimum(share / np.float32(_WELL_KNOWN), 1), mostly_on


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
        chosen = list(WEIGHTS.values()) if weights is None else weights
        self.weights = np.array(chosen, np.float32)

    def weighed(self, mask: NDArray[np.uint8], seen: Seen) -> NDArray[np.uint8]:
        """Return a mask (R, W) without floor that is not likely, and with what surely is floor,
        where that is measured, or carried to what only the left camera sees. What lies too low for
        a robot is a drop, or what a floor mirrors, and no floor however it looks.
        """
        known = known_weight(seen)
        every = features(seen, known)
        log_ratio = np.tensordot(self.weights, every, 1)
        near_enough = seen.floor_px > LEAST_FLOOR_PX
        judged = (known > LEAST_KNOWN) & near_enough
        unlikely = judged & (log_ratio < 0)
        is_higher = unlikely & (every[_HEIGHT] > SIGMAS)
        unlikely |= rims(is_higher, judged & (log_ratio > 0), seen)
        sure = judged & ~seen.lower & (log_ratio > _SURE)
        one_sided = seen.left_only & near_enough & ~judged
        if one_sided.any():
            carried = carry(np.where(judged, log_ratio, 0), known * judged, seen)
            carried += every[_LOOK] / 2
            unlikely |= one_sided & (carried < 0)
            sure |= one_sided & (carried > _SURE)
        sure &= ~unlikely
        return with_floor(without_floor(mask, enlarged(unlikely, mask)), enlarged(sure, mask))


def rims(higher: NDArray[np.bool_], likely: NDArray[np.bool_], seen: Seen) -> NDArray[np.bool_]:
    """Return what lies around things (h, w) and looks like them rather than like the likely floor
    next to it: the foot of a thing is no higher than a floor, and at its border the block that is
    matched holds both.
    """
    grey, reach = seen.grey, np.ones((2 * COARSE_BLOCK_PX - 1,) * 2, np.uint8)
    (of_thing, _), (of_floor, variance) = (_around(grey, part) for part in (higher, likely))
    noise = (2 * seen.noise_grey / BLOCK_PX) ** 2
    like_thing = (grey - of_thing) ** 2 < (grey - of_floor) ** 2 + variance / 4 + noise
    alone = cv2.blur(likely.astype(np.float32), _WIDE) < _NOTHING
    near = cv2.dilate(higher.view(np.uint8), reach) > 0
    found: NDArray[np.bool_] = near & (like_thing | alone)
    return found


def _around(grey: Picture, where: NDArray[np.bool_]) -> tuple[Picture, Picture]:
    """Return mean and variance of grey levels around each pixel, of those pixels that are set."""
    part = where.astype(np.float32)
    share = np.maximum(cv2.blur(part, _WIDE), np.float32(1e-3))
    mean, square = (cv2.blur(part * grey**power, _WIDE) / share for power in (1, 2))
    return mean, np.maximum(square - mean**2, 0)


def carry(log_ratio: Picture, weight: Picture, seen: Seen) -> Picture:
    """Return the log ratio of what is known around each pixel (h, w), which edges of the image keep
    from spreading; toward 0 where nothing is near. weight: of what is known.

    The normalised convolution of Gastal and Oliveira, Domain Transform for Edge-Aware Image and
    Video Processing (2011), of a quarter of the resolution, along rows and then along columns.
    What stands is no floor, however little of it is measured.
    """
    stands = seen.mask == NOT_FLOOR
    weight = np.where(stands, np.float32(1), np.minimum(weight / np.float32(0.5), 1))
    values = np.where(stands, np.float32(-_MOST_NATS), np.clip(log_ratio, -_MOST_NATS, _MOST_NATS))
    # Farther from these columns nothing gets there.
    reach = int(np.flatnonzero(seen.left_only.any(axis=0))[-1]) + 2 * round(_CARRY_PX)
    parts = np.stack([values * weight, weight])[:, :, :reach]
    size = parts.shape[:0:-1]
    parts = np.stack([cv2.blur(part, (3, 3))[::2, ::2] for part in parts])
    level = np.log(cv2.GaussianBlur(seen.grey[:, :reach], (3, 3), 0)[::2, ::2] + 8)
    steps = [np.abs(np.diff(level, axis=i, prepend=np.take(level, [0], axis=i))) for i in (1, 0)]
    floor = parts[1] > LEAST_KNOWN
    own = np.median(np.concatenate([step[floor] for step in steps])) if floor.any() else 1.0
    for step, axis in zip(steps, (1, 0), strict=True):
        kept = np.exp(-(2 / _CARRY_PX + np.maximum(step / (2 * max(own, 1e-3)) - 1, 0)))
        parts = _spread_along(parts, kept.astype(np.float32), axis)
    carried = cv2.resize(parts[0] / (parts[1] + np.float32(_NOTHING)), size)
    whole = np.zeros_like(log_ratio)
    whole[:, :reach] = carried
    return whole


def _spread_along(parts: Picture, kept: Picture, axis: int) -> Picture:
    """Return pictures (n, h, w) with what comes from both sides along an axis; kept: (h, w), which
    share of that is left from the pixel before on.
    """
    lines, share = np.moveaxis(parts, axis + 1, 0), np.moveaxis(kept, axis, 0)
    forth, back = lines.copy(), lines.copy()
    for i in range(1, len(lines)):
        forth[i] += share[i] * forth[i - 1]
        back[-1 - i] += share[-i] * back[-i]
    return np.moveaxis(forth + back - lines, 0, axis + 1)
