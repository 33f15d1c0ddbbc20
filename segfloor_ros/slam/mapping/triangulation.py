"""Points from the parallax between two keyframes, where one stereo pair sees no depth: what is far
away, or hidden from the right eye.

Mur-Artal et al., ORB-SLAM (IEEE T-RO 2015), section VI-D; the midpoint of two rays as in Hartley
and Sturm, Triangulation (CVIU 1997).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array, transform_points
from segfloor_ros.slam.map.records import KeyframeRecord
from segfloor_ros.slam.map.residuals import MIN_DEPTH_M
from segfloor_ros.slam.results import NO_POINT
from segfloor_ros.slam.tracking.features import MAX_HAMMING, PYRAMID_SCALE, hamming, one_to_one

MIN_PARALLAX_RAD = 0.02
"""Angle between two rays below which their crossing says little, about 1.1 degrees."""

MAX_PARALLAX_RAD = 0.5
MAX_EPIPOLAR_SIGMAS = 2.0
MAX_RANGE_RATIO = 1.5
"""Distances and pyramid levels must tell the same change of size up to this factor."""


@dataclass(frozen=True)
class NewPoints:
    """Points (N, 3) of frame world; feature rows (N,) that show them in two keyframes."""

    rows: NDArray[np.intp]
    other_rows: NDArray[np.intp]
    xyz_world: Array


def triangulate_between(
    camera: StereoCamera,
    keyframe: KeyframeRecord,
    other: KeyframeRecord,
    offset_px: float,
) -> NewPoints:
    """Match features that belong to no point yet along epipolar lines, and keep the crossings of
    rays that have parallax, lie before both cameras, project to both pixels and, where one of the
    two has a disparity, to it; and whose size in the image changes as their distance does.
    offset_px: the known error of all disparities, measured minus true.
    """
    rows, other_rows = (np.flatnonzero(k.point_id == NO_POINT) for k in (keyframe, other))
    i, j = _match_along_epipolar_lines(camera, keyframe, other, rows, other_rows)
    points, parallax = _midpoints(camera, keyframe, other, i, j)
    sound = (parallax > MIN_PARALLAX_RAD) & (parallax < MAX_PARALLAX_RAD)
    size = np.ones(len(i))
    for k, feature, sign in ((keyframe, i, 1), (other, j, -1)):
        sound &= _projects_to(camera, k, feature, points, offset_px)
        distance = np.linalg.norm(points - k.T_world_camera[:3, 3], axis=1)
        octave = k.features.octave[feature].astype(np.float64)
        size *= (np.maximum(distance, MIN_DEPTH_M) / PYRAMID_SCALE**-octave) ** sign
    sound &= np.abs(np.log(size)) < np.log(MAX_RANGE_RATIO * PYRAMID_SCALE)
    return NewPoints(i[sound], j[sound], points[sound])


def fundamental_matrix(camera: StereoCamera, a: KeyframeRecord, b: KeyframeRecord) -> Array:
    """Return F (3, 3) with x_a^T F x_b = 0 for the pixels of a point in the left images of two
    keyframes (Hartley and Zisserman, Multiple View Geometry, eq. 9.2).
    """
    T_a_b = a.T_camera_world @ b.T_world_camera
    x, y, z = T_a_b[:3, 3]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    K_inverse = np.linalg.inv(camera.K)
    return K_inverse.T @ cross @ T_a_b[:3, :3] @ K_inverse


def _match_along_epipolar_lines(
    camera: StereoCamera,
    keyframe: KeyframeRecord,
    other: KeyframeRecord,
    rows: NDArray[np.intp],
    other_rows: NDArray[np.intp],
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return feature rows of both keyframes that look alike and lie on each other's lines."""
    uv, uv_other = (
        np.column_stack([k.observations.uvd_px[r, :2], np.ones(len(r))])
        for k, r in ((keyframe, rows), (other, other_rows))
    )
    lines = uv_other @ fundamental_matrix(camera, keyframe, other).T
    distance_px = np.abs(uv @ lines.T) / np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-9)
    limit = MAX_EPIPOLAR_SIGMAS * keyframe.observations.sigma_px[rows, 1]
    octave, other_octave = (
        k.features.octave[r].astype(np.int32) for k, r in ((keyframe, rows), (other, other_rows))
    )
    near = (distance_px <= limit[:, None]) & (np.abs(octave[:, None] - other_octave) <= 1)
    i, j = np.nonzero(near)
    bits = hamming(keyframe.features.descriptor[rows[i]], other.features.descriptor[other_rows[j]])
    # A line crosses much of the image: only what looks very much alike, to be sure.
    alike = bits <= MAX_HAMMING // 2
    i, j = one_to_one(i[alike], j[alike], bits[alike])
    return rows[i], other_rows[j]


def _midpoints(
    camera: StereoCamera,
    keyframe: KeyframeRecord,
    other: KeyframeRecord,
    rows: NDArray[np.intp],
    other_rows: NDArray[np.intp],
) -> tuple[Array, Array]:
    """Return the points (N, 3) of frame world nearest to both rays, and the rays' angles (N,)."""
    centres, rays = [], []
    for k, r in ((keyframe, rows), (other, other_rows)):
        ray = camera.back_project(k.observations.uvd_px[r, :2], np.ones(len(r)))
        ray = ray @ k.T_world_camera[:3, :3].T
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
        centres.append(k.T_world_camera[:3, 3])
    cosine = (rays[0] * rays[1]).sum(axis=1)
    across = centres[1] - centres[0]
    b0, b1 = rays[0] @ across, rays[1] @ across
    determinant = np.maximum(1.0 - cosine**2, 1e-12)
    s0 = (b0 - cosine * b1) / determinant
    s1 = (cosine * b0 - b1) / determinant
    on_rays = (centres[0] + s0[:, None] * rays[0], centres[1] + s1[:, None] * rays[1])
    return (on_rays[0] + on_rays[1]) / 2, np.arccos(np.clip(cosine, -1.0, 1.0))


def _projects_to(
    camera: StereoCamera,
    keyframe: KeyframeRecord,
    rows: NDArray[np.intp],
    points: Array,
    offset_px: float,
) -> NDArray[np.bool_]:
    """Return whether points (N, 3) lie before a keyframe's camera and fit its features (N,)."""
    local = transform_points(keyframe.T_camera_world, points)
    front = local[:, 2] > MIN_DEPTH_M
    uvr = camera.project(np.where(front[:, None], local, (0.0, 0.0, 1.0)))
    predicted = np.column_stack([uvr[:, :2], uvr[:, 0] - uvr[:, 2]])
    seen = keyframe.observations.take(rows).without_offset(offset_px)
    residual = np.nan_to_num(predicted - seen.uvd_px, nan=0.0)
    chi2 = (residual**2 * seen.information).sum(axis=1)
    return np.asarray(front & (chi2 <= seen.chi2_limit))
