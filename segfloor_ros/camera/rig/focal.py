"""Whether the focal length of the calibration is that of the images, by how a turn looks.

Depth is the focal length times the baseline by the disparity, the place across it is not: with a
wrong focal length the world is stretched along the axis of the camera. A camera that moves straight
ahead sees no more of it; one that turns sees a stretched world bend. Two looks of a turn are fitted
by a motion and the factor of the focal length (self-calibration by rotation: Hartley, 1994; here
with both eyes).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array, se3_exp, skew, transform_points

WINDOW_PX = 15
"""What is around a point: of optical flow, of an edge, of brightness."""

RETURN_PX = 0.5
"""A point that is followed to another image and back comes back as near as this; where points fit
no motion better, the scene is not a rigid one."""

MAX_HAMMING = 64

ROWS_PX = 1.5
"""Matching along rows bears no more; nor are disparities wrong by more because they are noisy."""

LEAST_NOISE_PX = 0.1
"""Positions of points are not known better."""

MIN_MATCHES = 40
MIN_TURN_RAD = 0.03
"""A smaller turn does not show the focal length, but whatever else moves in the scene."""

SURE = 4.0
"""So many standard deviations are no accident."""

PAIR_SIGMA = 0.02
"""What is wrong in all points of a pair is in no covariance: by so much, as a share, pairs of good
recordings differ."""

FOCAL_SHARE = 0.03
"""Depths that are wrong by less do not matter to a map; real calibrations are not better known."""

MOTION_STEPS, STEPS = 5, 15
"""Of the fit: the first ones find the motion alone."""

PRIOR_SIGMA = 0.5
"""Of the logarithm of the factor: images may be half or twice as large as those calibrated."""


class Matches(NamedTuple):
    """Points (N, 2) of the left image and where the right one has them, with their descriptors."""

    left_px: NDArray[np.float32]
    right_px: NDArray[np.float32]
    words: NDArray[np.uint8]

    def those(self, chosen: NDArray[Any]) -> Matches:
        """Return some of them: a mask or indices."""
        return Matches(*(values[chosen] for values in self))


class FocalCheck:
    """Collects what turns say of the focal length."""

    def __init__(self, camera: StereoCamera) -> None:
        self._camera = camera
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        self._before: tuple[NDArray[np.uint8], Matches] | None = None
        self._logs: list[tuple[float, float]] = []

    @property
    def is_done(self) -> bool:
        """Whether no more turns are needed: the focal length is known."""
        return SURE * self._estimate()[1] < FOCAL_SHARE

    def reset_view(self) -> None:
        """The next look is not at what the last one showed."""
        self._before = None

    def look(self, left: NDArray[np.uint8], matches: Matches) -> None:
        """Take in a left image (H, W) and its points, some frames after the last look."""
        if self.is_done:
            return
        apart = matches.left_px - matches.right_px
        rows = np.abs(apart[:, 1] - np.median(apart[:, 1])) if len(apart) else apart[:, 1]
        matches = matches.those((apart[:, 0] > ROWS_PX) & (rows < ROWS_PX))
        before, self._before = self._before, (left, matches)
        if before is None or min(len(before[1].words), len(matches.words)) < MIN_MATCHES:
            return
        found = self._matcher.match(before[1].words, matches.words)
        found = [match for match in found if match.distance <= MAX_HAMMING]
        then = before[1].those(np.array([match.queryIdx for match in found], np.intp))
        now = matches.those(np.array([match.trainIdx for match in found], np.intp))
        if len(found) < MIN_MATCHES:
            return
        now_px, is_found = follow(before[0], left, then.left_px, now.left_px, levels=0)
        uvd_then = np.column_stack([then.left_px, (then.left_px - then.right_px)[:, 0]])
        uvd_now = np.column_stack([now_px, (now.left_px - now.right_px)[:, 0]])
        if np.count_nonzero(is_found) >= MIN_MATCHES:
            log = _log_factor(self._camera, uvd_then[is_found], uvd_now[is_found])
            self._logs.extend([log] if log is not None else [])

    def factor(self) -> float | None:
        """Return the focal length that turns show, as a share of that of the calibration, where it
        is sure that it is another one.
        """
        log, sigma = self._estimate()
        return float(np.exp(log)) if abs(log) - SURE * sigma > FOCAL_SHARE else None

    def _estimate(self) -> tuple[float, float]:
        """Return the logarithm of the factor, and its standard deviation."""
        if not self._logs:
            return 0.0, np.inf
        logs, information = np.array(self._logs).T
        weight = 1 / (1 / information + PAIR_SIGMA**2)
        log = float(logs @ weight / weight.sum())
        spread = float(np.sqrt(np.square(weight * (logs - log)).sum())) / weight.sum()
        return log, max(spread, float(weight.sum() ** -0.5))


def _log_factor(camera: StereoCamera, then: Array, now: Array) -> tuple[float, float] | None:
    """Return the logarithm of the factor of the focal length, and its information, that fits points
    (N, 3) = (u, v, disparity) before and after a motion; None where that was no turn of a rigid
    scene.
    """
    then, now = then.astype(np.float64), now.astype(np.float64)
    x, T = 0.0, np.eye(4)
    information = 0.0
    for step in range(STEPS):
        if step == MOTION_STEPS and _turn_rad(T) < MIN_TURN_RAD:
            return None
        error, J = _residuals(camera, then, now, x, T)
        noise_px = max(1.4826 * float(np.median(np.abs(error))), LEAST_NOISE_PX)
        weight = (1.0 + np.square(error).sum(axis=1) / (2 * noise_px) ** 2) ** -2 / noise_px**2
        H = np.einsum('nij,nik,n->jk', J, J, weight)
        g = np.einsum('nij,ni,n->j', J, error, weight)
        H[6, 6] += PRIOR_SIGMA**-2
        g[6] -= x * PRIOR_SIGMA**-2
        size = 6 if step < MOTION_STEPS else 7
        change = np.zeros(7)
        change[:size] = np.linalg.lstsq(H[:size, :size], g[:size], rcond=None)[0]
        T, x = se3_exp(change[:6]) @ T, x + float(np.clip(change[6], -PRIOR_SIGMA, PRIOR_SIGMA))
        information = float(H[6, 6] - H[6, :6] @ np.linalg.pinv(H[:6, :6]) @ H[:6, 6])
    is_known = noise_px < RETURN_PX and _turn_rad(T) > MIN_TURN_RAD
    return (x, information) if is_known else None


def _turn_rad(T_now_then: Array) -> float:
    return float(np.arccos(np.clip((np.trace(T_now_then[:3, :3]) - 1) / 2, -1, 1)))


def _residuals(
    camera: StereoCamera, then: Array, now: Array, log_factor: float, T_now_then: Array
) -> tuple[Array, Array]:
    """Return where points (N, 3) are now against where they should be, (N, 3), and the derivatives
    (N, 3, 7) of the latter by a motion and by the logarithm of the factor.
    """
    f = np.array([camera.fx, camera.fy]) * np.exp(log_factor)
    across = camera.baseline_m * camera.fx / then[:, 2]
    rays = (then[:, :2] - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    depth = across * np.exp(log_factor)
    points = transform_points(T_now_then, np.column_stack([rays * across[:, None], depth]))
    x, y, z = points.T
    z = np.maximum(z, 1e-3)
    seen = np.column_stack([f[0] * x / z, f[1] * y / z, f[0] * camera.baseline_m / z])
    J_point = np.zeros((len(then), 3, 3))
    J_point[:, 0, 0], J_point[:, 1, 1] = f[0] / z, f[1] / z
    J_point[:, :, 2] = -seen / z[:, None]
    J = np.empty((len(then), 3, 7))
    J[:, :, :3], J[:, :, 3:6] = J_point, -J_point @ skew(points)
    J[:, :, 6] = seen + J_point @ T_now_then[:3, 2] * depth[:, None]
    return now - (camera.cx, camera.cy, 0.0) - seen, J


def follow(
    image: NDArray[np.uint8], other: NDArray[np.uint8], uv_px: Array, guess_px: Array, levels: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Return where pixels (N, 2) of an image (H, W) are in another one, near a guess (N, 2), and
    which of them were found, there and back.
    """
    how: dict[str, Any] = {
        'winSize': (WINDOW_PX, WINDOW_PX),
        'maxLevel': levels,
        'flags': cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    there, found = cv2.calcOpticalFlowPyrLK(image, other, uv_px, guess_px.copy(), **how)[:2]
    back, returned = cv2.calcOpticalFlowPyrLK(other, image, there, uv_px.copy(), **how)[:2]
    is_same = np.linalg.norm(back - uv_px, axis=1) < RETURN_PX
    return there, (np.asarray(found).ravel() > 0) & (np.asarray(returned).ravel() > 0) & is_same
