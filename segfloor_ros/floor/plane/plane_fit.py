"""The search for the floor's plane in the disparities of one or more frames.

A plane is written as m = n / h, with n its unit normal pointing up and h the height of the first
camera above it, both in the world frame, which is the first left optical frame. The point X is on
the plane where m . X + 1 = 0, so the ray q from a camera at t meets it at the inverse depth
-(m . q) / (1 + m . t): in a rectified pair a plane's disparity is linear in the pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array

MAX_PITCH_RAD = np.radians(45.0)
MAX_ROLL_RAD = np.radians(20.0)
HEIGHT_RANGE_M = (0.04, 4.0)
INLIER_PX = 1.0
"""Disparities this near to a plane's support it."""
_MIN_PLANE_PX = 1.0
"""Where the plane's disparity is smaller the image says nothing of it."""
_VIOLATION_WEIGHT = 1.5
_CORRELATED_SAMPLES = 12.0
"""Neighbouring samples err together: so many count as one."""
_SIGMA_PX = 0.5
SCALES_PX = (3.0, 2.0, 1.5, 1.0, 1.0, 0.7, 0.5, 0.5, 0.5, 0.5)
"""Of the biweight with which a plane is refined, one per step."""
_LEVEL, _LEVEL_SIGMA_RAD = np.zeros(2), np.radians([20.0, 6.0])
_CLIMB = 0.03
_SWAY_M = 0.03
"""How far from parallel to the floor a camera travels: a slope, and what it sways."""


@dataclass(frozen=True)
class Samples:
    """Disparities of one frame: rays (N, 3) turned into the world, the camera's position (3,) in
    the world in metres, disparities (N,) in pixels, weights (N,) in [0, 1], times `every`.
    disparity_m: fx * baseline.
    """

    rays: Array
    position_m: Array
    disparity_px: Array
    weight: Array
    disparity_m: float

    def every(self, step: int) -> Samples:
        """Return only one of every so many, which weighs as much as these."""
        return Samples(
            self.rays[::step],
            self.position_m,
            self.disparity_px[::step],
            self.weight[::step] * step,
            self.disparity_m,
        )


@dataclass(frozen=True)
class PlaneFit:
    """A refined plane: angles_height (3,) = pitch_rad, roll_rad, height_m of the first camera;
    sigma (3,) of them; support: share of the weight of the samples below the plane's horizon
    that lies on it; violations: share that lies below it. is_mirror: what lies below is the mirror
    image of what stands on it, and is counted in neither.
    """

    angles_height: Array
    sigma: Array
    support: float
    violations: float
    is_mirror: bool = False


def plane_of(angles_height: Array) -> Array:
    """Return planes m (..., 3) of pitch, roll and height (..., 3)."""
    pitch, roll, height = np.moveaxis(angles_height, -1, 0)
    normal = np.stack(
        [-np.cos(pitch) * np.sin(roll), -np.cos(pitch) * np.cos(roll), -np.sin(pitch)], axis=-1
    )
    return normal / height[..., None]


def angles_height_of(planes: Array) -> Array:
    """Return pitch, roll and height (..., 3) of planes m (..., 3)."""
    height = 1 / np.linalg.norm(planes, axis=-1)
    normal = planes * height[..., None]
    pitch = np.arcsin(np.clip(-normal[..., 2], -1, 1))
    roll = np.arctan2(-normal[..., 0], -normal[..., 1])
    return np.stack([pitch, roll, height], axis=-1)


def plausible(angles_height: Array) -> NDArray[np.bool_]:
    """Tell which of pitch, roll and height (..., 3) a floor can have."""
    pitch, roll, height = np.moveaxis(angles_height, -1, 0)
    return (
        (np.abs(pitch) < MAX_PITCH_RAD)
        & (np.abs(roll) < MAX_ROLL_RAD)
        & (height > HEIGHT_RANGE_M[0])
        & (height < HEIGHT_RANGE_M[1])
    )


def propose(samples: Samples, count: int, rng: np.random.Generator, known: Array) -> Array:
    """Return plausible pitch, roll and height (M, 3) of planes through few samples each.

    Half of them go through three samples, half through two, without roll. known: (3,), values
    that are given, NaN where not.
    """
    probability = samples.weight / samples.weight.sum()
    chosen = rng.choice(len(samples.weight), size=(count, 3), p=probability)
    q = samples.rays[chosen]
    inverse_depth = samples.disparity_px[chosen] / samples.disparity_m
    # m . (q + inverse_depth * t) = -inverse_depth
    rows = q + inverse_depth[..., None] * samples.position_m
    half = count // 2
    rows[half:, 2] = (1.0, 0.0, 0.0)
    inverse_depth[half:, 2] = 0.0
    regular = np.abs(np.linalg.det(rows)) > 1e-6
    planes = np.linalg.solve(rows[regular], -inverse_depth[regular][..., None])[..., 0]
    planes = planes[np.isfinite(planes).all(axis=1) & (np.abs(planes).max(axis=1) > 1e-6)]
    return with_known(angles_height_of(planes), known)


def with_known(angles_height: Array, known: Array) -> Array:
    """Return the plausible ones (M, 3) of the guesses (N, 3), given values put in."""
    guesses = np.where(np.isnan(known), angles_height, known)
    return guesses[plausible(guesses)]


def plane_disparity(samples: Samples, planes: Array) -> Array:
    """Return the disparity (N, M) of planes m (M, 3) at the samples, in pixels."""
    along = 1 + planes @ samples.position_m
    scale = -samples.disparity_m / np.where(np.abs(along) < 1e-6, 1e-6, along)
    found = samples.rays @ planes.T
    found *= scale
    return found


def scores(samples: Samples, angles_height: Array) -> Array:
    """Return how much of the samples' weight speaks for each plane (M, 3), less what speaks
    against it.

    The floor hides what is below it: a disparity clearly smaller than the plane's contradicts it.
    """
    planes = plane_of(angles_height)
    on, below, _ = on_and_below(samples, planes)
    on -= _VIOLATION_WEIGHT * below
    value = samples.weight @ on
    above_camera = 1 + planes @ samples.position_m < 0.2
    return np.where(above_camera, -np.inf, value)


def on_and_below(
    samples: Samples, planes: Array
) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return of each sample and each plane m (M, 3) how near it lies to it, in [0, 1], whether
    it lies clearly below, and whether the plane is visible there at all, each (N, M).
    """
    expected = plane_disparity(samples, planes)
    visible = expected > _MIN_PLANE_PX
    error = samples.disparity_px[:, None] - expected
    # Matching errs in proportion to nothing, planes in proportion to their disparity. In place:
    # thousands of samples times hundreds of planes are what a process needs most memory for.
    expected *= 0.05
    expected += 2 * INLIER_PX
    np.negative(expected, out=expected)
    below = visible & (error < expected)
    on = np.divide(error, INLIER_PX, out=error)
    np.multiply(on, on, out=on)
    np.subtract(1, on, out=on)
    np.maximum(on, 0, out=on)
    on[~visible] = 0
    return on, below, visible


def preference(
    angles_height: Array,
    travel: Array,
    expected_rad: Array = _LEVEL,
    sigma_rad: Array = _LEVEL_SIGMA_RAD,
) -> Array:
    """Return how far each plane (M, 3) is what one expects, in (0, 1].

    expected_rad, sigma_rad: (2,) of pitch and roll; by default cameras look roughly ahead and
    hardly roll. They travel (T, 3), in metres, parallel to the floor.
    """
    squares = (((angles_height[:, :2] - expected_rad) / sigma_rad) ** 2).sum(axis=1)
    squares += mean_climb(angles_height, travel) ** 2
    return np.exp(-0.5 * squares)


def mean_climb(angles_height: Array, travel: Array) -> Array:
    """Return how far travel (T, 3) leaves each plane (M, 3), in sigmas of what slopes and swaying
    explain.
    """
    if len(travel) == 0:
        return np.zeros(len(angles_height))
    unit = plane_of(np.concatenate([angles_height[:, :2], np.ones((len(angles_height), 1))], 1))
    climb = (unit @ travel.T) / _climb_sigma_m(travel)
    return np.sqrt(np.mean(climb**2, axis=1))


def _climb_sigma_m(travel: Array) -> Array:
    return _CLIMB * np.linalg.norm(travel, axis=1) + _SWAY_M


def refine(
    frames: list[Samples],
    start: Array,
    known: Array,
    travel: Array,
    prior_sigma: Array | None = None,
    scales_px: tuple[float, ...] = SCALES_PX,
    prior_mean: Array | None = None,
) -> PlaneFit:
    """Refine pitch, roll and height (3,) by robust Gauss-Newton on the disparities of all frames.

    travel: (T, 3) displacements of the camera in metres, along which the floor runs.
    prior_sigma: (3,) how far from `prior_mean`, by default `start`, the values may be; infinite
    where nothing is known.
    scales_px: scale of the biweight, one per iteration.
    """
    state = start.copy()
    free = np.isnan(known)
    information: Array = np.eye(3)
    prior = np.zeros((3, 3)) if prior_sigma is None else np.diag(prior_sigma**-2.0)
    mean = start if prior_mean is None else prior_mean
    for scale in scales_px:
        information, gradient = _normal_equations(frames, state, scale)
        _add_travel(information, gradient, state, travel)
        information += prior
        gradient += prior @ (mean - state)
        step = np.zeros(3)
        step[free] = np.linalg.solve(
            information[np.ix_(free, free)] + 1e-9 * np.eye(int(free.sum())), gradient[free]
        )
        state = state + np.clip(step, -0.1, 0.1)
    sigma = np.zeros(3)
    covariance = np.linalg.pinv(information[np.ix_(free, free)])
    sigma[free] = np.sqrt(np.maximum(np.diag(covariance), 0))
    support, violations = shares(frames, state)
    return PlaneFit(state, sigma, support, violations)


def _jacobian(angles_height: Array) -> Array:
    """Return dm / d(pitch, roll, height) (3, 3)."""
    pitch, roll, height = (float(value) for value in angles_height)
    (sp, cp), (sr, cr) = ((math.sin(angle), math.cos(angle)) for angle in (pitch, roll))
    by_angles = np.array(
        [[sp * sr, -cp * cr, cp * sr / height], [sp * cr, cp * sr, cp * cr / height]]
    )
    by_angles = np.vstack([by_angles, [-cp, 0.0, sp / height]])
    return by_angles / height


def _normal_equations(frames: list[Samples], state: Array, scale: float) -> tuple[Array, Array]:
    information, gradient = np.zeros((3, 3)), np.zeros(3)
    plane, by_state = plane_of(state), _jacobian(state)
    for samples in frames:
        along = 1 + float(plane @ samples.position_m)
        toward = samples.rays @ plane
        expected = -samples.disparity_m * toward / along
        error = samples.disparity_px - expected
        weight = samples.weight * np.maximum(1 - (error / (2 * scale)) ** 2, 0) ** 2
        weight = np.where(expected > _MIN_PLANE_PX, weight, 0)
        weight /= _CORRELATED_SAMPLES * _SIGMA_PX**2
        jacobian = samples.rays @ by_state
        jacobian -= (toward / along)[:, None] * (samples.position_m @ by_state)
        jacobian *= -samples.disparity_m / along
        information += jacobian.T @ (jacobian * weight[:, None])
        gradient += jacobian.T @ (weight * error)
    return information, gradient


def _add_travel(information: Array, gradient: Array, state: Array, travel: Array) -> None:
    """Add that the camera travels parallel to the floor: all displacements count as one."""
    unit = np.array([*state[:2], 1.0])
    scaled = travel / (_climb_sigma_m(travel) * math.sqrt(max(1, len(travel))))[:, None]
    rows = scaled @ _jacobian(unit)[:, :2]
    information[:2, :2] += rows.T @ rows
    gradient[:2] -= rows.T @ (scaled @ plane_of(unit))


def shares(frames: list[Samples], state: Array) -> tuple[float, float]:
    """Return which share of the weight of the samples where a plane, (3,), is visible lies on it,
    and which below it.
    """
    on = below = total = 0.0
    for samples in frames:
        expected = plane_disparity(samples, plane_of(state)[None])[:, 0]
        error = samples.disparity_px - expected
        visible = np.where(expected > _MIN_PLANE_PX, samples.weight, 0)
        total += float(visible.sum())
        on += float(visible[np.abs(error) < INLIER_PX].sum())
        below += float(visible[error < -(2 * INLIER_PX + 0.05 * expected)].sum())
    return (on / total, below / total) if total > 0 else (0.0, 1.0)
