"""What each pixel says: floor, not floor, or nothing.

A pixel is judged by its own disparity: its height above the floor that has the same disparity.

The floor is tested on the images themselves, too. Semi-global matching prefers surfaces that face
the camera and, where texture is weak, agrees with whatever repeats: the blocks of a compressed
image, its neighbours. Here the right image is drawn as it would look were everything floor, and
compared with the left one. What then agrees about as well as it does with the matched disparities
cannot be said not to be floor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.pixels import SUBPIXEL, measured_sigma_px
from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, NOT_FLOOR
from segfloor_ros.core.floor.disparity.matching import (
    BLOCK_PX,
    MEAN_NOISE,
    NOISE_PX,
    SAME_PX,
    SIGMAS,
)
from segfloor_ros.core.floor.disparity.profile import (
    STEP_PX,
    FloorProfile,
    FloorView,
    growth,
    histogram,
    pixels_where,
    surface_above,
)
from segfloor_ros.core.floor.mask.painting import LEAST_KNOWN, enlarged, mean_of_known
from segfloor_ros.core.floor.pair import Pair
from segfloor_ros.core.floor.settings import FloorSegmentationSettings

LEAST_FLOOR_PX = 2.5
"""Farther floor, of smaller disparity, is not judged."""
_CONTACT_HEIGHT_M = 0.12
"""Up to this height an upright surface is taken to stand on the floor below it."""


_NEIGHBOURS_PX = 9, 9
"""Heights are averaged over so wide a square; ones that are matched err together."""
_MOST_SIGMAS = np.float32(10)

_AGAINST_GREY = 1.0
"""By how much the images must contradict the floor to deny it, beyond their noise."""
_LIKENESS_GREY = 3.0
"""How much left and right may differ on the floor, beyond their noise."""
_WIDE, _WIDE_RATIO, _WIDE_MARGIN_GREY, _WIDE_SHARE = (15, 15), 1.15, 0.05, 0.65
"""What too little texture leaves open in a small window a larger one often tells: floor is denied
there where it differs by this much more than what was matched, over so much of the window."""
_FOREIGN = 0.4, 0.3
"""Correlation of both eyes from which on it says something, if all differences are noise; and the
share of it below which they show different things."""
_MARGIN_PX = 4.0
"""So near to the right image's border interpolation is unsure."""
_NOISE_SHARE = 2.0
"""Two images of the same thing differ by 1.13 sigma of noise on average, and by interpolation."""

_UPRIGHT_WINDOW = 7, 5
"""Columns and rows of the window above the contact in which the upright surface is measured."""
_GAP_ROWS = 2
_MIN_SHARE = 0.25
_MAX_SPREAD_PX = 1.2


@dataclass(frozen=True)
class Comparison:
    """What the images say of each pixel of a view, (R, W) bool where not said otherwise.

    floor_px: (R / 2, W') float32, the floor's disparity at half the resolution of the image.
    against: clearly more like the matched disparity than like floor. denied: the same of the
    surroundings taken together. unlike: unlike floor, whatever it is. consistent: may be floor, not
    denied.
    """

    floor_px: NDArray[np.float32]
    against: NDArray[np.bool_]
    denied: NDArray[np.bool_]
    unlike: NDArray[np.bool_]
    consistent: NDArray[np.bool_]


@dataclass(frozen=True)
class Heights:
    """What disparities say of how high pixels lie, (R, W).

    height, noise: above the floor, float32 in metres, and its error, one sigma. above, off: bool,
    higher than floor can be, or lower, too; near: no higher than what is upright and stands on the
    floor right below.
    """

    height: NDArray[np.float32]
    noise: NDArray[np.float32]
    above: NDArray[np.bool_]
    off: NDArray[np.bool_]
    near: NDArray[np.bool_]

    @cached_property
    def mean_sigmas(self) -> NDArray[np.float32]:
        """Height of each pixel (R, W) in the mean of its neighbours, in sigmas of one of them; NaN
        where that is not known.
        """
        return _mean_of_neighbours(self.height / self.noise)

    @cached_property
    def mean_off(self) -> NDArray[np.bool_]:
        """What in the mean of its neighbours lies off the floor (R, W), by more than their noise
        explains.
        """
        return np.abs(self.mean_sigmas) > SIGMAS * MEAN_NOISE

    @classmethod
    def of(
        cls,
        view: FloorView,
        profile: FloorProfile,
        pair: Pair,
        disparity: NDArray[np.float32],
        num_disparities: int,
        settings: FloorSegmentationSettings,
    ) -> Heights:
        """Return the heights of the pixels of a view, of known disparities (R, W), by a table of as
        many as are searched.
        """
        line, steps = view.line, np.arange(num_disparities * SUBPIXEL + 1) / SUBPIXEL
        steps[0] = np.nan
        scale = line.metres_per_row / steps
        constant, is_matched = view.camera.disparity_times_depth, pair.measured is None
        noise_px = NOISE_PX if is_matched else measured_sigma_px(constant, steps)
        # One pixel of disparity is this much height: the camera's height over the disparity.
        noise = noise_px * line.metres_per_row / line.slope / steps
        row = profile.row_of_disparity(steps)
        up = np.hypot(settings.step_height_m, noise)
        down = settings.drop_height_m + SIGMAS * noise
        # What is nearer than the table goes is no lower than what is as near as that.
        last = np.float32(len(steps) - 1)
        index = np.minimum(disparity * np.float32(SUBPIXEL), last).astype(np.int32)
        tables = scale * row, scale, noise, up, down
        at_row_0, scale, noise, up, down = (
            table.astype(np.float32).take(index) for table in tables
        )
        height = at_row_0 - scale * view.derolled
        above, near = height > up, height < up + np.float32(_CONTACT_HEIGHT_M)
        return cls(height, noise, above, above | (height < -down), near)


@dataclass(frozen=True)
class FrameEvidence:
    """What is known of the pixels of a frame. disparity_px: (R, W), 0 where there is none."""

    view: FloorView
    profile: FloorProfile
    pair: Pair
    disparity_px: NDArray[np.float32]
    heights: Heights
    compared: Comparison

    @cached_property
    def upright_px(self) -> NDArray[np.float32]:
        """Disparity of the upright surface right above each pixel, NaN where none is, at half the
        resolution in both directions of the image. Where nothing has texture, disparities are of
        noise.
        """
        half = self.view.half
        disparity, textured = self.disparity_px[half], self.pair.textured[half]
        counted = ~self.compared.consistent[half] & textured & (disparity > 0)
        surface = disparity, counted.astype(np.float32), _UPRIGHT_WINDOW, _GAP_ROWS
        average, variance, share = surface_above(*surface)
        good = (share >= _MIN_SHARE) & (variance < _MAX_SPREAD_PX**2)
        return np.where(good, average, np.float32(np.nan))


def judge(frame: FrameEvidence) -> NDArray[np.uint8]:
    """Return a mask (R, W) of what the pixels of a frame say by themselves.

    A disparity makes floor only where the images agree, and denies it only where they do.
    """
    view, compared, heights = frame.view, frame.compared, frame.heights
    above, off, textured = heights.above, heights.off, frame.pair.textured
    # What seems to lie below the floor may be what the floor mirrors.
    sure = (textured & compared.against) | (compared.denied & above)
    may_be = textured & ~off & (frame.disparity_px >= np.float32(LEAST_FLOOR_PX))
    mask = np.full(off.shape, NO_EVIDENCE, np.uint8)
    mask[may_be & ~(compared.against | compared.unlike)] = FLOOR
    mask[above & sure] = NOT_FLOOR
    mask[_below_contact(frame, above & sure & heights.near)] = NOT_FLOOR
    mask[view.derolled <= view.line.horizon] = NOT_FLOOR
    return mask


def last_evidence(
    mask: NDArray[np.uint8], axis: int = 0
) -> tuple[NDArray[np.int16], NDArray[np.bool_]]:
    """Return of each pixel of a mask (R, W) where along an axis the last evidence up to it is, -1
    where there is none, and whether that is floor.
    """
    twice = np.arange(2, 2 * mask.shape[axis] + 2, 2, dtype=np.int16)
    evidence = (twice if axis else twice[:, None]) * (mask != NO_EVIDENCE)  # odd where it is floor
    evidence |= mask == FLOOR
    np.maximum.accumulate(evidence, axis=axis, out=evidence)
    return (evidence >> 1) - 1, evidence & 1 > 0


def below_floor(mask: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Tell of each pixel of a mask (R, W) whether the next evidence up its column is floor."""
    return last_evidence(mask)[1]


def lies_on_floor(
    view: FloorView, disparity: NDArray[np.float32], heights: Heights
) -> NDArray[np.bool_]:
    """Return which pixels (R, W) have a disparity of a floor, and rise down the image as one does
    in the mean of their neighbours: the foot of what stands is no higher than a floor, but steeper.

    They are compared with so far above and below that floor differs by more than noise.
    """
    half = min(math.ceil(SAME_PX / view.line.slope), len(disparity) // 2)
    known_px = np.where(disparity > 0, disparity, np.float32(np.nan))
    steeper_px = growth(known_px, half) - np.float32(2 * half * view.line.slope)
    mean = _mean_of_neighbours(steeper_px / np.float32(math.sqrt(2) * NOISE_PX))
    return (disparity > 0) & ~heights.off & (np.abs(mean) < SIGMAS * MEAN_NOISE)


def _mean_of_neighbours(sigmas: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean of what is known around each pixel (R, W), NaN where that is too little. One
    that is far off counts for no more than a few.
    """
    known = np.isfinite(sigmas)
    bounded = np.clip(np.where(known, sigmas, np.float32(0)), -_MOST_SIGMAS, _MOST_SIGMAS)
    mean, share = mean_of_known(bounded, known.astype(np.float32), _NEIGHBOURS_PX)
    return np.where(share > LEAST_KNOWN, mean, np.float32(np.nan))


def _below_contact(frame: FrameEvidence, low: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the pixels between the foot of an upright surface and where it meets the floor.

    They are lower than a step but belong to the same surface: its disparity and its height say at
    which row the floor is, farther from a camera that looks down than what is above it.
    """
    view, heights = frame.view, frame.heights
    rows, columns = pixels_where(low)
    height_m, px = heights.height[low], frame.disparity_px[low]
    down = height_m * px / np.float32(view.line.metres_per_row)
    tilt = -view.mount.up_in_camera[2] / view.camera.disparity_times_depth
    beyond = view.derolled[low] - np.float32(view.line.horizon)
    foot = rows + (beyond + down) / (1 + np.float32(tilt) * height_m * px) - beyond
    end = np.clip(foot.astype(np.int32), rows, len(low) - 1) + 1
    covered = np.zeros((len(low) + 1, low.shape[1]), np.int16)
    covered[:-1] = low
    covered -= histogram(end, columns, covered.shape).astype(np.int16)
    return np.cumsum(covered, axis=0, dtype=np.int16)[:-1] >= 2


def compare(
    view: FloorView,
    profile: FloorProfile,
    pair: Pair,
    disparity: NDArray[np.float32],
    heights: Heights,
) -> Comparison:
    """Compare the view's rows of a rectified pair under floor and under the disparities (R, W); of
    a depth camera, which has no right image, the disparities with the floor's.

    Disparities may be those of a floor, though not of the profile: it bends only along the way.
    Where the right image does not reach, nothing speaks against the floor nor for it.
    """
    on_floor = lies_on_floor(view, disparity, heights)
    floor_px = profile.at_pixels(view.derolled[view.half])
    if pair.measured is not None:
        off_px = np.abs(disparity - profile.at_pixels(view.derolled))
        against = (disparity > 0) & (off_px > np.float32(SAME_PX)) & ~on_floor
        return Comparison(floor_px, against, against, np.zeros_like(against), ~against)
    left, right, noise_grey = pair.left_rows, pair.right[pair.part[0]], pair.noise_grey
    sampled = left[::STEP_PX, ::STEP_PX]
    rows, columns = STEP_PX * np.indices(sampled.shape, np.float32)
    matched_px = disparity[view.half]
    reached = columns >= floor_px + _MARGIN_PX
    lying = on_floor[view.half] & (matched_px > 0)
    as_floor, as_matched = (
        cv2.remap(right, columns - px, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for px in (np.where(lying, matched_px, floor_px), matched_px)
    )
    matched = _local_difference(sampled, as_matched)
    floor = _local_difference(sampled, as_floor)
    lying &= reached & (np.abs(matched_px - floor_px) < np.float32(SAME_PX))
    against = (matched_px > 0) & (floor > 1.3 * matched + (_AGAINST_GREY + 0.5 * noise_grey))
    unlike = floor > _LIKENESS_GREY + _noise(_NOISE_SHARE * noise_grey, matched, lying)
    denied = cv2.blur(floor, _WIDE) > _WIDE_RATIO * cv2.blur(matched, _WIDE) + _WIDE_MARGIN_GREY
    worse = floor > 1.1 * matched
    denied &= (matched_px > 0) & worse
    denied &= cv2.blur(worse.astype(np.float32), _WIDE) > _WIDE_SHARE
    contrary = against | denied | _foreign(sampled, as_floor, lying, noise_grey)
    contrary |= floor > 2 * _LIKENESS_GREY + _NOISE_SHARE * noise_grey
    against, denied, unlike, contrary = (
        enlarged(mask & reached, disparity) for mask in (against, denied, unlike, contrary)
    )
    return Comparison(floor_px, against, denied, unlike, ~contrary)


def _foreign(
    left: NDArray[np.uint8], right: NDArray[np.uint8], lying: NDArray[np.bool_], noise_grey: float
) -> NDArray[np.bool_]:
    """Return where the left image (R, W) has texture that the right one, drawn as if all were
    floor, has not: what stands so near, or so askew, that it is not matched at all.

    lying: where what is matched lies on the floor.
    """
    a, b = left.astype(np.float32), right.astype(np.float32)
    mean_a, mean_b = cv2.blur(a, _WIDE), cv2.blur(b, _WIDE)
    variance = np.maximum(cv2.blur(a * a, _WIDE) - mean_a**2, np.float32(1e-3))
    other = np.maximum(cv2.blur(b * b, _WIDE) - mean_b**2, np.float32(1e-3))
    shared = cv2.blur(a * b, _WIDE) - mean_a * mean_b
    noise = _noise(noise_grey**2, (variance + other) / 2 - shared, lying)
    expected = 1 - np.float32(noise) / variance
    texture, least = _FOREIGN
    differs: NDArray[np.bool_] = shared < least * expected * np.sqrt(variance * other)
    return differs & (expected > texture)


def _noise(least: float, differs: NDArray[np.float32], lying: NDArray[np.bool_]) -> float:
    """Return what images differ by where what is matched lies on the floor (R, W), in the median:
    noise, blur and rows that are not quite the same; at least what is known without.
    """
    is_enough = np.count_nonzero(lying) > _WIDE[0] * _WIDE[1]
    return max(least, float(np.median(differs[lying]))) if is_enough else least


def _local_difference(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the local mean absolute difference, free of differences in brightness."""
    difference = cv2.subtract(left, right, dtype=cv2.CV_32F)
    difference -= cv2.blur(difference, (BLOCK_PX, BLOCK_PX))
    return cv2.blur(np.abs(difference), (BLOCK_PX, BLOCK_PX))
