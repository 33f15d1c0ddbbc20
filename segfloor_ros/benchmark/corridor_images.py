"""Stereo images of a drive through a textured corridor, by ray casting in NumPy: they need no
graphics library and look the same everywhere.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.benchmark.corridor import CAMERA, CEILING_M, HALF_WIDTH_M, MOUNT
from segfloor_ros.camera.model import StereoFrame
from segfloor_ros.geometry import Array, make_transform

STEP_M = 0.05
FRAME_PERIOD_NS = 100_000_000
SPARE_M = 5.0
"""From the last frame to the end wall, and from the wall behind to the first one."""
TEXELS_PER_M = 100
TEXELS = 1024
GREY, CONTRAST, NOISE_GREY = 128.0, 30.0, 1.5
FACES = 6


class CorridorImages:
    """Stereo frames of a drive straight ahead between two walls, floor, ceiling and end walls."""

    def __init__(self, frames: int, seed: int) -> None:
        self.frames = frames
        self._rng = np.random.default_rng(seed)
        self._texture = _texture(self._rng)
        self._shifts = self._rng.uniform(0, TEXELS, (FACES, 2))
        low = np.array([-SPARE_M, -HALF_WIDTH_M, 0.0], np.float32)
        high = np.array([frames * STEP_M + SPARE_M, HALF_WIDTH_M, CEILING_M], np.float32)
        # The base drives along x without turning, so the rays and the side they go to stay.
        v, u = np.indices((CAMERA.height, CAMERA.width), dtype=np.float64)
        uv = np.stack([u.ravel(), v.ravel()], axis=1)
        rays = CAMERA.back_project(uv, np.ones(len(uv))) @ MOUNT.T_base_left[:3, :3].T
        self._rays = rays.T.astype(np.float32)
        self._ends = np.where(self._rays > 0, high[:, None], low[:, None])

    def drive(self) -> Iterator[StereoFrame]:
        """Yield the frames in order."""
        to_right = make_transform(np.eye(3), np.array([CAMERA.baseline_m, 0.0, 0.0]))
        for index in range(self.frames):
            T_world_left = MOUNT.T_base_left.copy()
            T_world_left[0, 3] += index * STEP_M
            left = self._view(T_world_left[:3, 3])
            right = self._view((T_world_left @ to_right)[:3, 3])
            yield StereoFrame(index, (index + 1) * FRAME_PERIOD_NS, left, right)

    def _view(self, origin: Array) -> NDArray[np.uint8]:
        """Return the grey image (H, W) uint8 seen from a point."""
        start = origin.astype(np.float32)[:, None]
        with np.errstate(divide='ignore'):
            to_faces = (self._ends - start) / self._rays
        nearest = to_faces.min(axis=0)
        x, y, z = start + self._rays * nearest
        axis = to_faces.argmin(axis=0)
        beyond = np.take_along_axis(self._rays, axis[None], axis=0)[0] > 0
        shifts = (self._shifts / TEXELS_PER_M).astype(np.float32)[2 * axis + beyond]
        # A face across x shows y and z, one across y shows x and z, one across z x and y.
        first, second = np.where(axis == 0, y, x), np.where(axis == 2, y, z)
        shape = (CAMERA.height, CAMERA.width)
        image = cv2.remap(
            self._texture,
            ((first + shifts[:, 0]) * TEXELS_PER_M).reshape(shape),
            ((second + shifts[:, 1]) * TEXELS_PER_M).reshape(shape),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_WRAP,
        )
        image += NOISE_GREY * self._rng.standard_normal(shape, np.float32)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _texture(rng: np.random.Generator) -> NDArray[np.float32]:
    """Return grey values of fine and coarse blots, the same at opposite edges."""
    layers = []
    for deviation in (2.0, 8.0):
        noise = np.pad(rng.normal(size=(TEXELS, TEXELS)), 64, mode='wrap')
        layer = cv2.GaussianBlur(noise, (0, 0), deviation)[64:-64, 64:-64]
        layers.append(layer / layer.std())
    return (GREY + CONTRAST * (layers[0] + layers[1])).astype(np.float32)
