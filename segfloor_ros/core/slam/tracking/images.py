"""A stereo pair in the forms that tracking works on.

Where pixels of the last image are in this one: Lucas-Kanade on a pyramid (Bouguet, Pyramidal
Implementation of the Lucas Kanade Feature Tracker, 2000, as in OpenCV).

Parts of an image that do not count, because they move or lie on the border of rectification.

Two sources say so: a segmentation network (`StereoFrame.excluded`) and `moving_regions`.

ORB features spread over the image.

Rublee et al., ORB: an efficient alternative to SIFT or SURF (ICCV 2011). The strongest corners
alone would all lie on posters and shelves; the budget is dealt out over image cells instead, so
that the floor gets its share.

Matching of binary descriptors: guided by a predicted pixel, or without guidance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from segfloor_ros.core.camera.model import StereoCamera, is_disparity
from segfloor_ros.core.camera.pixels import Region, noise_grey, union
from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.slam.rig import Observations
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.timing import timed

SIDE_PX = 11
"""Of the patch around a pixel: small enough to be flat, large enough to be distinct."""

BLUR_PX = 0.7
"""Scale of the slopes that patches are aligned by: of those of noise a third is left, and most of
what a lens lets through."""

SMALL_WIDTH_PX = 320
"""Width of a shrunk image: for optical flow; half of it shows what moves, a quarter turns."""
STEPS = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.05)

SIGMA_FLOW_PX = 1.0
"""Error of a pixel that is followed."""

OVERSAMPLING = 4
"""Corners detected per feature kept; the surplus is what the cells choose from."""

CELL_SIZE_PX = 16
"""Side of the image cells over which features are spread: about as many cells as features."""

NOISY_GREY, CALM_GREY = 4.0, 1.5
"""Of an image with more noise than the first, corners are looked for in one that is smoothed until
it has the second: else they are those of the noise.
"""

SIGMA_PIXEL = 0.6
"""Standard deviation of a corner's position at the finest pyramid level, px; grows with the
level.
"""

PYRAMID_LEVELS, PYRAMID_SCALE = 8, 1.2
"""The pyramid of ORB as published: sizes up to 3.6 times as large are recognised."""

MAX_HAMMING = 80
"""Largest distance of a match, of 256 bits: descriptors of different corners are about 128 apart,
and one in a billion pairs is as near as this by chance."""

MAX_RATIO = 0.85
"""A match must be so much nearer than the second best (Lowe, Distinctive Image Features, 2004)."""

MASK_DILATION_PX = 5
"""Masks of moving things are widened by this much: networks cut corners."""

NEIGHBOURS = 12
"""Features looked at around a predicted pixel; a radius holds about ten."""

Matches = tuple[NDArray[np.intp], NDArray[np.intp]]


@dataclass(frozen=True)
class Images:
    """left, right: rectified grey images (H, W) float32, smoothed, for patches; of a depth camera
    its disparity for the right one, and depth_scale: disparity times depth, 0 of a stereo pair.
    small: the left one as optical flow takes it. moving: where something moves, in the left image;
    excluded: there, and in the black border that rectification leaves.
    """

    left: NDArray[np.float32]
    right: NDArray[np.float32]
    small: NDArray[np.uint8]
    excluded: Region | None = None
    depth_scale: float = 0.0
    moving: Region | None = None

    @staticmethod
    def of(frame: StereoFrame, camera: StereoCamera, border: Region | None = None) -> Images:
        """Prepare the images of a frame. border: that rectification leaves in the left one."""
        depth_scale = camera.disparity_times_depth if is_disparity(frame.right) else 0.0
        left, right = smooth(frame.left), frame.right if depth_scale else smooth(frame.right)
        moving = None if frame.excluded is None else dilate(frame.excluded)
        return Images(left, right, shrink(frame.left), union(border, moving), depth_scale, moving)


def smooth(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the image (H, W) in which patches are compared: slopes of noise say that a patch lies
    where its search starts, so there are none.
    """
    return cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR_PX)


def shrink(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the image (H, W) at half its size where it is large: a start for patch alignment
    need not be better than a pixel.
    """
    if image.shape[1] < 2 * SMALL_WIDTH_PX:
        return image
    half = (image.shape[1] // 2, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), np.uint8)


def follow_pixels(
    last: NDArray[np.uint8],
    now: NDArray[np.uint8],
    width_px: int,
    uv_last_px: Array,
    uv_guess_px: Array,
    window_px: int = SIDE_PX,
    steps: tuple[int, int, float] = STEPS,
) -> tuple[Array, NDArray[np.bool_]]:
    """Find pixels (N, 2) of one image in the next one, starting from a guess (N, 2).

    last, now: shrunk images; width_px: of the full ones, in whose pixels all positions are. steps:
    when the search ends, as OpenCV takes it.
    Returns positions (N, 2) and whether each was found (N,).
    """
    scale = last.shape[1] / width_px
    start, guess = (
        ((uv + 0.5) * scale - 0.5).astype(np.float32).reshape(-1, 1, 2)
        for uv in (uv_last_px, uv_guess_px)
    )
    found_uv, status, _ = cv2.calcOpticalFlowPyrLK(
        last,
        now,
        start,
        guess,
        winSize=(window_px, window_px),
        criteria=steps,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    uv = (np.asarray(found_uv, np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
    return uv, np.asarray(status).ravel() > 0


def dilate(region: Region, radius_px: int = MASK_DILATION_PX) -> Region:
    """Return the region and everything within a radius of it."""
    size = 2 * radius_px + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.dilate(region, disc), np.uint8)


def is_inside(region: Region | None, uv_px: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which pixels (N, 2) lie in a region; none of them where there is no region."""
    if region is None:
        return np.zeros(len(uv_px), bool)
    height, width = region.shape
    u = np.clip(np.rint(uv_px[:, 0]), 0, width - 1).astype(np.intp)
    v = np.clip(np.rint(uv_px[:, 1]), 0, height - 1).astype(np.intp)
    return region[v, u] > 0


@dataclass(frozen=True)
class Features:
    """The features of one image: uv_px (N, 2) float32 at full resolution, octave (N,) uint8,
    descriptor (N, 32) uint8.
    """

    uv_px: NDArray[np.float32]
    octave: NDArray[np.uint8]
    descriptor: NDArray[np.uint8]

    @staticmethod
    def of(corners: Sequence[cv2.KeyPoint], descriptor: Any) -> Features:
        """Return corners and their descriptors as OpenCV has them, None for those of no corners."""
        if not corners:
            none = np.zeros((0, 2), np.float32), np.zeros(0, np.uint8)
            return Features(*none, np.zeros((0, 32), np.uint8))
        uv_px = np.asarray(cv2.KeyPoint_convert(corners), np.float32).reshape(-1, 2)
        octave = np.array([corner.octave & 0xFF for corner in corners], np.uint8)
        return Features(uv_px, octave, np.asarray(descriptor, np.uint8))

    def __len__(self) -> int:
        return len(self.uv_px)

    @cached_property
    def tree(self) -> cKDTree:
        """Finds what lies near a pixel."""
        return cKDTree(self.uv_px)

    @property
    def observations(self) -> Observations:
        """What they measure before any disparity is known."""
        scale = PYRAMID_SCALE ** self.octave.astype(np.float64)
        return Observations.of_pixels(self.uv_px, SIGMA_PIXEL * scale[:, None])

    def take(self, rows: NDArray[np.intp]) -> Features:
        """Return the chosen rows."""
        return Features(self.uv_px[rows], self.octave[rows], self.descriptor[rows])


class FeatureExtractor:
    """Detects oriented FAST corners on a pyramid and describes a spread selection of them."""

    def __init__(self, settings: StereoSlamSettings) -> None:
        self._budget = settings.num_features
        self._orb = cv2.ORB_create(
            nfeatures=OVERSAMPLING * settings.num_features,
            scaleFactor=PYRAMID_SCALE,
            nlevels=PYRAMID_LEVELS,
            edgeThreshold=19,
            fastThreshold=settings.fast_threshold,
        )

    @timed
    def extract(self, image: NDArray[np.uint8], excluded: Region | None = None) -> Features:
        """Return the features of a grey image (H, W) outside of what is excluded."""
        image = calmed(image)
        corners = self._orb.detect(image, None)
        if excluded is not None and corners:
            inside = is_inside(excluded, cv2.KeyPoint_convert(corners))
            corners = [corner for corner, out in zip(corners, ~inside, strict=True) if out]
        if not corners:
            return Features.of((), None)
        uv = cv2.KeyPoint_convert(corners)
        response = np.array([corner.response for corner in corners], np.float32)
        chosen = spread(uv, response, CELL_SIZE_PX, self._budget)
        found = Features.of(*self._orb.compute(image, [corners[i] for i in chosen]))
        return replace(found, uv_px=self._at_full_resolution(found.uv_px, found.octave, image))

    def _at_full_resolution(
        self, uv: NDArray[np.float32], octave: NDArray[np.uint8], image: NDArray[np.uint8]
    ) -> NDArray[np.float32]:
        """Return exact positions (N, 2). OpenCV multiplies a corner's place in its pyramid
        level by the nominal scale; but levels have whole sizes, and what scales is the
        distance from the image's outer edge, half a pixel before the first pixel's centre.
        """
        nominal = PYRAMID_SCALE ** octave.astype(np.float64)[:, None]
        size = np.array(image.shape[::-1], np.float64)
        level_size = np.rint(size / nominal)
        return (((uv / nominal) + 0.5) * (size / level_size) - 0.5).astype(np.float32)


def calmed(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image (H, W) without most of its noise, where that is strong: smoothed by s pixels
    white noise is 2 * sqrt(pi) * s times weaker.
    """
    noise = noise_grey(image)
    if noise < NOISY_GREY:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), noise / (2 * math.sqrt(math.pi) * CALM_GREY)))


def spread(
    uv_px: NDArray[np.float32], response: NDArray[np.float32], cell_px: int, budget: int
) -> NDArray[np.intp]:
    """Choose up to `budget` corners: first the best of every cell, then every cell's second,
    and so on.

    uv_px: (N, 2). response: (N,), larger is better. Returns ascending indices.
    """
    column, row = (uv_px // cell_px).astype(np.int64).T
    cell = row * (int(column.max()) + 1) + column
    strength = response.astype(np.float64)
    span = float(np.ptp(strength)) + 1.0  # one sort by two keys: much faster than lexsort
    order = np.argsort(cell * span - strength, kind='stable')
    sorted_cell = cell[order]
    first_of_cell = np.r_[0, np.flatnonzero(np.diff(sorted_cell)) + 1]
    run_start = np.zeros(len(order), np.int64)
    run_start[first_of_cell] = first_of_cell
    rank_in_cell = np.arange(len(order)) - np.maximum.accumulate(run_start)
    by_rank = np.argsort(rank_in_cell * span - strength[order], kind='stable')
    return np.sort(order[by_rank[:budget]])


def hamming(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Return the Hamming distances (...,) of descriptors (..., 32), broadcast against each
    other.
    """
    if hasattr(np, 'bitwise_count'):  # NumPy 2
        difference = np.bitwise_xor(a.view(np.uint64), b.view(np.uint64))
        bits = np.bitwise_count(difference)
        # A sum over so short an axis takes longer than its terms.
        return np.asarray(sum((bits[..., k] for k in range(1, 4)), bits[..., 0].astype(np.int32)))
    pairs = np.bitwise_xor(a.view(np.uint16), b.view(np.uint16))
    return np.asarray(_bits()[pairs].sum(axis=-1, dtype=np.int32))


@cache
def _bits() -> NDArray[np.uint8]:
    """Return how many bits of each number (65536,) of 16 are set."""
    halves = np.arange(1 << 16, dtype=np.uint16).view(np.uint8).reshape(-1, 2)
    return np.unpackbits(halves, axis=1).sum(axis=1, dtype=np.uint8)


def match_predicted(
    features: Features,
    predicted_uv_px: NDArray[np.floating],
    predicted_octave: NDArray[np.floating],
    descriptor: NDArray[np.uint8],
    radius_px: NDArray[np.floating],
) -> Matches:
    """Match map points to the features around their predicted pixels.

    predicted_uv_px: (M, 2), predicted_octave: (M,), descriptor: (M, 32), radius_px: (M,). A match
    must lie within one octave of the prediction and be clearly better than the second best of the
    same octave. Returns (point rows, feature rows), one to one.
    """
    if len(predicted_uv_px) == 0 or len(features) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    # A list of ranks, as a single one alone would lose its axis.
    ranks = list(range(1, min(NEIGHBOURS, len(features)) + 1))
    found = features.tree.query(predicted_uv_px, k=ranks, distance_upper_bound=radius_px.max())
    reach, near = (np.asarray(part) for part in found)
    octave = np.append(features.octave.astype(np.float64), -100.0)[near]
    valid = (reach <= radius_px[:, None]) & (np.abs(octave - predicted_octave[:, None]) <= 1.5)
    rows, columns = np.nonzero(valid)
    distance = np.full(near.shape, 512, np.int32)
    distance[rows, columns] = hamming(descriptor[rows], features.descriptor[near[rows, columns]])
    best = distance.argmin(axis=1)
    index = np.arange(len(near))
    best_distance = distance[index, best]
    rival = (distance < 512) & (np.abs(octave - octave[index, best][:, None]) < 0.5)
    rival[index, best] = False
    second = np.where(rival, distance, 512).min(axis=1)
    accepted = (best_distance <= MAX_HAMMING) & (best_distance <= MAX_RATIO * second)
    points = np.flatnonzero(accepted)
    return one_to_one(points, near[points, best[points]], best_distance[points])


def match_unguided(
    query: NDArray[np.uint8], train: NDArray[np.uint8], max_hamming: int = MAX_HAMMING
) -> Matches:
    """Match descriptors (N, 32) and (M, 32) by mutual nearest neighbours; returns (query rows,
    train rows).
    """
    if len(query) == 0 or len(train) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    found = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(query, train)
    pairs = np.array(
        [(m.queryIdx, m.trainIdx) for m in found if m.distance <= max_hamming], np.intp
    ).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def one_to_one(a: NDArray[np.intp], b: NDArray[np.intp], distance: NDArray[np.int32]) -> Matches:
    """Keep the pairs (a[i], b[i]) that are the nearest of both their ends; ties go to the
    lower index.
    """
    order = np.lexsort((b, a, distance))
    a, b = a[order], b[order]
    best_of_a = np.zeros(len(a), bool)
    best_of_a[np.unique(a, return_index=True)[1]] = True
    best_of_b = np.zeros(len(b), bool)
    best_of_b[np.unique(b, return_index=True)[1]] = True
    keep = best_of_a & best_of_b
    a, b = a[keep], b[keep]
    by_a = np.argsort(a, kind='stable')
    return a[by_a], b[by_a]
