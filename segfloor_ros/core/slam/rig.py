"""The stereo rig: its camera, its mount, and the error that all its disparities share, estimated
while it moves; and the model of what it measures.

Cheap stereo cameras bend and warm up: a tenth of a milliradian between the two eyes shifts every
disparity by the same fraction of a pixel and stretches far distances. A moving rig shows it: the
parallax between keyframes measures the same points without it.

A feature measures (u, v, d): its pixel in the left image and its disparity. The disparity is
found by correlating the patch around (u, v) with the right image, so its error is independent
of the error of (u, v), and smaller; (u, v, u_right) would not have that property.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from segfloor_ros.core.camera.model import MAX_OFFSET_PX, OFFSET_SIGMA_PX, StereoCamera
from segfloor_ros.core.contracts import Mount
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.least_squares import SMALLEST
from segfloor_ros.core.twists import skew

LOCAL_KEYFRAMES = 10
"""Keyframes that move in a local adjustment, and adjustments that a keyframe takes part in: what is
solved well within the time between two keyframes."""

NEIGHBOURS = 2 * LOCAL_KEYFRAMES
"""Keyframes around a view: those that move in a local adjustment, and those that hold them."""

WINDOW_SIGMA_PX = 0.03
"""Error of the estimate from one local adjustment that more points do not average out, px."""

MEMORY_SIGMA_PX = 0.01
"""The estimate never counts as better known than this, so that it can follow the rig, px."""

FITTING = 0.95
"""Probability with which a measurement that is right is taken for one."""

GATE = 0.999
"""Probability with which what agrees is taken to agree, where a false alarm costs more."""

GLOBAL_SHUTTER = np.full(6, SMALLEST)
"""Variance of the twist during the readout where all rows are exposed at once, m² and rad²."""

LEAST_ROLL, ROLLED_FRAMES = np.full(6, 1e-6), 10
"""Least variance of that twist of a rolling shutter, that of half a pixel; and frames that count
for it."""

READOUT_S, FIRST_RATE, SURE = 0.03, 0.1, 4.0
"""How long a readout may take, by how much of a turn (rad/s) that counts, and how many standard
deviations show one."""

MIN_DEPTH_M = 0.05

SAME_PX = 4
"""Pixels, and disparities, that differ by no more may show the same point where a pose, or a
disparity, is known roughly."""


MAX_DISPARITY_SHARE = 0.5
"""Largest disparity, as a share of the image's width."""


@dataclass(frozen=True)
class OffsetEstimate:
    """Value of the offset, measured minus true disparity, and its information in 1/px²."""

    value_px: float
    information: float


NO_OFFSET, UNKNOWN_OFFSET = OffsetEstimate(0.0, 1e12), OffsetEstimate(0.0, 0.0)
"""Disparities are certainly true; nothing is known of them."""


class DisparityOffset:
    """Fuses what the local adjustments find of the offset with the expectation that it is 0.

    An information filter on one scalar (Barfoot, State Estimation for Robotics, 2017, section
    3.3). expected_sigma_px: of the offset before anything is seen, 0 when there is none. share: the
    part of an adjustment that is new to the filter; a keyframe takes part in several.
    """

    def __init__(self, expected_sigma_px: float, share: float) -> None:
        self._share = share
        self._estimating = expected_sigma_px > 0
        self.estimate = NO_OFFSET
        if self._estimating:
            self.estimate = OffsetEstimate(0.0, expected_sigma_px**-2)

    @property
    def value_px(self) -> float:
        """The present estimate."""
        return self.estimate.value_px

    def learn(self, left: OffsetEstimate) -> None:
        """Take in what an adjustment shows of the offset that the present estimate leaves."""
        known = self.estimate
        if not self._estimating or left.information <= 0:
            return
        seen_px = float(np.clip(known.value_px + left.value_px, -MAX_OFFSET_PX, MAX_OFFSET_PX))
        weight = self._share / (1.0 / left.information + WINDOW_SIGMA_PX**2)
        information = known.information + weight
        value_px = (known.information * known.value_px + weight * seen_px) / information
        self.estimate = OffsetEstimate(value_px, min(information, MEMORY_SIGMA_PX**-2))


class RollingShutter:
    """How far the camera moves while an image is read out row by row, as the drive shows it.

    The twist from the first row to the last is unknown in each frame, and 0 on average; its
    variances, one of ways and one of turns, are estimated from those of the frames before
    (expectation maximisation), once turns are seen to follow the camera's: what is bent for another
    reason, as by a wrong calibration, does not. variance: (6,) of the twist.
    """

    def __init__(self) -> None:
        self.variance = GLOBAL_SHUTTER
        self._sums = FIRST_RATE**2 * np.array([1.0, 0.0, READOUT_S**2, FIRST_RATE**2])

    def learn(self, roll: Array, variance: Array, velocity: Array) -> None:
        """Take in the twist (6,) in a frame, its variance, and how the camera moves per second."""
        turn, known = velocity[3:], (1 - variance / self.variance)[3:]
        weight = float(turn @ turn)
        seconds = float(turn @ roll[3:]) / max(float(turn**2 @ known), SMALLEST)
        seconds = max(-SURE * READOUT_S, min(seconds, SURE * READOUT_S))
        self._sums += weight * np.array([1.0, seconds, seconds**2, weight])
        _, mean, square, of_weights = self._sums / self._sums[0]
        sigma = np.sqrt(max(square - mean**2, 0.0) * of_weights / self._sums[0])
        seen = np.repeat((roll**2 + variance).reshape(2, 3).mean(axis=1), 3)
        latest = self.variance + (seen - self.variance) / ROLLED_FRAMES
        self.variance = np.maximum(latest, LEAST_ROLL) if mean > SURE * sigma else GLOBAL_SHUTTER


def rolled(points: Array, share: Array, twist: Array) -> Array:
    """Return points (3, N) of the camera as rows see them that are read out a share (N,) of the
    readout time later than the middle one, in which the camera moves by a twist (6,).
    """
    return np.asarray(points + share * (twist[:3, None] + skew(twist[3:]) @ points))


@dataclass
class Rig:
    """What all of SLAM knows of the stereo rig. mount: None until it is measured or given.
    mount_may_change: whether later looks may show another. base: where results place the base,
    None for at the mount; a path alone needs no mount, and waits for none.
    """

    camera: StereoCamera
    mount: Mount | None = None
    mount_may_change: bool = False
    base: Mount | None = None
    shutter: RollingShutter = field(default_factory=RollingShutter)
    offset: DisparityOffset = field(
        default_factory=lambda: DisparityOffset(OFFSET_SIGMA_PX, 1.0 / LOCAL_KEYFRAMES)
    )

    @property
    def base_mount(self) -> Mount | None:
        """The mount by which results are returned."""
        return self.base or self.mount


@dataclass(frozen=True)
class Observations:
    """Stereo measurements of N features.

    uvd_px: (N, 3) float64 = (u, v, disparity), disparity NaN where there is none. sigma_px: (N,
    3) standard deviations. Of old keyframes, and of those in files, they are only kept, in float32
    and float16; as `exact` they are computed with.
    """

    uvd_px: NDArray[np.floating]
    sigma_px: NDArray[np.floating]

    @staticmethod
    def of_pixels(uv_px: NDArray[np.floating], sigma_px: Array | float) -> Observations:
        """Return pixels (N, 2) before any disparity is known. sigma_px: of all, or (N, 1)."""
        uvd, sigma = np.full((len(uv_px), 3), np.nan), np.ones((len(uv_px), 3))
        uvd[:, :2], sigma[:, :2] = uv_px, sigma_px
        return Observations(uvd, sigma)

    def __len__(self) -> int:
        return len(self.uvd_px)

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> Observations:
        """Return the chosen rows."""
        return Observations(self.uvd_px[rows], self.sigma_px[rows])

    def compact(self) -> Observations:
        """Return the same measurements in little memory."""
        return Observations(self.uvd_px.astype(np.float32), self.sigma_px.astype(np.float16))

    def exact(self) -> Observations:
        """Return the same measurements to compute with."""
        return Observations(self.uvd_px.astype(np.float64), self.sigma_px.astype(np.float64))

    @property
    def has_disparity(self) -> NDArray[np.bool_]:
        """Whether each feature (N,) has a disparity."""
        return np.isfinite(self.uvd_px[:, 2])

    def without_offset(self, offset_px: float) -> Observations:
        """Return the same measurements with disparities freed of an error they all share."""
        return Observations(self.uvd_px - (0.0, 0.0, offset_px), self.sigma_px)

    @property
    def information(self) -> Array:
        """Inverse variances (N, 3) in 1/px²; 0 where there is no measurement."""
        return np.where(np.isfinite(self.uvd_px), 1.0 / self.sigma_px**2, 0.0)

    def with_noise_factor(self, factor: float) -> Observations:
        """Return the same measurements with standard deviations `factor` times as large."""
        return Observations(self.uvd_px, self.sigma_px * factor)

    @property
    def chi2_median(self) -> Array:
        """The median (N,) of the squared, normalised residual of each feature when all is well."""
        return np.where(np.isfinite(self.uvd_px[:, 2]), chi2_limit(3, 0.5), chi2_limit(2, 0.5))

    @property
    def chi2_limit(self) -> Array:
        """The 95 % bound (N,) on the squared, normalised residual of each feature."""
        return np.where(np.isfinite(self.uvd_px[:, 2]), chi2_limit(3), chi2_limit(2))


@cache
def chi2_limit(dimensions: int, probability: float = FITTING) -> float:
    """Return the quantile of the chi-squared distribution with so many degrees of freedom."""
    return float(chdtri(dimensions, 1.0 - probability))


def is_gated(error: Array, covariance: Array) -> bool:
    """Whether an error (D,) is no larger than its covariance (D, D) allows, with a probability of
    99.9 % (Mahalanobis distance).
    """
    return float(error @ np.linalg.solve(covariance, error)) <= chi2_limit(len(error), GATE)


def in_view(camera: StereoCamera, points: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return pixel and disparity (N, 3) of points (N, 3) of the left optical frame, NaN behind the
    camera, and which of them (N,) lie in the image.
    """
    front = points[:, 2] > MIN_DEPTH_M
    uvd = camera.project(np.where(front[:, None], points, (0.0, 0.0, 1.0)))
    uvd[:, 2] = uvd[:, 0] - uvd[:, 2]
    uvd[~front] = np.nan
    uv = uvd[:, :2]
    inside = (uv >= 0) & (uv < (camera.width, camera.height))
    return uvd, np.asarray(inside.all(axis=1))


def residuals(camera: StereoCamera, points: Array, observations: Observations) -> Array:
    """Return predicted minus measured (u, v, d), (N, 3) px, for points (N, 3) of the left
    optical frame.

    A disparity that was not measured gives 0. Points must have z > 0.
    """
    inverse_z = 1.0 / points[:, 2]
    predicted = np.stack(
        [
            camera.fx * points[:, 0] * inverse_z + camera.cx,
            camera.fy * points[:, 1] * inverse_z + camera.cy,
            camera.disparity_times_depth * inverse_z,
        ],
        axis=1,
    )
    residual = predicted - observations.uvd_px
    residual[np.isnan(residual)] = 0.0
    return residual


def weighted_jacobian(camera: StereoCamera, points_camera: Array, root: Array) -> Array:
    """Return J^T W^0.5 (3, 3, N) with J = d(u, v, d) / d(point), for points (N, 3) of the left
    optical frame and the roots (3, N) of their weights.
    """
    x, y, z = points_camera.T
    J: Array = np.zeros((3, 3, len(z)))
    J[0, 0], J[1, 1] = root[0] * (camera.fx / z), root[1] * (camera.fy / z)
    J[2, 0], J[2, 1] = -J[0, 0] * x / z, -J[1, 1] * y / z
    J[2, 2] = -root[2] * (camera.disparity_times_depth / z**2)
    return J


def with_moment(p: Array, vectors: Array) -> Array:
    """Return vectors (3, a, N) with p x vector below them (6, a, N), for points p (3, N).

    A derivative with respect to the point becomes that with respect to the twist of T_camera_world
    <- exp(twist) T_camera_world (Barfoot 2017, eq. 7.183 with rho first).
    """
    x, y, z = p
    a, b, c = vectors
    return np.stack([a, b, c, y * c - z * b, z * a - x * c, x * b - y * a])


def squared_norms(residual: Array, information: Array) -> Array:
    """Return the squared, normalised residuals (N,)."""
    return (residual**2 * information).sum(axis=1)


def huber_weights(chi2: Array, limit: Array) -> Array:
    """Return the weights (N,) of the Huber cost whose quadratic part ends at chi2 = limit."""
    return np.sqrt(np.minimum(1.0, limit / np.maximum(chi2, SMALLEST)))


def huber_cost(chi2: Array, limit: Array) -> float:
    """Return the summed Huber cost (Hartley & Zisserman, Multiple View Geometry, A6.8)."""
    inside = np.minimum(chi2, limit)
    return float((2.0 * np.sqrt(inside * chi2) - inside).sum())
