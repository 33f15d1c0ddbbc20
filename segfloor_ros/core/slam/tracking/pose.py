"""The pose of one stereo frame against known map points: PnP-RANSAC, robust refinement, how well
the points determine it, and the consensus of those that stand still.

Most points agreeing is no proof: someone who walks by shows more of them than a plain wall behind.
So two motions are compared, that of the majority and that of the points which have a record of
standing still. They are distinguished, not averaged, where they contradict each other.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import UNKNOWN_COVARIANCE
from segfloor_ros.core.geometry import Array, invert, make_transform, transform_points
from segfloor_ros.core.least_squares import SHRINK, SMALLEST, minimise
from segfloor_ros.core.slam.rig import (
    AT_ONCE,
    MAX_DISPARITY_SHARE,
    MIN_DEPTH_M,
    SAME_PX,
    Observations,
    Readout,
    Rig,
    chi2_limit,
    huber_cost,
    huber_weights,
    is_gated,
    moved_on,
)
from segfloor_ros.core.slam.sparse_map import SparseMap
from segfloor_ros.core.slam.thresholds import PROOF
from segfloor_ros.core.slam.tracking.evidence import (
    LARGEST_FACTOR,
    Mixture,
    gained,
    is_proof,
    log_chance_of,
    surprise,
)
from segfloor_ros.core.timing import timed
from segfloor_ros.core.twists import se3_exp, se3_log

ROUNDS, STEPS_PER_ROUND = 3, 6
"""Of an estimate; outliers are looked for anew in each round."""

CONVERGED = 1e-4
"""Relative decrease of the cost, expected or seen, that ends a round."""

SAME_INLIERS = 0.01
"""Share of the points that changes sides below which another round would change nothing."""

RANSAC_ITERATIONS = 600
"""Where a quarter of the matches are right, nine times in ten four right ones are drawn in so many;
it ends early when more are right."""

ANYWHERE = np.diag(np.array([3.0] * 3 + [1.0] * 3) ** 2)
"""Covariance of where the camera may be in view of some points, m² and rad²."""

FIRST_INFORMATION = np.array([1.0] * 3 + [0.1] * 3) ** -2
"""Of a pose before any point is seen, in metres and radians: where no point determines it."""

FLOOR_M = 0.05
"""What is no higher belongs to the floor, which stands still whenever it was first seen, and whose
disparities repeat and mirror."""

USUAL_SHARE = 0.8
"""Where at least this share of what has a record fits, all is well: to look for a second motion
costs as much as the pose."""

PROVEN = math.log(PROOF - 0.5)
"""Record of what is taken to stand still, halfway to the next lower count: logarithms are rounded
one way or the other."""


@dataclass(frozen=True)
class Searched:
    """Where matches were looked for. area_px2: (N,) or one for all. range_px: of disparities.
    None: the whole image. missed: how many points more were looked for, and not found. by_chance:
    the probability to find something where the point is not. largest_factor: of the noise.
    """

    area_px2: Array | float | None = None
    range_px: float | None = None
    missed: int = 0
    by_chance: float = 1.0
    largest_factor: float = LARGEST_FACTOR

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> Searched:
        """Return that of the chosen matches."""
        area = self.area_px2
        return replace(self, area_px2=area[rows]) if isinstance(area, np.ndarray) else self

    def log_chance(self, camera: StereoCamera, observations: Observations) -> Array:
        """Return the logarithm (N,) of where a wrong match may lie over where a right one may."""
        area = camera.width * camera.height if self.area_px2 is None else self.area_px2
        range_px = MAX_DISPARITY_SHARE * camera.width if self.range_px is None else self.range_px
        return log_chance_of(observations, area, range_px) - math.log(self.by_chance)


WHOLE = Searched()


@dataclass(frozen=True)
class PoseEstimate:
    """A refined pose.

    T_camera_world: (4, 4). inliers: (N,) bool over the observations. covariance: (6, 6) of the
    twist in T_camera_world <- exp(twist) T_camera_world, order translation (m), rotation (rad).
    log_ratio: of the likelihood of the observations over that of chance (see `evidence`).
    readout: how the camera moves while the image is read out.
    """

    T_camera_world: Array
    inliers: NDArray[np.bool_]
    covariance: Array
    noise_factor: float
    log_ratio: float = 0.0
    readout: Readout = AT_ONCE

    def evidence(self, expected: PoseEstimate | None = None) -> float:
        """Return how much the observations say for the pose. expected: where the camera was to be;
        without it, anywhere within some metres.
        """
        information = np.linalg.inv(self.covariance)
        if expected is None:
            return self.log_ratio - gained(information, ANYWHERE)
        of_prior = gained(information, expected.covariance) + self.surprise(expected)
        return self.log_ratio - of_prior

    def surprise(self, expected: PoseEstimate) -> float:
        """Return by how many nats the pose is less likely than one just as expected."""
        error = se3_log(self.T_camera_world @ invert(expected.T_camera_world))
        return surprise(error, expected.covariance + self.covariance)


def solve_pnp(
    camera: StereoCamera,
    points_world: Array,
    uv_px: NDArray[np.floating],
    iterations: int = RANSAC_ITERATIONS,
) -> tuple[Array, NDArray[np.bool_]] | None:
    """Find T_camera_world from points (N, 3) and pixels (N, 2) by PnP in RANSAC, or None.

    Fischler and Bolles, Random sample consensus (1981), on OpenCV's AP3P (Ke and Roumeliotis,
    CVPR 2017), which draws four points; its generator is seeded, so that the same input gives the
    same pose. Also returns the inliers (N,).
    """
    if len(points_world) < 6:
        return None
    found, rotation_vector, translation, rows = cv2.solvePnPRansac(
        np.ascontiguousarray(points_world, np.float64),
        np.ascontiguousarray(uv_px, np.float64),
        camera.K,
        None,
        iterationsCount=iterations,
        reprojectionError=SAME_PX,
        confidence=0.999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or rows is None:
        return None
    inliers = np.zeros(len(points_world), bool)
    inliers[np.asarray(rows).ravel()] = True
    R = np.asarray(cv2.Rodrigues(rotation_vector)[0])
    return make_transform(R, np.asarray(translation, np.float64).ravel()), inliers


def refine_pose(
    camera: StereoCamera,
    T_camera_world: Array,
    points_world: Array,
    observations: Observations,
    prior: PoseEstimate | None = None,
    searched: Searched = WHOLE,
    is_noise_known: bool = False,
    first: NDArray[np.bool_] | None = None,
    readout: Readout = AT_ONCE,
) -> PoseEstimate:
    """Refine a pose by Levenberg-Marquardt on (u, v, d) with a Huber cost, dropping outliers
    between rounds.

    points_world: (N, 3). Points that fall behind the camera count as outliers. Blur, compression
    and a poor calibration make errors larger than the sigmas of single measurements; a mixture of
    right and wrong matches shows by how much, and the bound on outliers follows it, unless the
    noise is known. prior: the pose by other sensors; it adds what the points do not determine.
    searched: where the matches were looked for. first: which (N,) agree with the pose at the start.
    readout: as expected; its twist is estimated, too (Hedborg et al.,
    Rolling Shutter Bundle Adjustment, CVPR 2012).
    """
    seen = _Seen.of(camera, points_world, observations)
    inliers = np.ones(len(points_world), bool) if first is None else first
    if not len(points_world):
        unknown = PoseEstimate(T_camera_world, inliers, np.eye(6) * UNKNOWN_COVARIANCE, 1.0)
        return replace(prior or unknown, inliers=inliers)
    known = _Prior.of(prior, readout)
    log_chance = searched.log_chance(camera, observations)
    mixture: Mixture | None = None
    pose, twist, factor = T_camera_world, readout.twist, 1.0
    for _ in range(ROUNDS):
        best = minimise(_State(pose, twist, seen.take(inliers), known), STEPS_PER_ROUND, CONVERGED)
        pose, twist = best.pose, best.twist
        rays, chi2 = seen.distances(pose, twist)
        start = 1.0 if is_noise_known else math.sqrt(max(1.0, float(np.median(chi2 / seen.median))))
        mixture = Mixture.fit(
            chi2, seen.dimensions, log_chance, start, searched.missed, searched.largest_factor
        )
        factor = 1.0 if is_noise_known else mixture.factor
        before, inliers = inliers, chi2 <= factor**2 * seen.limit
        is_enough = prior is not None or inliers.sum() >= 4
        if not is_enough or (inliers != before).mean() < SAME_INLIERS:
            break
    if not is_enough:
        return PoseEstimate(pose, inliers, np.eye(6) * UNKNOWN_COVARIANCE, factor)
    assert mixture is not None
    # Huber's weight of an inlier is 1.
    J = seen.take(inliers).jacobian(rays[:, inliers], 1 / factor)
    H = J @ J.T
    covariance = np.linalg.inv(H + known.information + np.eye(12) / UNKNOWN_COVARIANCE)
    unlikely = gained(H[6:, 6:], np.diag(readout.variance))
    unlikely += 0.5 * float((twist - readout.twist) ** 2 @ (1 / readout.variance))
    found = Readout(twist, np.diag(covariance)[6:])
    ratio = mixture.log_ratio - unlikely
    return PoseEstimate(pose, inliers, covariance[:6, :6], factor, ratio, found)


@dataclass(frozen=True)
class _Prior:
    """What is known before any point is seen. T_world_camera: (4, 4), None where no pose is. twist:
    (6,) during the readout. information: (12, 12) of the twist of the pose, and of that one.
    """

    T_world_camera: Array | None
    twist: Array
    information: Array

    @staticmethod
    def of(estimate: PoseEstimate | None, readout: Readout) -> _Prior:
        """Return what another estimate tells, and what is expected of the readout."""
        information = np.diag(np.append(np.zeros(6), 1 / readout.variance))
        if estimate is None:
            return _Prior(None, readout.twist, information)
        information[:6, :6] = np.linalg.inv(estimate.covariance)
        return _Prior(invert(estimate.T_camera_world), readout.twist, information)

    def at(self, T_camera_world: Array, twist: Array) -> tuple[Array, float]:
        """Return the gradient (12,) of half the squared error of a pose and of a twist during the
        readout, and that squared error.
        """
        known = self.T_world_camera
        error = np.zeros(6) if known is None else se3_log(T_camera_world @ known)
        error = np.append(error, twist - self.twist)
        gradient = self.information @ error
        return gradient, float(error @ gradient)


@dataclass(frozen=True)
class _Seen:
    """Points and their observations, one long row (N,) for each coordinate, in few arrays: NumPy
    takes as long to begin as to compute hundreds of numbers.

    rows: (12, N), points of the world, focal lengths and disparity times depth, what was measured
    from the principal point, both in standard deviations, 0 where nothing is measured; limit and
    median of chi2; and when the pixel was read out, in shares of the whole image.
    """

    rows: Array

    @staticmethod
    def of(camera: StereoCamera, points_world: Array, observations: Observations) -> _Seen:
        """Return them, for points (N, 3)."""
        rows = np.empty((12, len(points_world)))
        rows[:3] = points_world.T
        measured = np.isfinite(observations.uvd_px)
        certainty = np.where(measured, 1.0 / observations.sigma_px, 0.0)
        scale = camera.fx, camera.fy, camera.disparity_times_depth
        np.multiply(certainty, scale, out=rows[3:6].T)
        from_centre = observations.uvd_px - (camera.cx, camera.cy, 0.0)
        rows[6:9] = np.where(measured, from_centre * certainty, 0.0).T
        rows[9] = observations.chi2_limit
        rows[10] = np.where(measured[:, 2], chi2_limit(3, 0.5), chi2_limit(2, 0.5))
        rows[11] = from_centre[:, 1] / camera.height
        return _Seen(rows)

    @property
    def limit(self) -> Array:
        """The bound (N,) of chi2."""
        return self.rows[9]

    @property
    def median(self) -> Array:
        """What chi2 (N,) is in the median, when all is well."""
        return self.rows[10]

    @property
    def dimensions(self) -> Array:
        """How many coordinates of each were measured (N,)."""
        return np.asarray((self.rows[3:6] > 0).sum(axis=0), np.float64)

    def take(self, columns: NDArray[np.bool_]) -> _Seen:
        """Return the chosen ones."""
        return self if columns.all() else _Seen(self.rows[:, columns])

    def at(self, T_camera_world: Array, twist: Array) -> tuple[Array, Array, Array]:
        """Return rays (3, N) = (x / z, y / z, 1 / z) to the points at a pose, the residuals (3, N)
        in standard deviations, and their squares (N,); points that are behind the camera are just
        before it. twist: (6,) during the readout.
        """
        points = T_camera_world[:3, :3] @ self.rows[:3] + T_camera_world[:3, 3:]
        rays = moved_on(points, self.rows[11], twist)
        inverse_z = 1.0 / np.maximum(rays[2], MIN_DEPTH_M)
        rays[:2] *= inverse_z
        rays[2] = inverse_z
        residual = rays * self.rows[3:6]
        residual -= self.rows[6:9]
        return rays, residual, np.einsum('an,an->n', residual, residual)

    def distances(self, T_camera_world: Array, twist: Array) -> tuple[Array, Array]:
        """Return the rays (3, N) and the squared residuals (N,) of `at`; what is behind the camera
        fits nothing.
        """
        rays, _, chi2 = self.at(T_camera_world, twist)
        chi2[rays[2] >= 1 / MIN_DEPTH_M] = 1e12
        return rays, chi2

    def jacobian(self, rays: Array, root: Array | float) -> Array:
        """Return the derivatives (12, 3 N) of what is seen along rays (3, N) by the twists of the
        pose and of the readout, in standard deviations times the roots (N,) of weights (Barfoot
        2017, eq. 7.183).
        """
        x, y, inverse_z = rays
        by_z = self.rows[3:6] * root
        u, v = by_z[:2]
        along = by_z * rays
        J: Array = np.zeros((12, *rays.shape))
        np.multiply(u, inverse_z, out=J[0, 0])
        np.multiply(v, inverse_z, out=J[1, 1])
        np.multiply(along, -inverse_z, out=J[2])
        np.multiply(along, -y, out=J[3])
        J[3, 1] -= v
        np.multiply(along, x, out=J[4])
        J[4, 0] += u
        np.multiply(u, -y, out=J[5, 0])
        np.multiply(v, x, out=J[5, 1])
        np.multiply(J[:6], self.rows[11], out=J[6:])
        return J.reshape(12, -1)


class _State:
    """A pose on trial, (4, 4), and the twist (6,) during the readout, of points that are seen, and
    of what was known before. cost: where that is known without a look at the points.
    """

    def __init__(
        self, pose: Array, twist: Array, seen: _Seen, prior: _Prior, cost: float | None = None
    ) -> None:
        self.pose, self.twist, self._seen, self._prior = pose, twist, seen, prior
        if cost is None:
            self._view, (self._pull, strain) = seen.at(pose, twist), prior.at(pose, twist)
            cost = huber_cost(self._view[2], seen.limit) + strain
        self.cost = cost

    def linearised(self) -> Callable[[float], tuple[_State, float]]:
        """Return what solves the normal equations for a damping."""
        rays, residual, chi2 = self._view
        root = np.sqrt(huber_weights(chi2, self._seen.limit))
        J = self._seen.jacobian(rays, root)
        H, g = J @ J.T + self._prior.information, J @ (residual * root).ravel() + self._pull

        def stepped(damping: float) -> tuple[_State, float]:
            damped = H.copy()
            diagonal = damped.ravel()[::13]
            diagonal += damping * (diagonal + 1e-9)
            step = np.linalg.solve(damped, -g)
            decrease = float(-g @ step)
            # What is predicted to gain too little to go on is not computed.
            cost = self.cost - decrease if decrease < CONVERGED * self.cost else None
            pose, twist = se3_exp(step[:6]) @ self.pose, self.twist + step[6:]
            return _State(pose, twist, self._seen, self._prior, cost), SHRINK

        return stepped


def knows_more(covariance: Array, by_images: PoseEstimate) -> bool:
    """Whether sensors, with the covariance (6, 6) of what they measure, know some direction of a
    pose better than the images.
    """
    known = np.linalg.inv(covariance + SMALLEST * np.eye(6))
    seen = np.linalg.inv(by_images.covariance) + np.diag(FIRST_INFORMATION)
    return bool(np.linalg.eigvals(np.linalg.solve(seen, known)).real.max() > 1)


class Consensus:
    """Finds poses from matched points of a map."""

    def __init__(self, sparse_map: SparseMap) -> None:
        self._map = sparse_map

    @timed
    def refine(
        self,
        T_start: Array,
        ids: NDArray[np.int32],
        observations: Observations,
        searched: Searched = WHOLE,
        known: PoseEstimate | None = None,
        readout: Readout | None = None,
    ) -> PoseEstimate:
        """Refine a pose by points `ids` (N,) and their observations (N). searched: where they were
        looked for. known: the pose of the same image by other measurements. readout: as expected in
        the image, by default the latest one.
        """
        points = self._map.xyz_world[ids]
        problem = _Problem(self._map.rig, points, observations, searched, readout)
        of_most = problem.refined(T_start)
        if known is not None and differ(of_most, known):
            return problem.near(known, known.noise_factor)
        record = self.record(ids, T_start)
        proven = record >= PROVEN
        if not proven.any() or of_most.inliers[proven].mean() > USUAL_SHARE:
            return of_most
        of_proven = problem.take(proven).refined(T_start)
        if not differ(of_most, of_proven):
            return of_most
        before = problem.fitting(of_most, of_proven.noise_factor)
        after = problem.fitting(of_proven, of_proven.noise_factor)
        # One of the two stands still, and each of its points had the record of what does.
        if not is_proof(record @ (after.astype(float) - before)):
            return of_most
        return problem.near(of_proven, of_proven.noise_factor)

    def at(
        self, known: PoseEstimate, ids: NDArray[np.int32], observations: Observations
    ) -> PoseEstimate:
        """Return a pose as it is, and which of points `ids` (N,) fit it, be they ever so few."""
        problem = _Problem(self._map.rig, self._map.xyz_world[ids], observations, WHOLE)
        return replace(known, inliers=problem.fitting(known, known.noise_factor))

    def record(self, ids: NDArray[np.int32], T_camera_world: Array) -> Array:
        """Return the logarithm (N,) of the odds that points stand still: what n keyframes saw at
        the same place does with n to 1, and what is on the floor stands whenever it was first seen.
        """
        count = np.maximum(self._map.observer_count[ids], 1).astype(np.float64)
        if self._map.rig.mount is not None:
            points = transform_points(T_camera_world, self._map.xyz_world[ids])
            on_floor = np.abs(self._map.rig.mount.heights_m(points)) < FLOOR_M
            count[on_floor] = np.maximum(count[on_floor], PROOF)
        return np.log(count)


@dataclass(frozen=True)
class _Problem:
    """Points (N, 3), their observations (N), and where these were looked for."""

    rig: Rig
    points: Array
    observations: Observations
    searched: Searched
    readout: Readout | None = None

    def take(self, rows: NDArray[np.bool_]) -> _Problem:
        """Return the chosen ones."""
        seen, searched = self.observations.take(rows), self.searched.take(rows)
        return replace(self, points=self.points[rows], observations=seen, searched=searched)

    def refined(self, T_start: Array) -> PoseEstimate:
        """Return the pose that most agree with."""
        camera, readout = self.rig.camera, self.readout or self.rig.shutter.expected
        seen = self.points, self.observations
        return refine_pose(camera, T_start, *seen, searched=self.searched, readout=readout)

    def near(self, known: PoseEstimate, noise_factor: float) -> PoseEstimate:
        """Return a pose refined by what fits it; what does not is of something else, or wrong."""
        near = self.fitting(known, noise_factor)
        found = self.take(near).refined(known.T_camera_world)
        inliers = np.zeros(len(self.points), bool)
        inliers[near] = found.inliers
        return replace(found, inliers=inliers)

    def fitting(self, known: PoseEstimate, noise_factor: float) -> NDArray[np.bool_]:
        """Return which observations (N,) fit a pose."""
        seen = _Seen.of(self.rig.camera, self.points, self.observations)
        _, chi2 = seen.distances(known.T_camera_world, known.readout.twist)
        return np.asarray(chi2 <= noise_factor**2 * seen.limit)


def differ(a: PoseEstimate, b: PoseEstimate) -> bool:
    """Whether two poses differ by more than their joint uncertainty."""
    error = se3_log(a.T_camera_world @ invert(b.T_camera_world))
    covariance = a.covariance + b.covariance + SMALLEST * np.eye(6)
    return not is_gated(error, covariance)
