"""Which map points a camera at a given pose should see, and where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array, transform_points
from segfloor_ros.slam.excluded import Region, is_inside
from segfloor_ros.slam.features import PYRAMID_LEVELS, PYRAMID_SCALE
from segfloor_ros.slam.residuals import MIN_DEPTH_M
from segfloor_ros.slam.sparse_map import SparseMap

MIN_VIEW_COSINE = 0.5
"""A point is recognised up to 60 degrees from the direction it was last seen from."""


@dataclass(frozen=True)
class Prediction:
    """Map points expected in the image: ids (N,), pixel and disparity (N, 3), pyramid level
    (N,).
    """

    ids: NDArray[np.int32]
    uvd_px: Array
    octave: Array

    def take(self, rows: NDArray[np.intp]) -> Prediction:
        """Return the chosen rows."""
        return Prediction(self.ids[rows], self.uvd_px[rows], self.octave[rows])


def predict_points(
    camera: StereoCamera,
    sparse_map: SparseMap,
    ids: NDArray[np.int32],
    T_camera_world: Array,
    excluded: Region | None = None,
) -> Prediction:
    """Project points (N,) into the image and keep those that a camera there should recognise:
    inside the image, from about the known direction, at a size the pyramid has, and not in a region
    that is excluded.
    """
    points = transform_points(T_camera_world, sparse_map.xyz_world[ids])
    front = points[:, 2] > MIN_DEPTH_M
    ids, points = ids[front], points[front]
    uvr = camera.project(points)
    distance = np.sqrt((points**2).sum(axis=1))
    direction = points @ T_camera_world[:3, :3] / distance[:, None]
    cosine = (direction * sparse_map.viewing_direction[ids]).sum(axis=1)
    zoom = np.log(sparse_map.viewing_distance_m[ids] / distance)
    octave = sparse_map.viewing_octave[ids] + zoom / np.log(PYRAMID_SCALE)
    visible = (
        (uvr[:, 0] >= 0)
        & (uvr[:, 0] < camera.width)
        & (uvr[:, 1] >= 0)
        & (uvr[:, 1] < camera.height)
        & (cosine > MIN_VIEW_COSINE)
        & (octave > -1.5)
        & (octave < PYRAMID_LEVELS + 0.5)
    )
    uvd = np.stack([uvr[:, 0], uvr[:, 1], uvr[:, 0] - uvr[:, 2]], axis=1)
    visible[visible] = ~is_inside(excluded, uvr[visible, :2])
    return Prediction(ids[visible], uvd[visible], octave[visible])
