"""The stereo rig: its camera, its mount, and the error that all its disparities share, estimated
while it moves; and the model of what it measures.

Cheap stereo cameras bend and warm up: a tenth of a milliradian between the two eyes shifts every
disparity by the same fraction of a pixel and stretches far distances. An eye with another focal
length, or that is rolled, shifts those to the right and below by another one: distances to the left
are too short, to the right too long, and the path turns. A moving rig shows it: the parallax
between keyframes measures the same points without it.

A feature measures (u, v, d): its pixel in the left image and its disparity. The disparity is
found by correlating the patch around (u, v) with the right image, so its error is independent
of the error of (u, v), and smaller; (u, v, u_right) would not have that property.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from segfloor_ros.core.camera.model import OFFSET_SIGMA_PX, StereoCamera
from segfloor_ros.core.contracts import Mount
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.least_squares import SMALLEST
from segfloor_ros.core.twists import skew

LOCAL_KEYFRAMES = 10
"""Keyframes that move in a local adjustment, and adjustments that a keyframe takes part in: what is
solved well within the time between two keyframes."""

NEIGHBOURS = 2 * LOCAL_KEYFRAMES
"""Keyframes around a view: those that move in a local adjustment, and those that hold them."""

PAIR_SIGMA = 0.001
"""Expected of a rig: difference of the focal lengths of its eyes, as a share, and roll between
them, in radians."""

UNDERRATED = 3.0
"""An adjustment errs by so many times what the noise of its pixels explains: patches that are seen
from ever nearer are followed with errors that they share."""

SHOWN_EVERY = LOCAL_KEYFRAMES // 2
"""Of so many adjustments one is asked for the offset: it shares half its keyframes with the last
one that was."""

MEMORY_SIGMA_PX = 0.02
"""The estimate never counts as better known than this, so that it can follow the rig, px."""

FITTING = 0.95
"""Probability with which a measurement that is right is taken for one."""

GATE = 0.999
"""Probability with which what agrees is taken to agree, where a false alarm costs more."""

READOUT_S, BENT_S, MISFIT = 0.03, 1.0, 0.003
"""How long the readout of a rolling shutter takes, as a standard deviation before one is seen; what
shows in its place where something else bends images; and by how much, in m and rad, they always
are."""

MIN_DEPTH_M = 0.05

SAME_PX = 4
"""Pixels, and disparities, that differ by no more may show the same point where a pose, or a
disparity, is known roughly."""


MAX_DISPARITY_SHARE = 0.5
"""Largest disparity, as a share of the image's width."""


@dataclass(frozen=True)
class OffsetEstimate:
    """The offset, measured minus true disparity: value_px (3,), in the middle of the image, and
    what more it is at the right edge, and as far below; and its information (3, 3) in 1/px².
    """

    value_px: Array
    information: Array


class DisparityOffset:
    """Fuses what the local adjustments find of the offset with the expectation that it is 0.

    An information filter (Barfoot, State Estimation for Robotics, 2017, section 3.3). share: the
    part of an adjustment that is new to the filter; a keyframe takes part in several.
    """

    def __init__(self, camera: StereoCamera, share: float = SHOWN_EVERY / LOCAL_KEYFRAMES) -> None:
        self.camera, self._share = camera, share
        sigma_px = np.array([OFFSET_SIGMA_PX, *2 * [PAIR_SIGMA * camera.width / 2]])
        self._expected = np.diag(sigma_px**-2)
        self.estimate = OffsetEstimate(np.zeros(3), self._expected.copy())

    def at(self, uv_px: NDArray[np.floating]) -> Array:
        """Return the offset (N,) at pixels (N, 2 or more)."""
        return np.asarray(self.parts_of(uv_px) @ self.estimate.value_px)

    def parts_of(self, uv_px: NDArray[np.floating]) -> Array:
        """Return what pixels (N, 2 or more) have of each number of the offset (N, 3)."""
        from_middle = uv_px[:, :2] - (self.camera.cx, self.camera.cy)
        return np.insert(from_middle / (self.camera.width / 2), 0, 1.0, axis=1)

    def restored(self, numbers: Array) -> DisparityOffset:
        """Take over the numbers of a saved map, (12,) values and information, of older maps (2,)
        those of the middle alone, and return this. Raises ValueError for anything else.
        """
        parts = 1 if len(numbers) == 2 else 3
        self.estimate.value_px[:parts] = numbers[:parts]
        self.estimate.information[:parts, :parts] = numbers[parts:].reshape(parts, parts)
        return self

    def learn(self, left: OffsetEstimate) -> None:
        """Take in what an adjustment shows of the offset that the present estimate leaves. An
        offset that no rig has is none: where all points lie on a floor, another scale looks alike.
        """
        old, added = self.estimate, left.information / UNDERRATED**2
        seen_px = old.value_px + left.value_px
        unlike = added - added @ np.linalg.solve(self._expected + added, added)
        if seen_px @ unlike @ seen_px > chi2_limit(3, GATE):
            return
        information = old.information + self._share * added
        value_px = old.value_px + np.linalg.solve(information, self._share * added @ left.value_px)
        w, V = np.linalg.eigh(information)
        self.estimate = OffsetEstimate(value_px, V * np.minimum(w, MEMORY_SIGMA_PX**-2) @ V.T)


@dataclass(frozen=True)
class Readout:
    """How the camera moves while an image is read out, from the first row to the last: a twist (6,)
    and its variance (6,), in m and rad.
    """

    twist: Array
    variance: Array


AT_ONCE = Readout(np.zeros(6), np.full(6, SMALLEST))
"""All rows are exposed in one moment: a global shutter."""


class RollingShutter:
    """How long an image takes to be read out row by row, as the drive shows it.

    The camera goes on meanwhile, so the twist from the first row to the last is that time by the
    velocity. A map that was made at one velocity is bent alike: what shows the time is how the
    twist changes with the velocity. Three hypotheses compete by their evidence (of normal priors:
    Kass and Raftery, Bayes Factors, JASA 1995): that all rows are exposed at once, that there is
    such a time, and that something else bends images. seconds: of the readout. expected: in the
    next image.
    """

    def __init__(self) -> None:
        self.seconds, self.expected = 0.0, AT_ONCE
        self._of_map: Array = np.zeros((3, 6))
        self._sums = np.array([READOUT_S**-2, 0.0, 0.0, 1.0])

    def expect(self, velocity: Array, variance: Array) -> None:
        """Note the velocity (6,) in the next image, in m/s and rad/s, and its variance (6,)."""
        self.expected = Readout(self.seconds * velocity, self.seconds**2 * variance + SMALLEST)

    def see_keyframe(self, velocity: Array) -> None:
        """Note with which velocity (6,) a keyframe was taken."""
        # Their number, velocities, and what they were freed of, of the latest ones most.
        seen = np.stack([np.ones(6), velocity, self.seconds * velocity])
        self._of_map += seen - self._of_map / LOCAL_KEYFRAMES

    def learn(self, seen: Readout, velocity: Array) -> None:
        """Take in what an image showed of the twist, and the velocity (6,) there."""
        if not self._of_map.any():
            self._of_map[:2] = np.ones(6), velocity
        velocity_of_map, freed = self._of_map[1:] / self._of_map[0]
        change = velocity - velocity_of_map
        certainty, known = 1 / seen.variance, 1 / self.expected.variance
        information = np.maximum(certainty - known, SMALLEST)
        # Keyframes are freed of the twist as far as it was known when they were made.
        measured = (certainty * seen.twist - known * self.expected.twist) / information - freed
        weight = 1 / (1 / information + MISFIT**2)
        self._sums += *(weight @ np.stack([change**2, change * measured, measured**2], axis=1)), 6
        total, by_time, squared, count = self._sums
        seconds = by_time / total
        variance_s2 = max(1.0, (squared - seconds * by_time) / count) / total
        ratio = np.array([READOUT_S, BENT_S]) ** 2 / variance_s2
        rolling, bent = (seconds**2 / variance_s2 * ratio / (1 + ratio) - np.log1p(ratio)) / 2
        self.seconds = float(seconds * (rolling > max(math.log(GATE / (1 - GATE)), bent)))


def moved_on(points: Array, share: Array, twist: Array) -> Array:
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
    offset: DisparityOffset = field(init=False)

    def __post_init__(self) -> None:
        self.offset = DisparityOffset(self.camera)

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

    def without_offset(self, offset: DisparityOffset) -> Observations:
        """Return the same measurements with disparities freed of their offset."""
        off_px = np.outer(offset.at(self.uvd_px), (0, 0, 1))
        return Observations(self.uvd_px - off_px, self.sigma_px)

    @property
    def information(self) -> Array:
        """Inverse variances (N, 3) in 1/px²; 0 where there is no measurement."""
        return np.where(np.isfinite(self.uvd_px), 1.0 / self.sigma_px**2, 0.0)

    def with_noise_factor(self, factor: float) -> Observations:
        """Return the same measurements with standard deviations `factor` times as large."""
        return Observations(self.uvd_px, self.sigma_px * factor)

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
