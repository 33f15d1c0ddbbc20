"""The pose by what stands still, where something that moves fills much of the image.

Most points agreeing is no proof: someone who walks by shows more of them than a plain wall behind.
So two motions are compared, that of the majority and that of the points which have a record of
standing still. They are distinguished, not averaged, where they contradict each other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array, invert, se3_log, transform_points
from segfloor_ros.slam.map.residuals import Observations, is_gated
from segfloor_ros.slam.map.sparse_map import SparseMap
from segfloor_ros.slam.rig import Rig
from segfloor_ros.slam.tracking.pose import (
    MAX_NOISE_FACTOR,
    PoseEstimate,
    refine_pose,
    squared_distances,
)

RECORD_KEYFRAMES = 3
"""Keyframes that a point must fit to be taken for standing still: what moves fits hardly two."""

FLOOR_M = 0.03
"""What is no higher belongs to the floor, which stands still whenever it was first seen."""

MIN_AGREEMENT = 0.5
"""Share of the matches that must agree on a pose: a wrong one has followers too, but not most."""

MIN_PROVEN = 12
"""Fewest points with a record that may speak against the majority."""

USUAL_SHARE, USUAL_NOISE = 0.8, 1.2
"""Where at least this share of what has a record fits, at no more than this noise, all is well."""

LEAST_VARIANCE = 1e-12
"""Of a pose, m² and rad²: a direction that is not observed must not look exact."""

KNOWN_NOISE = 2.0
"""Corners of an image are worse by no more than this factor than patches of the same image."""


@dataclass(frozen=True)
class Agreement:
    """A pose and the points that count for it: (N,) bool, all but those of another motion."""

    estimate: PoseEstimate
    counted: NDArray[np.bool_]

    @property
    def agreeing(self) -> int:
        """How many points agree with the pose."""
        return int(self.estimate.inliers.sum())

    @property
    def share(self) -> float:
        """The share of the points that count which agree."""
        return self.agreeing / max(1, int(self.counted.sum()))


class Consensus:
    """Finds poses from matched points of a map."""

    def __init__(self, rig: Rig, sparse_map: SparseMap) -> None:
        self._rig = rig
        self._camera = rig.camera
        self._map = sparse_map

    def refine(
        self,
        T_start: Array,
        ids: NDArray[np.int32],
        observations: Observations,
        max_noise_factor: float = MAX_NOISE_FACTOR,
        known: PoseEstimate | None = None,
    ) -> Agreement:
        """Refine a pose by points `ids` (N,) and their observations (N). known: the pose of the
        same image by other measurements.
        """
        points = self._map.xyz_world[ids]
        if known is not None:
            max_noise_factor = min(max_noise_factor, KNOWN_NOISE * known.noise_factor)
        of_most = refine_pose(self._camera, T_start, points, observations, max_noise_factor)
        problem = _Problem(self._camera, points, observations, of_most)
        if known is not None and differ(of_most, known):
            return problem.near(known.T_camera_world, max_noise_factor)
        proven = self.proven(ids, T_start)
        if proven.sum() < MIN_PROVEN or _fits(of_most, proven):
            return problem.of_everyone()
        measured = observations.take(proven)
        of_proven = refine_pose(self._camera, T_start, points[proven], measured, max_noise_factor)
        found = None
        if differ(of_most, of_proven):
            found = problem.choose(of_proven.T_camera_world, of_proven.noise_factor, proven)
        return problem.of_everyone() if found is None else found

    def at(
        self,
        known: PoseEstimate,
        ids: NDArray[np.int32],
        observations: Observations,
    ) -> Agreement:
        """Return a pose as it is, and which of points `ids` (N,) fit it, be they ever so few."""
        problem = _Problem(self._camera, self._map.xyz_world[ids], observations, known)
        fitting = problem.fitting(known.T_camera_world, KNOWN_NOISE * known.noise_factor)
        return Agreement(replace(known, inliers=fitting), fitting)

    def proven(self, ids: NDArray[np.int32], T_camera_world: Array) -> NDArray[np.bool_]:
        """Return which points (N,) have a record of standing still, or belong to the floor."""
        proven = self._map.observer_count[ids] >= RECORD_KEYFRAMES
        if self._rig.mount is not None:
            points = transform_points(T_camera_world, self._map.xyz_world[ids])
            proven |= np.abs(self._rig.mount.heights_m(points)) < FLOOR_M
        return proven


@dataclass(frozen=True)
class _Problem:
    """Points (N, 3), their observations (N), and the pose that most of them fit."""

    camera: StereoCamera
    points: Array
    observations: Observations
    of_most: PoseEstimate

    def of_everyone(self) -> Agreement:
        """Return the majority's pose."""
        return Agreement(self.of_most, np.ones(len(self.points), bool))

    def choose(
        self, T_other: Array, noise_factor: float, witnesses: NDArray[np.bool_]
    ) -> Agreement | None:
        """Return the other motion, refined by all that fits it; None unless most of its witnesses
        (N,) fit it, and do not fit the majority's.
        """
        before = self.fitting(self.of_most.T_camera_world, noise_factor)
        after = self.fitting(T_other, noise_factor)
        enough = max(MIN_PROVEN, MIN_AGREEMENT * witnesses.sum())
        support = (after & witnesses).sum()
        if support < enough or (before & witnesses).sum() > MIN_AGREEMENT * support:
            return None
        found = self.near(T_other, noise_factor)
        return replace(found, counted=found.counted | witnesses)

    def near(self, T_camera_world: Array, noise_factor: float) -> Agreement:
        """Return a pose refined by what fits it; nothing else counts. With too few points none
        agrees.
        """
        near = self.fitting(T_camera_world, noise_factor)
        if near.sum() < MIN_PROVEN:
            nobody = np.zeros(len(self.points), bool)
            return Agreement(replace(self.of_most, inliers=nobody), near)
        estimate = refine_pose(
            self.camera,
            T_camera_world,
            self.points[near],
            self.observations.take(near),
            noise_factor,
        )
        inliers = np.zeros(len(self.points), bool)
        inliers[near] = estimate.inliers
        return Agreement(replace(estimate, inliers=inliers), near)

    def fitting(self, T_camera_world: Array, noise_factor: float) -> NDArray[np.bool_]:
        """Return which observations (N,) fit a pose."""
        chi2 = squared_distances(self.camera, T_camera_world, self.points, self.observations)
        return np.asarray(chi2 <= noise_factor**2 * self.observations.chi2_limit)


def _fits(estimate: PoseEstimate, proven: NDArray[np.bool_]) -> bool:
    """Whether nothing hints at a second motion; to look for one costs as much as the pose."""
    fitting = bool(estimate.inliers[proven].mean() > USUAL_SHARE)
    return fitting and estimate.noise_factor < USUAL_NOISE


def differ(a: PoseEstimate, b: PoseEstimate) -> bool:
    """Whether two poses differ by more than their joint uncertainty."""
    error = se3_log(a.T_camera_world @ invert(b.T_camera_world))
    covariance = a.covariance + b.covariance + LEAST_VARIANCE * np.eye(6)
    return not is_gated(error, covariance)
