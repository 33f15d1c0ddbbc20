"""Tracking: the pose of a frame from the map points it sees again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array, transform_points
from segfloor_ros.slam.disparity_refinement import refine_disparity
from segfloor_ros.slam.features import Features
from segfloor_ros.slam.matching import Matches, match_predicted, match_unguided
from segfloor_ros.slam.patch_alignment import align_patches
from segfloor_ros.slam.pose import PoseEstimate, refine_pose, solve_pnp
from segfloor_ros.slam.residuals import MIN_DEPTH_M, Observations
from segfloor_ros.slam.settings import StereoSlamSettings
from segfloor_ros.slam.sparse_map import SparseMap

SIGMA_PIXEL = 0.6
"""Standard deviation of a corner's position at the finest pyramid level, px; grows with the
level.
"""

MIN_AGREEMENT = 0.5
"""Share of the matches that must agree on a pose: a wrong one has followers too, but not most."""

MAX_CORNER_NOISE_FACTOR = 2.0
"""Corners are not worse than this times `SIGMA_PIXEL`; beyond it the matches are wrong."""

MIN_SIGMA_PIXEL = 0.15
MIN_SIGMA_DISPARITY = 0.1
WIDE_SEARCH = 3.0
"""Factor on the search radius when the first search finds too little."""

NARROW_SEARCH = 0.4
"""Factor on the search radius once a pose is known from this very frame."""

MIN_VIEW_COSINE = 0.5
"""A descriptor is recognised up to 60 degrees from the direction it was taken."""


@dataclass(frozen=True)
class Track:
    """A frame with a pose.

    feature_rows, point_ids: (N,) the inlier matches. observations: of all features of the frame,
    (F, 3) px, with a disparity where one was measured. visible_ids: the points that should have
    been seen.
    """

    T_camera_world: Array
    covariance: Array
    feature_rows: NDArray[np.intp]
    point_ids: NDArray[np.int32]
    visible_ids: NDArray[np.int32]
    observations: Observations


@dataclass(frozen=True)
class _Prediction:
    """Map points expected in the image: ids (N,), pixel and disparity (N, 3), pyramid level
    (N,).
    """

    ids: NDArray[np.int32]
    uvd_px: Array
    octave: Array


class Tracker:
    """Finds the pose of frames against the local map."""

    def __init__(self, camera: StereoCamera, settings: StereoSlamSettings) -> None:
        self._camera = camera
        self._settings = settings

    def pixel_observations(self, features: Features) -> Observations:
        """Return the observations of features (N) before any disparity is known."""
        uvd = np.full((len(features), 3), np.nan)
        uvd[:, :2] = features.uv_px
        sigma = np.full((len(features), 3), 1.0)
        scale = self._settings.pyramid_scale ** features.octave.astype(np.float64)
        sigma[:, :2] = SIGMA_PIXEL * scale[:, None]
        return Observations(uvd, sigma)

    def track(
        self,
        left: NDArray[np.float32],
        right: NDArray[np.float32],
        features: Features,
        sparse_map: SparseMap,
        local_ids: NDArray[np.int32],
        predictions: Sequence[Array],
        offset_px: float = 0.0,
    ) -> Track | None:
        """Find the pose of a frame near one of the predicted ones, tried in order.

        offset_px: the known error of all disparities, measured minus true; the returned
        observations still have it.
        None when too few points are found again.
        """
        if len(features) == 0 or len(local_ids) == 0:
            return None
        tree = cKDTree(features.uv_px)
        observations = self.pixel_observations(features)
        estimate = self._coarse_pose(
            features, tree, observations, sparse_map, local_ids, predictions
        )
        if estimate is None:
            return None
        seen = self._predict(sparse_map, local_ids, estimate.T_camera_world)
        points, rows = self._search(features, tree, sparse_map, seen, NARROW_SEARCH)
        if len(rows) < self._settings.min_tracked:
            return None
        ids = seen.ids[points]
        self._align_pixels(left, observations, rows, sparse_map, ids, estimate.T_camera_world)
        guess_px = seen.uvd_px[points, 2] + offset_px
        self._measure_disparity(left, right, observations, rows, guess_px)
        estimate = refine_pose(
            self._camera,
            estimate.T_camera_world,
            sparse_map.xyz_world[ids],
            observations.take(rows).without_offset(offset_px),
        )
        if not self._agree(estimate):
            return None
        return Track(
            estimate.T_camera_world,
            estimate.covariance,
            rows[estimate.inliers],
            ids[estimate.inliers],
            seen.ids,
            observations.with_noise_factor(estimate.noise_factor),
        )

    def _coarse_pose(
        self,
        features: Features,
        tree: cKDTree,
        observations: Observations,
        sparse_map: SparseMap,
        local_ids: NDArray[np.int32],
        predictions: Sequence[Array],
    ) -> PoseEstimate | None:
        """Search around the predictions, then wider around the first, then without any."""
        attempts = [(T, 1.0) for T in predictions] + [(T, WIDE_SEARCH) for T in predictions[:1]]
        for T_predicted, factor in attempts:
            seen = self._predict(sparse_map, local_ids, T_predicted)
            points, rows = self._search(features, tree, sparse_map, seen, factor)
            estimate = self._believable(
                observations, sparse_map, seen.ids[points], rows, T_predicted
            )
            if estimate is not None:
                return estimate
        return self.locate(features, observations, sparse_map, local_ids)

    def locate(
        self,
        features: Features,
        observations: Observations,
        sparse_map: SparseMap,
        ids: NDArray[np.int32],
    ) -> PoseEstimate | None:
        """Find the pose among map points without a prediction: descriptors alone, then PnP-
        RANSAC.
        """
        points, rows = match_unguided(
            sparse_map.descriptor[ids], features.descriptor, self._settings.max_hamming
        )
        found = solve_pnp(self._camera, sparse_map.xyz_world[ids[points]], features.uv_px[rows])
        if found is None:
            return None
        T_camera_world, inliers = found
        points, rows = points[inliers], rows[inliers]
        return self._believable(observations, sparse_map, ids[points], rows, T_camera_world)

    def _believable(
        self,
        observations: Observations,
        sparse_map: SparseMap,
        ids: NDArray[np.int32],
        rows: NDArray[np.intp],
        T_start: Array,
    ) -> PoseEstimate | None:
        """Refine a pose; None unless enough matches agree with it, and not as a small minority."""
        if len(rows) < self._settings.min_tracked:
            return None
        estimate = refine_pose(
            self._camera,
            T_start,
            sparse_map.xyz_world[ids],
            observations.take(rows),
            MAX_CORNER_NOISE_FACTOR,
        )
        return estimate if self._agree(estimate) else None

    def _agree(self, estimate: PoseEstimate) -> bool:
        agreeing = int(estimate.inliers.sum())
        return agreeing >= max(self._settings.min_tracked, MIN_AGREEMENT * len(estimate.inliers))

    def _predict(
        self, sparse_map: SparseMap, ids: NDArray[np.int32], T_camera_world: Array
    ) -> _Prediction:
        """Project points into the image and keep those that a camera there should recognise."""
        camera = self._camera
        points = transform_points(T_camera_world, sparse_map.xyz_world[ids])
        front = points[:, 2] > MIN_DEPTH_M
        ids, points = ids[front], points[front]
        uvr = camera.project(points)
        distance = np.linalg.norm(points, axis=1)
        direction = points @ T_camera_world[:3, :3] / distance[:, None]
        cosine = (direction * sparse_map.viewing_direction[ids]).sum(axis=1)
        zoom = np.log(sparse_map.viewing_distance_m[ids] / distance)
        octave = sparse_map.viewing_octave[ids] + zoom / np.log(self._settings.pyramid_scale)
        visible = (
            (uvr[:, 0] >= 0)
            & (uvr[:, 0] < camera.width)
            & (uvr[:, 1] >= 0)
            & (uvr[:, 1] < camera.height)
            & (cosine > MIN_VIEW_COSINE)
            & (octave > -1.5)
            & (octave < self._settings.pyramid_levels + 0.5)
        )
        uvd = np.stack([uvr[:, 0], uvr[:, 1], uvr[:, 0] - uvr[:, 2]], axis=1)
        return _Prediction(ids[visible], uvd[visible], octave[visible])

    def _search(
        self,
        features: Features,
        tree: cKDTree,
        sparse_map: SparseMap,
        seen: _Prediction,
        radius_factor: float,
    ) -> Matches:
        scale = self._settings.pyramid_scale ** np.clip(seen.octave, 0, None)
        return match_predicted(
            features,
            tree,
            seen.uvd_px[:, :2],
            seen.octave,
            sparse_map.descriptor[seen.ids],
            radius_factor * self._settings.match_radius_px * scale,
            self._settings.max_hamming,
        )

    def _align_pixels(
        self,
        left: NDArray[np.float32],
        observations: Observations,
        rows: NDArray[np.intp],
        sparse_map: SparseMap,
        ids: NDArray[np.int32],
        T_camera_world: Array,
    ) -> None:
        """Replace corner positions by those of the points' patches, where the patch is found."""
        points = transform_points(T_camera_world, sparse_map.xyz_world[ids])
        zoom = sparse_map.patch_distance_m[ids] / np.linalg.norm(points, axis=1)
        template = sparse_map.patch[ids].astype(np.float32)
        found = align_patches(template, left, observations.uvd_px[rows, :2], zoom)
        sound = rows[found.sound]
        observations.uvd_px[sound, :2] = found.uv_px[found.sound]
        observations.sigma_px[sound, :2] = np.clip(
            found.sigma_px[found.sound], MIN_SIGMA_PIXEL, None
        )

    def _measure_disparity(
        self,
        left: NDArray[np.float32],
        right: NDArray[np.float32],
        observations: Observations,
        rows: NDArray[np.intp],
        guess_px: Array,
    ) -> None:
        disparity, sigma = refine_disparity(
            left, right, observations.uvd_px[rows, :2], guess_px, reach_px=0
        )
        observations.uvd_px[rows, 2] = disparity
        observations.sigma_px[rows, 2] = np.clip(sigma, MIN_SIGMA_DISPARITY, None)
