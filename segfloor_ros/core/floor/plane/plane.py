"""The plane of the floor in the disparities of one or more frames.

A plane is written as m = n / h, with n its unit normal pointing up and h the height of the camera
above it, in the axes of the left camera. The point X is on the plane where m . X + 1 = 0, so the
ray q meets it at the inverse depth -m . q: in a rectified pair a plane's disparity is linear in the
pixel. A camera that is fixed to its base sees the floor on the same plane in all frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import OFFSET_SIGMA_PX, StereoCamera
from segfloor_ros.core.contracts import Mount
from segfloor_ros.core.floor.disparity.matching import NOISE_PX, SAME_PX, SIGMAS
from segfloor_ros.core.floor.disparity.profile import (
    HEIGHT_SIGMA,
    PITCH_SIGMA_RAD,
    FloorLine,
    column_step,
    is_rise,
    pixels_where,
    rising,
)
from segfloor_ros.core.gauss_newton import gauss_newton
from segfloor_ros.core.geometry import Array

MAX_PITCH_RAD, MAX_ROLL_RAD = np.radians([45.0, 20.0])
HEIGHT_RANGE_M = (0.04, 4.0)
"""What mounts are."""
LEVEL_SIGMA = np.array([math.radians(7.0), math.radians(2.0), math.inf])
"""Cameras look roughly ahead and hardly roll, one sigma of pitch and roll; height is not known."""
SAMPLES = 4000
"""So many pixels of an image are looked at: their neighbours say the same."""
_BEND = 0.05
"""A floor bends, and its disparity differs from the plane's, by this share."""
_CORRELATED_SAMPLES = 12.0
"""Neighbouring samples err together: so many count as one."""
_NATS = 0.5 * SIGMAS**2 / _CORRELATED_SAMPLES
"""Logarithm of a likelihood, of one in `scores`."""
_SCALES_PX = (3.0, 2.0, 1.5, 1.0, 1.0, 0.7, 0.5, 0.5, 0.5, 0.5)
NEAR_SCALES_PX = (2.0, 1.5, 1.0, 0.7, 0.5, 0.5)
FINER_SCALES_PX = NEAR_SCALES_PX[2:]
"""Of the biweight with which a plane is refined, one per step; of one that is nearly known, and of
one that was refined by some of its samples."""
_CLIMB, _SWAY_M = 0.03, 0.03
"""How far from parallel to the floor a camera travels: a slope, and what it sways."""
SURE = 3.0
"""Sigmas within which nearly all lies."""
PROPOSALS = 120
"""So many planes are proposed at once."""
_FLAT_WEIGHT = 0.1
"""Of samples whose disparity does not rise down the image as a floor's does."""
_AT_ONCE = 200
"""So many samples are compared with all planes at once: what they take fits a processor's cache."""


@dataclass(frozen=True)
class Samples:
    """Disparities of one frame: rays (N, 3), disparities (N,) in pixels, weights (N,). rise: (N,),
    by how much disparities grow per row around the samples, NaN where that is not known.
    disparity_m: fx * baseline. down: by how much rays change per row.
    """

    rays: Array
    disparity_px: Array
    weight: Array
    rise: Array
    disparity_m: float
    down: float

    @classmethod
    def of(
        cls,
        camera: StereoCamera,
        uv_px: Array,
        disparity_px: Array,
        weight: Array,
        rise: Array | None = None,
    ) -> Samples:
        """Return the samples at pixels (N, 2)."""
        rays = camera.back_project(uv_px, np.ones(len(uv_px)))
        rise = np.full(len(uv_px), np.nan) if rise is None else rise
        return cls(rays, disparity_px, weight, rise, camera.disparity_times_depth, 1.0 / camera.fy)

    def every(self, step: int) -> Samples:
        """Return only one of every so many, which weighs as much as these."""
        some = self.take(np.s_[::step])
        return replace(some, weight=step * some.weight)

    def take(self, rows: slice | NDArray[np.intp]) -> Samples:
        """Return the chosen ones."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _OF_EACH})

    @classmethod
    def joined(cls, frames: Sequence[Samples]) -> Samples:
        """Return the samples of at least one frame of one camera as those of one."""
        columns = {name: [getattr(frame, name) for frame in frames] for name in _OF_EACH}
        joined: dict[str, Any] = {name: np.concatenate(all_) for name, all_ in columns.items()}
        return replace(frames[0], **joined)

    def near(self, angles_height: Array) -> Samples:
        """Return only those that matter where a plane, (3,), is refined that is nearly known."""
        error, _, visible = _seen(self, plane_of(angles_height)[None])
        is_near = visible[:, 0] & (np.abs(error[:, 0]) < 2 * FINER_SCALES_PX[0])
        return self.take(np.flatnonzero(is_near))

    def weight_on(self, plane: Array) -> Array:
        """Return the weights (N,) for a plane (3,): little where disparities do not rise down the
        image as those of the plane do.
        """
        slope = -self.disparity_m * self.down * float(plane[1])
        rises = is_rise(self.rise, slope) | np.isnan(self.rise)
        return self.weight * np.where(rises, 1.0, _FLAT_WEIGHT)


_OF_EACH = ('rays', 'disparity_px', 'weight', 'rise')
"""What `Samples` have of each pixel."""
LOOKS = 4
"""By so many frames it is seen how much a plane varies."""
SWAY = (math.radians(2.0), math.radians(2.5), 0.04)
"""How much pitch, roll and height, as a share of it, of the camera above the floor vary on the way,
as standard deviations: robots sway, and where they are is known so well.
"""
_LEAST_SUPPORT, _MOST_BELOW = 0.04, 0.25
"""Least support of a floor (true ones 0.07 or more, posters at one height 0.02), and most
violations as a share of it (true ones 0.15 at most, others and mirrors 0.33 or more).
"""


PROVED = math.log(20)
"""Of planes with this evidence one in twenty is there by chance."""


@dataclass(frozen=True)
class PlaneFit:
    """A refined plane: angles_height (3,) = pitch_rad, roll_rad, height_m of the camera;
    sigma (3,) of them; support: share of the weight of the samples below the plane's horizon
    that lies on it as a floor does, and violations: that lies together below it. evidence: of the
    plane of a frame, the logarithm of how much likelier all that is seen is with it than without.
    """

    angles_height: Array
    sigma: Array
    support: float = 0.0
    violations: float = 0.0
    evidence: float = math.nan

    @property
    def is_seen(self) -> bool:
        """Whether enough is seen on it, and little enough below it, for a floor."""
        return self.support > _LEAST_SUPPORT and self.violations < _MOST_BELOW * self.support


class Fixture:
    """What the planes of frames say of how the camera is fixed to its base. problem: in words, once
    their heights vary by more than robots sway: a hand does not hold a camera like that. planes:
    pitch, roll and height (3,) of the camera above each of them, in order.
    """

    def __init__(self) -> None:
        self.problem: str | None = None
        self.planes: list[Array] = []

    def usual(self, mounted: Array) -> Array:
        """Return pitch, roll and height (1, 3) of the camera in most frames, where that is not how
        it is mounted (3,); (0, 3) where it is, and while few frames were seen.
        """
        usual = np.median(self.planes or [mounted], axis=0)
        off = np.abs(usual - mounted) / (1.0, 1.0, mounted[2])
        is_other = len(self.planes) >= LOOKS and (off > SURE * np.array(SWAY)).any()
        return usual[None] if is_other else np.zeros((0, 3))

    def note(self, fit: PlaneFit) -> None:
        """Take in the plane of a frame."""
        if not (fit.evidence > PROVED and fit.is_seen):
            return
        self.planes.append(fit.angles_height)
        heights_m = np.array(self.planes)[:, 2]
        # One and two sigmas to either side of the median: a few wrong planes do not count.
        low, minus, middle, plus, high = np.percentile(heights_m, (2.5, 16, 50, 84, 97.5))
        if len(heights_m) >= LOOKS and plus - minus > 2 * SWAY[2] * middle:
            self.problem = (
                'the camera is not fixed to its base: its height above the floor varies by '
                f'{high - low:.2f} m; fix it. There is floor only where an image shows its plane'
            )


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
    """Return which of pitch, roll and height (..., 3) a floor can have."""
    pitch, roll, height = np.moveaxis(angles_height, -1, 0)
    level = (np.abs(pitch) < MAX_PITCH_RAD) & (np.abs(roll) < MAX_ROLL_RAD)
    return level & (height > HEIGHT_RANGE_M[0]) & (height < HEIGHT_RANGE_M[1])


def _seen(samples: Samples, planes: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return of each sample and each plane m (M, 3) by how much its disparity exceeds the plane's,
    how much less than that lies clearly below the plane, and whether it is seen there at all, each
    (N, M).
    """
    scaled = (-samples.disparity_m * planes).astype(np.float32)
    expected = samples.rays.astype(np.float32) @ scaled.T
    visible = expected > SAME_PX
    error = samples.disparity_px[:, None].astype(np.float32) - expected
    return error, np.float32(-_BEND) * expected - np.float32(2 * SAME_PX), visible


def scores(samples: Samples, angles_height: Array) -> Array:
    """Return how much of the samples' weight speaks for each plane (M, 3), less what speaks
    against it.

    The floor hides what is below it: a disparity clearly smaller than the plane's contradicts it.
    """
    planes, total = plane_of(angles_height), np.zeros(len(angles_height))
    for start in range(0, len(samples.weight), _AT_ONCE):
        part = samples.take(slice(start, start + _AT_ONCE))
        error, limit, visible = _seen(part, planes)
        on = 1 - np.minimum((error / np.float32(SAME_PX)) ** 2, 1)
        total += part.weight @ ((on - (error < limit)) * visible)
    return total


def shares(samples: Samples, angles_height: Array) -> tuple[float, float]:
    """Return which share of the weight of the samples where a plane, (3,), is visible lies on it,
    and which below it, together on another one without roll: a surface that is seen through it.
    Wrong matches lie anywhere.
    """
    plane = plane_of(angles_height)
    error, limit, visible = (column[:, 0] for column in _seen(samples, plane[None]))
    total = float(samples.weight @ visible)
    if total == 0:
        return 0.0, 1.0
    on = (visible * samples.weight_on(plane))[np.abs(error) < SAME_PX].sum()
    below = samples.take(np.flatnonzero(samples.weight * visible * (error < limit)))
    if len(below.weight) == 0:
        return float(on) / total, 0.0
    down, found_px = below.rays[:, 1:2], below.disparity_px[:, None]
    one, other = np.random.default_rng(0).choice(len(down), size=(2, PROPOSALS))
    slope = (found_px[one] - found_px[other]) / (down[one] - down[other] + 1e-9)
    off_px = found_px - (found_px[one] + slope * (down.T - down[one])).T
    together = (below.weight @ (np.abs(off_px) < SAME_PX)).max(initial=0.0)
    return float(on) / total, float(together) / total


def mean_climb(angles_height: Array, travel: Array) -> Array:
    """Return how far travel (T, 3) leaves each plane (M, 3), in sigmas of what slopes and swaying
    explain.
    """
    if len(travel) == 0:
        return np.zeros(len(angles_height))
    unit = plane_of(angles_height) * angles_height[:, 2:]
    climb = (unit @ travel.T) / _climb_sigma_m(travel)
    return np.sqrt(np.mean(climb**2, axis=1))


def _climb_sigma_m(travel: Array) -> Array:
    return _CLIMB * np.linalg.norm(travel, axis=1) + _SWAY_M


def refine(
    samples: Samples,
    start: Array,
    known: Array,
    travel: Array,
    mean: Array,
    sigma: Array,
    scales_px: tuple[float, ...] = _SCALES_PX,
) -> PlaneFit:
    """Refine pitch, roll and height (3,) by robust Gauss-Newton on disparities.

    known: (3,), values that are given, NaN where not. travel: (T, 3) displacements of the camera in
    metres, along which the floor runs. mean, sigma: (3,) what is expected, and how surely.
    scales_px: of the biweight, one per iteration.
    """
    samples = replace(samples, rays=np.asfortranarray(samples.rays))
    free = np.isnan(known)
    prior = np.diag(sigma**-2.0)

    def linearise(state: Array, scale: float) -> tuple[Array, Array, Array]:
        information, gradient, shared = _normal_equations(samples, state, scale)
        _add_travel(information, gradient, state, travel)
        return information + prior, gradient + prior @ (mean - state), shared

    def moved(state: Array, step: Array) -> Array:
        return state + np.clip(step, -0.1, 0.1)

    state, information, shared = gauss_newton(start, linearise, scales_px, moved, free)
    error = np.zeros(3)
    covariance = np.linalg.pinv(information[np.ix_(free, free)])
    by_offset = OFFSET_SIGMA_PX * (covariance @ shared[free])
    error[free] = np.sqrt(np.maximum(np.diag(covariance), 0) + by_offset**2)
    return PlaneFit(state, error)


def _jacobian(angles_height: Array) -> Array:
    """Return dm / d(pitch, roll, height) (3, 3)."""
    pitch, roll, height = (float(value) for value in angles_height)
    (sp, cp), (sr, cr) = ((math.sin(angle), math.cos(angle)) for angle in (pitch, roll))
    right = (sp * sr, -cp * cr, cp * sr / height)
    down = (sp * cr, cp * sr, cp * cr / height)
    return np.array([right, down, (-cp, 0.0, sp / height)]) / height


def _normal_equations(samples: Samples, state: Array, scale: float) -> tuple[Array, Array, Array]:
    """Return the information (3, 3), the gradient (3,), and that (3,) of an error of a pixel which
    all disparities share.
    """
    by_state = -samples.disparity_m * _jacobian(state)
    expected = samples.rays @ (-state[2] * by_state[:, 2])
    error = samples.disparity_px - expected
    biweight = np.maximum(1 - (error / (2 * scale)) ** 2, 0)
    weight = samples.weight_on(plane_of(state)) * (expected > SAME_PX) * biweight**2
    weight /= _CORRELATED_SAMPLES * NOISE_PX**2
    weighted = samples.rays.T * weight
    information = by_state.T @ (weighted @ samples.rays) @ by_state
    return information, by_state.T @ (weighted @ error), by_state.T @ weighted.sum(axis=1)


def _add_travel(information: Array, gradient: Array, state: Array, travel: Array) -> None:
    """Add that the camera travels parallel to the floor: all displacements count as one."""
    if len(travel) == 0:
        return
    unit = np.array([*state[:2], 1.0])
    scaled = travel / (_climb_sigma_m(travel) * math.sqrt(len(travel)))[:, None]
    rows = scaled @ _jacobian(unit)[:, :2]
    information[:2, :2] += rows.T @ rows
    gradient[:2] -= rows.T @ (scaled @ plane_of(unit))


def expectations(mount: Mount, T_map_base: Array | None) -> Array:
    """Return what pitch, roll and height to expect of a frame, (P, 3).

    As the camera is mounted; or, should the robot pitch or roll on its wheels, level in the map;
    or, of a camera in a hand, as high as it is in the map.
    """
    mounted = np.array([mount.pitch_rad, mount.roll_rad, mount.height_m])
    if T_map_base is None:
        return mounted[None]
    T_map_left = T_map_base @ mount.T_base_left
    # A height that nothing can have is none, and a base that lies on its back sees no floor.
    heights_m = np.maximum((mount.height_m, T_map_left[2, 3]), HEIGHT_RANGE_M[0])
    of_map = angles_height_of(T_map_left[2, :3] / heights_m[:, None])
    return np.vstack([mounted, of_map[np.abs(of_map[:, 1]) < math.pi / 2]])


def plane_of_frame(
    camera: StereoCamera,
    first_row: int,
    disparity: NDArray[np.float32],
    texture: NDArray[np.float32],
    enough: float,
    expected: Array,
    is_fixed: bool = True,
) -> PlaneFit:
    """Return the plane of the floor in a frame, in its own camera's axes: the likeliest by what is
    seen and what is expected.

    disparity, texture: (R, W) from `first_row` on, every `column_step` columns. enough: texture
    that is no noise. expected: (P, 3), as of `expectations`. is_fixed: the camera to its base.
    """
    step = max(2, round(math.sqrt(disparity.size / SAMPLES)))
    part = disparity[::step, ::step]
    rows, columns = pixels_where(part > 0)
    across = step * column_step(camera)
    slope = FloorLine.of(camera, Mount(height_m=expected[0, 2], pitch_rad=expected[0, 0])).slope
    inclined = rising(disparity[:, ::step], slope)[::step][rows, columns]
    # The variance of a disparity falls with the square of its texture; a plane needs clearly some.
    square = (texture[::step, ::step][rows, columns] / (2.0 * enough)) ** 2
    weight = square / (square + 1.0) * np.where(inclined, 1.0, _FLAT_WEIGHT)
    uv_px = np.stack([columns * across, rows * step + first_row], axis=1).astype(np.float64)
    found_px = part[rows, columns].astype(np.float64)
    samples = Samples.of(camera, uv_px, found_px, weight)
    prior = FramePrior(expected, is_fixed)
    fit = _refined(samples, _likeliest(samples, prior), prior)
    # What is refined may leave what is expected.
    return fit if fit.evidence > -math.inf else _refined(samples, prior.means[0], prior)


class FramePrior:
    """What pitch, roll and height to expect of a frame: a mixture of Gaussians, of a base that
    stands still, or sways about what is expected (P, 3). means, sigmas: (P + 1, 3) each.
    """

    def __init__(self, expected: Array, is_fixed: bool) -> None:
        still = (PITCH_SIGMA_RAD, PITCH_SIGMA_RAD, HEIGHT_SIGMA)
        self.means = np.vstack([expected[0], expected])
        self.sigmas = np.vstack([still, *len(expected) * [SWAY]])
        self.sigmas[:, 2] *= self.means[:, 2]
        self._most = SURE if is_fixed else math.inf

    def log_posterior(self, samples: Samples, angles_height: Array) -> Array:
        """Return the logarithms of the likelihood times the density (M,) of planes (M, 3).

        A fixed camera that is as it is mounted knows its plane: what lies below that, farther than
        what lies on it on average, is a drop and no contradiction.
        """
        likelihood = np.repeat(scores(samples, angles_height)[:, None], len(self.means), axis=1)
        if self._most < math.inf:
            error, limit, _ = (part[:, 0] for part in _seen(samples, plane_of(self.means[:1])))
            floor_px, on = samples.disparity_px - error, np.abs(error) < SAME_PX
            mean_px = floor_px[on].sum() / max(np.count_nonzero(on), 1)
            kept = samples.take(np.flatnonzero((error >= limit) | (floor_px > mean_px)))
            likelihood[:, 0] = scores(kept, angles_height)
        return np.asarray((_NATS * likelihood + self.log_density(angles_height)).max(axis=1))

    def log_density(self, angles_height: Array) -> Array:
        """Return the logarithms of the density of each component (M, P + 1) at planes (M, 3)."""
        off = (angles_height[:, None] - self.means) / self.sigmas
        density = -0.5 * (off**2).sum(axis=2) - np.log(self.sigmas).sum(axis=1)
        density[(np.abs(off) > self._most).any(axis=2)] = -math.inf
        return density - 1.5 * math.log(2 * math.pi)


def _likeliest(samples: Samples, prior: FramePrior) -> Array:
    """Return the likeliest plane (3,) of those that are drawn from the prior, half of them raised
    or lowered such that a sample lies on them; as the camera is mounted, where nothing is seen.
    """
    total, rng = samples.weight.sum(), np.random.default_rng(0)
    if total == 0:
        return prior.means[0]
    of = rng.integers(len(prior.means), size=2 * PROPOSALS)
    drawn = rng.normal(prior.means[of], prior.sigmas[of])
    on = rng.choice(len(samples.weight), size=PROPOSALS, p=samples.weight / total)
    raised = drawn[:PROPOSALS]
    raised[:, 2] = 1.0
    depth_m = samples.disparity_m / samples.disparity_px[on]
    raised[:, 2] = -depth_m * (plane_of(raised) * samples.rays[on]).sum(axis=1)
    guesses = np.vstack([prior.means, drawn[plausible(drawn)]])
    few = samples.every(int(_CORRELATED_SAMPLES))
    return np.asarray(guesses[np.argmax(prior.log_posterior(few, guesses))])


def _refined(samples: Samples, guess: Array, prior: FramePrior) -> PlaneFit:
    """Return a plane (3,) refined, with its evidence by Laplace's approximation: Bishop, Pattern
    Recognition and Machine Learning, 2006, section 4.4.1.
    """
    nearest = np.argmax(prior.log_density(guess[None]))
    expected = prior.means[nearest], prior.sigmas[nearest]
    unknown, still = np.full(3, np.nan), np.zeros((0, 3))
    fit = refine(samples, guess, unknown, still, *expected, NEAR_SCALES_PX)
    state = fit.angles_height
    evidence = prior.log_posterior(samples, state[None])[0]
    evidence += np.log(fit.sigma).sum() + 1.5 * math.log(2 * math.pi)
    return PlaneFit(state, fit.sigma, *shares(samples, state), float(evidence))
