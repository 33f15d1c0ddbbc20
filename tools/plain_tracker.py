"""The plain method that SLAM is held against: ORB from frame to frame, then PnP in RANSAC.

Nothing is kept but the frame before: no map, no motion model, no keyframes. What it places, a
tracker should place, too.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.geometry import Array, make_transform

FEATURES, FAST_THRESHOLD = 2000, 7
REACH_PX, TRIALS, CONFIDENCE = 3.0, 5000, 0.999
MINIMAL = 4
"""Matches of a minimal set: three that give up to four poses, and one that chooses."""

FALSE_ALARMS = 1e-3
"""Expected number of poses that chance matches of one step support as well as the one found."""

SGBM_BLOCK_PX = 5


@dataclasses.dataclass(frozen=True)
class PlainSteps:
    """What the plain method makes of N frames. T_now_before: (N, 4, 4), the motion of the camera
    from the frame before, NaN for none. matches, inliers: (N,), those with depth and those within
    3 px of the pose, distinct ones. needed: (N,) inliers for a step to be placed, see
    `needed_inliers`. The first frame has no step.
    """

    T_now_before: Array
    matches: NDArray[np.int64]
    inliers: NDArray[np.int64]
    needed: NDArray[np.int64]

    @property
    def placed(self) -> NDArray[np.bool_]:
        """Which frames (N,) have a step with more inliers than chance gives."""
        found = (self.inliers >= self.needed) & np.isfinite(self.T_now_before[:, 0, 0])
        return np.asarray(found & (np.arange(len(found)) > 0))

    def save(self, path: Path) -> None:
        """Write them to a file (.npz)."""
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **{f.name: getattr(self, f.name) for f in dataclasses.fields(self)})

    @classmethod
    def read(cls, path: Path) -> PlainSteps:
        """Return those of a file."""
        with np.load(path) as arrays:
            return cls(**{f.name: arrays[f.name] for f in dataclasses.fields(cls)})


def plain_steps(
    views: Iterable[tuple[NDArray[np.uint8], NDArray[np.float32]]], camera: StereoCamera
) -> PlainSteps:
    """Place each frame against the one before. views: left images (H, W) with disparities (H, W),
    px, NaN where there is none.
    """
    orb = cv2.ORB_create(FEATURES, fastThreshold=FAST_THRESHOLD)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    rows: list[tuple[Array, int, int, int]] = []
    before: tuple[Array, NDArray[np.uint8]] | None = None
    for image, disparity in views:
        keypoints, descriptors = orb.detectAndCompute(image, None)
        uv = np.array([keypoint.pt for keypoint in keypoints], np.float64).reshape(-1, 2)
        points: Array = np.zeros((0, 3))
        pixels: Array = np.zeros((0, 2))
        if before is not None and len(before[0]) and len(uv):
            pairs = matcher.match(before[1], descriptors)
            points = before[0][[pair.queryIdx for pair in pairs]]
            pixels = uv[[pair.trainIdx for pair in pairs]]
            known = np.isfinite(points[:, 0])
            points, pixels = points[known], pixels[known]
        rows.append(place(points, pixels, camera))
        before = (_points(uv, disparity, camera), descriptors)
    transforms, *counts = zip(*rows, strict=True)
    return PlainSteps(np.array(transforms), *(np.array(count, np.int64) for count in counts))


def needed_inliers(matches: int, chance: float) -> int:
    """Return how many of N matches must agree with a pose for it not to be chance.

    The expected number of poses that k of N wrong matches support (number of false alarms, Moisan
    and Stival, IJCV 2004; Moulon et al., ACCV 2012) is at most

        NFA(k) = 4 (N - 3) C(N, k) C(k, 3) p^(k - 3),

    with the four poses that three matches give, and the chance p that one match lies within 3 px
    of where a pose has it. The fourth match of a minimal set only chooses among the four. The least
    k > 4 from which on NFA <= 0.001 is enough; N + 1 where no k is.
    """
    if matches <= MINIMAL:
        return matches + 1
    solved = MINIMAL - 1
    k = np.arange(MINIMAL + 1, matches + 1)
    log_nfa = (
        math.log(4 * (matches - solved))
        + (gammaln(matches + 1) - gammaln(k + 1) - gammaln(matches - k + 1))
        + (gammaln(k + 1) - gammaln(solved + 1) - gammaln(k - solved + 1))
        + (k - solved) * math.log(chance)
    )
    too_few = k[log_nfa > math.log(FALSE_ALARMS)]
    return int(too_few.max()) + 1 if len(too_few) else MINIMAL + 1


def chance_of_match(pixels: Array, camera: StereoCamera) -> float:
    """Return the chance that a wrong match lies within 3 px of a pixel: the share of the image that
    3 px around it cover, or of the features (N, 2), which crowd, where that is larger.
    """
    area = math.pi * REACH_PX**2 / (camera.width * camera.height)
    if len(pixels) < 2:
        return area
    apart = ((pixels[:, None] - pixels[None]) ** 2).sum(axis=2)
    near = float((apart <= REACH_PX**2).sum() - len(pixels))
    return max(area, near / (len(pixels) * (len(pixels) - 1)))


def distinct(pixels: Array) -> NDArray[np.int64]:
    """Return one row (M,) of pixels (N, 2) for each cell of 6 px: a corner that is found in several
    octaves counts once.
    """
    cells = np.floor(pixels / (2 * REACH_PX)).astype(np.int64)
    return np.asarray(np.unique(cells, axis=0, return_index=True)[1], np.int64)


def sgbm_disparity(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the disparity (H, W) of a rectified pair by semi-global matching, NaN for none."""
    most = 16 * math.ceil(min(left.shape[1] / 5, 128) / 16)
    squared = SGBM_BLOCK_PX**2
    matcher = cv2.StereoSGBM_create(
        0, most, SGBM_BLOCK_PX, 8 * squared, 32 * squared, disp12MaxDiff=1, uniquenessRatio=10,
        speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    disparity = matcher.compute(left, right).astype(np.float32) / 16
    return np.where(disparity > 0, disparity, np.float32(np.nan))


def _points(uv: Array, disparity: NDArray[np.float32], camera: StereoCamera) -> Array:
    """Return the points (N, 3) at pixels (N, 2), NaN where there is no disparity."""
    columns, rows = np.rint(uv).astype(int).T
    d = disparity[rows, columns].astype(np.float64)
    d[~(d > 0)] = np.nan
    return camera.back_project(uv, camera.disparity_times_depth / d)


def place(points: Array, pixels: Array, camera: StereoCamera) -> tuple[Array, int, int, int]:
    """Return T_now_before (4, 4), the matches, the inliers and how many there must be."""
    lone = distinct(pixels)
    needed = needed_inliers(len(lone), chance_of_match(pixels[lone], camera))
    nothing = np.full((4, 4), np.nan)
    if len(points) <= MINIMAL:
        return nothing, len(lone), 0, needed
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points, pixels, camera.K, None, iterationsCount=TRIALS, reprojectionError=REACH_PX,
        confidence=CONFIDENCE, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    if not found or inliers is None or len(inliers) <= MINIMAL:
        return nothing, len(lone), 0, needed
    rows = inliers[:, 0]
    turn, shift = cv2.solvePnPRefineLM(points[rows], pixels[rows], camera.K, None, turn, shift)
    T_now_before = make_transform(cv2.Rodrigues(turn)[0], shift[:, 0])
    return T_now_before, len(lone), len(distinct(pixels[rows])), needed
