"""What images say of two calibrations: that of a depth camera, and that of two eyes.

Whether measured depth belongs to its image, by edges: things end in the depth where they end in
the image. The edges of the depth are laid over those of the image, shifted, larger or smaller, and
moved as the image moved within a lag: where they fit best is how depth and image lie to each other,
in space and in time.

Whether focal length and principal points of the calibration are those of the images, by how motion
looks. Depth is the focal length times the baseline by the disparity, the place across it is not:
with a wrong focal length the world is stretched along the axis of the camera. A camera that moves
straight ahead sees no more of it; one that turns sees a stretched world bend. Where the principal
points of the eyes are not as far apart as calibrated, all disparities are off by as much, and near
things seem to move by more, or less, than far ones in any motion. Two looks are fitted by a motion,
the factor of the focal length and that offset (self-calibration: Hartley, 1994; here with both
eyes). Wrong in both eyes alike a principal point looks like a camera that is mounted askew.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import MAX_OFFSET_PX, StereoCamera
from segfloor_ros.core.gauss_newton import gauss_newton
from segfloor_ros.core.geometry import Array, transform_points
from segfloor_ros.core.twists import se3_exp, skew

WIDTH_PX = 320
"""Images are shrunk to about this width."""

REACH_PX, LAGS = 16, (-2.0, -1.0, 0.0, 1.0, 2.0)
SCALES = tuple(1.04**step for step in range(-4, 15))
"""What is tried: shifts of shrunk pixels, lags in frames, and sizes: the depth of a Kinect is 0.9
times as large as its image, that of a RealSense D435 1.6 times, before they are registered."""

BESIDE_PX = 2
"""Edges of depth are off by so much in a camera that is aligned: holes lie beside them."""

STEP_RATIO = 1.15
"""Two disparities of one surface differ by less from pixel to pixel."""

NOWHERE_PX = 1e6
"""Disparity that nothing has."""

MIN_EDGE_PX = 200
MIN_LOOKS, MAX_LOOKS = 4, 15

SURE_MISFIT, BETTER = 3.0, 1.15
"""Something else than "aligned" must fit better by this factor, and by so many standard
deviations of what the looks differ by."""

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

MOTION_SIGMA = 100.0
"""Of a step of the motion, in metres and radians: where points determine it, this changes nothing.
"""

PRIOR_SIGMA = 0.5
"""Of the logarithm of the factor: images may be half or twice as large as those calibrated."""


@dataclass(frozen=True)
class DepthFit:
    """How depth lies to its image: lag in frames, positive where the depth is late; shift_px from
    its edges to those of the image, and how much larger (1: not at all) it must be to fit.
    """

    lag: float
    shift_px: float
    scale: float


class DepthCheck:
    """Collects how image and depth fit, one look after the other."""

    def __init__(self) -> None:
        self._looks: deque[tuple[Array, Array]] = deque(maxlen=MAX_LOOKS)
        self._factor = 1

    @property
    def is_done(self) -> bool:
        """Whether as many looks as are kept were taken."""
        return len(self._looks) == MAX_LOOKS

    def look(
        self, image: NDArray[np.uint8], before: NDArray[np.uint8], disparity: NDArray[np.float32]
    ) -> None:
        """Take in a grey image (H, W), the one a frame before, and the disparity (H, W) that is
        measured with it, 0 where there is none.
        """
        self._factor = factor = max(1, round(image.shape[1] / WIDTH_PX))
        size = image.shape[1] // factor, image.shape[0] // factor
        small, earlier = (
            cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in (image, before)
        )
        edges = cv2.resize(_steps(disparity), size, interpolation=cv2.INTER_AREA)
        corners = cv2.goodFeaturesToTrack(small, 200, 0.01, 5)
        if edges.sum() < MIN_EDGE_PX / factor or corners is None:
            return
        then, found, _ = cv2.calcOpticalFlowPyrLK(small, earlier, corners, np.empty(0))
        moved = (corners - then)[np.asarray(found).ravel() > 0, 0]
        if len(moved):
            contours = _contours(small)
            fits = np.stack([_fit(contours, _zoomed(edges, scale)) for scale in SCALES])
            self._looks.append((np.median(moved, axis=0), fits))

    def misfit(self) -> DepthFit | None:
        """Return how depth lies to its image, where it is sure that it does not belong there."""
        if len(self._looks) < MIN_LOOKS:
            return None
        near = np.s_[REACH_PX - BESIDE_PX : REACH_PX + BESIDE_PX + 1]
        aligned, _, _ = _best(self._fits(SCALES.index(1.0), 0.0)[:, near, near])
        tried = ((s, lag, *_best(self._fits(s, lag))) for s in range(len(SCALES)) for lag in LAGS)
        s, lag, best, row, column = max(tried, key=lambda one: one[2].mean())
        gain = best - aligned
        sigma = gain.std(ddof=1) / np.sqrt(len(gain))
        if best.mean() < BETTER * aligned.mean() or gain.mean() <= SURE_MISFIT * sigma:
            return None
        shift_px = self._factor * float(np.hypot(row - REACH_PX, column - REACH_PX))
        return DepthFit(lag, shift_px, SCALES[s])

    def _fits(self, scale: int, lag: float) -> Array:
        """Return the fit (L, 2 R + 1, 2 R + 1) of all looks for all shifts of depth that is late by
        `lag` frames.
        """
        return np.stack([_moved(fits[scale], -lag * moved) for moved, fits in self._looks])


def _best(fits: Array) -> tuple[Array, int, int]:
    """Return the fit (L,) of all looks at the shift that is best for all, its row and column."""
    mean = fits.mean(axis=0)
    row, column = np.unravel_index(mean.argmax(), mean.shape)
    return fits[:, row, column], int(row), int(column)


def _steps(disparity: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return where things end in depth, 0 or 1 (H, W)."""
    known = np.isfinite(disparity) & (disparity > 0)
    square = np.ones((3, 3), np.uint8)
    near = cv2.dilate(np.where(known, disparity, 0).astype(np.float32), square)
    far = cv2.erode(np.where(known, disparity, NOWHERE_PX).astype(np.float32), square)
    is_known = (near > 0) & (far < NOWHERE_PX)
    return (is_known & (near > STEP_RATIO * far + 0.5)).astype(np.float32)


def _contours(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return how much of an edge each pixel of an image (H, W) is, against its neighbourhood."""
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32)
    edge = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    edge = np.minimum(edge, np.percentile(edge, 95)).astype(np.float32)
    edge -= cv2.blur(edge, (2 * REACH_PX - 1, 2 * REACH_PX - 1))
    return np.asarray(edge / max(float(edge.std()), 1e-3), np.float32)


def _zoomed(edges: NDArray[np.float32], scale: float) -> NDArray[np.float32]:
    height, width = edges.shape
    zoom = np.array([[scale, 0, (1 - scale) * width / 2], [0, scale, (1 - scale) * height / 2]])
    return np.asarray(cv2.warpAffine(edges, zoom, (width, height), flags=cv2.INTER_NEAREST))


def _fit(contours: NDArray[np.float32], edges: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean contour below edges for all shifts up to `REACH_PX`, (2 R + 1, 2 R + 1)."""
    inner = edges[REACH_PX:-REACH_PX, REACH_PX:-REACH_PX]
    fit = cv2.matchTemplate(contours, inner, cv2.TM_CCORR) / max(float(inner.sum()), 1.0)
    return np.asarray(fit, np.float32)


def _moved(fit: NDArray[np.float32], by_px: Array) -> NDArray[np.float32]:
    shift = np.column_stack([np.eye(2), by_px])
    moved = cv2.warpAffine(fit, shift, fit.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved)


class Matches(NamedTuple):
    """Points (N, 2) of the left image and where the right one has them, with their descriptors."""

    left_px: NDArray[np.float32]
    right_px: NDArray[np.float32]
    words: NDArray[np.uint8]

    def those(self, chosen: NDArray[Any]) -> Matches:
        """Return some of them: a mask or indices."""
        return Matches(*(values[chosen] for values in self))


class CalibrationCheck:
    """Collects what motion says of the focal length and of an offset of all disparities."""

    def __init__(self, camera: StereoCamera) -> None:
        self._camera = camera
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        self._before: tuple[NDArray[np.uint8], Matches] | None = None
        self._logs: list[Measured] = []
        self._offsets: list[Measured] = []

    @property
    def is_done(self) -> bool:
        """Whether no more motion is needed: both are known."""
        log, offset = self._log(), self._offset()
        return SURE * log.sigma < FOCAL_SHARE and SURE * offset.sigma < MAX_OFFSET_PX

    def reset_view(self) -> None:
        """The next look is not at what the last one showed."""
        self._before = None

    def look(self, left: NDArray[np.uint8], matches: Matches) -> None:
        """Take in a left image (H, W) and its points, some frames after the last look."""
        if self.is_done:
            return
        apart = matches.left_px - matches.right_px
        rows = np.abs(apart[:, 1] - np.median(apart[:, 1])) if len(apart) else apart[:, 1]
        matches = matches.those(rows < ROWS_PX)
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
            self._learn(uvd_then[is_found], uvd_now[is_found])

    def _learn(self, then: Array, now: Array) -> None:
        T, x, covariance, noise_px = _fit_motion(self._camera, then, now)
        if np.median(then[:, 2]) < 0:  # an offset, or the eyes are exchanged
            then, now = then * (1, 1, -1), now * (1, 1, -1)
            if _fit_motion(self._camera, then, now)[-1] < noise_px:
                return
        if noise_px < RETURN_PX:
            self._offsets.append(Measured(float(x[1]), float(covariance[1, 1]) ** 0.5))
            if _turn_rad(T) > MIN_TURN_RAD:
                self._logs.append(Measured(float(x[0]), float(covariance[0, 0]) ** 0.5))

    def factor(self) -> float | None:
        """Return the focal length that turns show, as a share of that of the calibration, where it
        is sure that it is another one.
        """
        log = self._log()
        return float(np.exp(log.value)) if log.is_beyond(FOCAL_SHARE) else None

    def offset_px(self) -> float | None:
        """Return by how much all disparities are too large, where it is sure that they are not as
        calibrated.
        """
        offset = self._offset()
        return offset.value if offset.is_beyond(MAX_OFFSET_PX) else None

    def _log(self) -> Measured:
        return Measured.mean(self._logs, PAIR_SIGMA)

    def _offset(self) -> Measured:
        return Measured.mean(self._offsets, LEAST_NOISE_PX)


class Measured(NamedTuple):
    """A value and its standard deviation."""

    value: float
    sigma: float

    @classmethod
    def mean(cls, found: list[Measured], shared_sigma: float) -> Measured:
        """Return the mean of what pairs of looks say. shared_sigma: of what is wrong in all points
        of a pair.
        """
        if not found:
            return cls(0.0, np.inf)
        values, sigmas = np.array(found).T
        weight = 1 / (sigmas**2 + shared_sigma**2)
        value = float(values @ weight / weight.sum())
        spread = float(np.sqrt(np.square(weight * (values - value)).sum())) / weight.sum()
        return cls(value, max(spread, float(weight.sum() ** -0.5)))

    def is_beyond(self, limit: float) -> bool:
        """Whether the value is surely farther from zero than a limit."""
        return abs(self.value) - SURE * self.sigma > limit


def _fit_motion(camera: StereoCamera, then: Array, now: Array) -> tuple[Array, Array, Array, float]:
    """Return what fits points (N, 3) = (u, v, disparity) before and after a motion best: the motion
    (4, 4); the logarithm of the factor of the focal length, and the offset of the disparities, (2,)
    with covariance (2, 2); and the noise, px.
    """
    then, now = then.astype(np.float64), now.astype(np.float64)
    # All is in front of the camera.
    x = np.array([0.0, min(0.0, float(then[:, 2].min()) - ROWS_PX)])
    state: tuple[Array, Array] = np.eye(4), x
    known = np.diag([MOTION_SIGMA**-2] * 6 + [PRIOR_SIGMA**-2, WINDOW_PX**-2])

    def linearise(state: tuple[Array, Array], _: int) -> tuple[Array, Array, float]:
        T, x = state
        error, J = _residuals(camera, then, now, x, T)
        noise_px = spread_px(error)
        weight = (1.0 + np.square(error).sum(axis=1) / (2 * noise_px) ** 2) ** -2 / noise_px**2
        weighted = J.reshape(-1, 8).T * np.repeat(weight, 3)
        gradient = weighted @ error.ravel() - known @ np.append(np.zeros(6), x)
        return weighted @ J.reshape(-1, 8) + known, gradient, noise_px

    def moved(state: tuple[Array, Array], step: Array) -> tuple[Array, Array]:
        T, x = state
        most = np.array([PRIOR_SIGMA, WINDOW_PX])
        return se3_exp(step[:6]) @ T, x + np.clip(step[6:], -most, most)

    state, *_ = gauss_newton(state, linearise, range(MOTION_STEPS), moved, slice(6))
    (T, x), H, noise_px = gauss_newton(state, linearise, range(STEPS - MOTION_STEPS), moved)
    information = H[6:, 6:] - H[6:, :6] @ np.linalg.pinv(H[:6, :6]) @ H[:6, 6:]
    return T, x, np.linalg.inv(information), noise_px


def spread_px(error_px: Array) -> float:
    """Return the standard deviation of errors (...) of which less than half are outliers, by their
    median, at least `LEAST_NOISE_PX`.
    """
    return max(1.4826 * float(np.median(np.abs(error_px))), LEAST_NOISE_PX)


def _turn_rad(T_now_then: Array) -> float:
    return float(np.arccos(np.clip((np.trace(T_now_then[:3, :3]) - 1) / 2, -1, 1)))


def _residuals(
    camera: StereoCamera, then: Array, now: Array, x: Array, T_now_then: Array
) -> tuple[Array, Array]:
    """Return where points (N, 3) are now against where they should be, (N, 3), and the derivatives
    (N, 3, 8) of the latter by a motion and by x (2,): the logarithm of the factor of the focal
    length, and the offset of the disparities.
    """
    log_factor, offset_px = x
    f = np.array([camera.fx, camera.fy]) * np.exp(log_factor)
    disparity = np.maximum(then[:, 2] - offset_px, LEAST_NOISE_PX)
    across = camera.baseline_m * camera.fx / disparity
    rays = (then[:, :2] - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    depth = across * np.exp(log_factor)
    points_then = np.column_stack([rays * across[:, None], depth])
    points = transform_points(T_now_then, points_then)
    x_m, y_m, z = points.T
    z = np.maximum(z, 1e-3)
    seen = np.column_stack([f[0] * x_m / z, f[1] * y_m / z, f[0] * camera.baseline_m / z])
    J_point = np.zeros((len(then), 3, 3))
    J_point[:, 0, 0], J_point[:, 1, 1] = f[0] / z, f[1] / z
    J_point[:, :, 2] = -seen / z[:, None]
    J = np.empty((len(then), 3, 8))
    J[:, :, :3], J[:, :, 3:6] = J_point, -J_point @ skew(points)
    J[:, :, 6] = seen + J_point @ T_now_then[:3, 2] * depth[:, None]
    grown = points_then @ T_now_then[:3, :3].T / disparity[:, None]
    J[:, :, 7] = (J_point @ grown[:, :, None])[:, :, 0] + (0.0, 0.0, 1.0)
    return now - (camera.cx, camera.cy, offset_px) - seen, J


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
