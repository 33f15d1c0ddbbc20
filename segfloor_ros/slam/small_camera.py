"""The camera of the shrunk images in which what moves is searched."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array, transform_points
from segfloor_ros.slam.residuals import MIN_DEPTH_M

WIDTH_PX = 160
"""Images are shrunk to about this width: a person 4 m away is still eight pixels wide."""

TOLERANCE_PX = 0.6
"""Disparities of the shrunk images that differ by more do not show the same thing."""

Disparity = NDArray[np.float32]
"""Disparities (h, w) in px of the shrunk image, 0 where none was found."""


class SmallCamera:
    """Projects between the shrunk image and the left optical frame.

    factor: pixels of the camera per pixel here. size: (w, h). focal, centre: (2,) px.
    disparity_m: disparity times depth. rays: (3, h w), the points of all pixels at one metre.
    """

    def __init__(self, camera: StereoCamera) -> None:
        self.factor = factor = max(1, round(camera.width / WIDTH_PX))
        self.size = (camera.width // factor, camera.height // factor)
        self.disparity_m = camera.disparity_times_depth / factor
        self.focal = np.array([camera.fx, camera.fy]) / factor
        self.centre = (np.array([camera.cx, camera.cy]) + 0.5) / factor - 0.5
        u, v = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in self.size))
        full_u, full_v = ((axis + 0.5) * factor - 0.5 for axis in (u, v))
        rays = [(full_u - camera.cx) / camera.fx, (full_v - camera.cy) / camera.fy, np.ones_like(u)]
        self.rays = np.stack(rays).reshape(3, -1).astype(np.float32)

    def contains(self, uv: Array) -> NDArray[np.bool_]:
        """Return which pixels (N, 2) lie in the image."""
        at = np.rint(np.nan_to_num(uv, nan=-1.0, posinf=-1.0, neginf=-1.0))
        return np.asarray((at >= 0).all(axis=1) & (at < self.size).all(axis=1))

    def at(self, image: NDArray[Any], uv: Array) -> Array:
        """Return the values (N,) of an image (h, w) at pixels (N, 2), 0 outside."""
        inside = self.contains(uv)
        u, v = np.where(inside[:, None], np.rint(uv), 0).astype(np.intp).T
        return np.where(inside, image[v, u], 0.0).astype(np.float64)

    def carried(self, uv: Array, disparity: Array, T_then_now: Array) -> Array:
        """Return pixel and disparity (N, 3) that points have in another image; the disparity is 0
        behind the camera.
        """
        depth = self.disparity_m / disparity
        points = np.column_stack([(uv - self.centre) / self.focal * depth[:, None], depth])
        there = transform_points(T_then_now, points)
        front = there[:, 2] > MIN_DEPTH_M
        z = np.where(front, there[:, 2], 1.0)
        pixel = self.focal * there[:, :2] / z[:, None] + self.centre
        return np.column_stack([pixel, np.where(front, self.disparity_m / z, 0.0)])
