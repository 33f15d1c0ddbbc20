"""A straight corridor of any length: what it looks like to the labelling and grid stages, worked
out by geometry, without images.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.observation import FLOOR, NO_EVIDENCE, NOT_FLOOR, FloorScan
from segfloor_ros.geometry import Array, invert, make_transform, transform_points
from segfloor_ros.pipeline import MapInput
from segfloor_ros.slam.results import KeyframeFeatures, KeyframePath, SparseCloud

HALF_WIDTH_M = 1.5
CEILING_M = 2.4
CAMERA = StereoCamera(640, 480, 320.0, 320.0, 319.5, 239.5, 0.12)
MOUNT = Mount(height_m=0.3, pitch_rad=0.12)

STRIDE_M = 0.25
"""Between two keyframes."""
POINTS_PER_M = 400
"""A hundred new points per keyframe, as in drives through rendered halls."""
SIGHT_M = 6.0
POINT_NOISE_M = 0.01
SCAN_STEP_RAD = 0.01
SCAN_RANGE_MAX_M = 8.0
CORRECTION_EVERY = 100
CORRECTION_RAD = 0.002
"""Every so many keyframes the whole map turns by so much, as after the closing of a loop."""
KEYFRAME_PERIOD_NS = 400_000_000


class Corridor:
    """Keyframes of a drive along a corridor. The same seed gives the same keyframes."""

    def __init__(self, keyframes: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.keyframes = keyframes
        self._points = _points(keyframes * STRIDE_M + SIGHT_M, rng)
        # As they lie in the map before and after a correction: what is handed out takes no memory.
        self._xyz_map = [
            transform_points(turn, self._points).astype(np.float32) for turn in _corrections()
        ]
        self._point_id = np.arange(len(self._points), dtype=np.int32)
        self._mask = floor_mask()
        self._scan_rng = rng

    def drive(self) -> Iterator[MapInput]:
        """Yield the keyframes in order; the cloud and the path grow with each."""
        stamp_ns = np.arange(1, self.keyframes + 1, dtype=np.int64) * KEYFRAME_PERIOD_NS
        T_world_base = np.tile(np.eye(4), (self.keyframes, 1, 1))
        T_world_base[:, 0, 3] = np.arange(self.keyframes) * STRIDE_M
        for index in range(self.keyframes):
            turned = index // CORRECTION_EVERY % 2
            path = _corrections()[turned] @ T_world_base[: index + 1]
            x_m = index * STRIDE_M
            known = int(np.searchsorted(self._points[:, 0], x_m + SIGHT_M))
            first = int(np.searchsorted(self._points[:, 0], x_m))
            xyz_map = self._xyz_map[turned][:known]
            yield MapInput(
                int(stamp_ns[index]),
                self._features(first, T_world_base[index], xyz_map),
                KeyframePath(stamp_ns[: index + 1], path),
                SparseCloud(self._point_id[:known], xyz_map),
                self._mask,
                self._scan(),
            )

    def _features(
        self, first: int, T_world_base: Array, xyz_map: NDArray[np.float32]
    ) -> KeyframeFeatures:
        """Return the points from `first` on that lie in the image."""
        T_left_world = invert(T_world_base @ MOUNT.T_base_left)
        in_left = transform_points(T_left_world, self._points[first : len(xyz_map)])
        ahead = np.flatnonzero(in_left[:, 2] > 0.2)
        uv = CAMERA.project(in_left[ahead])[:, :2]
        inside = ((uv >= 0) & (uv <= (CAMERA.width - 1, CAMERA.height - 1))).all(axis=1)
        point_id = (first + ahead[inside]).astype(np.int32)
        return KeyframeFeatures(uv[inside].astype(np.float32), point_id, xyz_map[point_id])

    def _scan(self) -> FloorScan:
        """Return how far the floor goes per bearing: to the walls, or as far as sight."""
        half = np.arctan(0.5 * CAMERA.width / CAMERA.fx)
        bearings = np.arange(-half, half, SCAN_STEP_RAD)
        wall_m = HALF_WIDTH_M / np.maximum(np.abs(np.sin(bearings)), 1e-6)
        wall_m += self._scan_rng.normal(scale=POINT_NOISE_M, size=len(bearings))
        in_sight = wall_m < SIGHT_M
        return FloorScan(
            float(bearings[0]),
            SCAN_STEP_RAD,
            np.minimum(wall_m, SIGHT_M).astype(np.float32),
            np.where(in_sight, wall_m, np.nan).astype(np.float32),
            SCAN_RANGE_MAX_M,
        )


def floor_mask() -> NDArray[np.uint8]:
    """Return the floor mask (H, W) uint8 that every keyframe in the corridor has."""
    v, u = np.indices((CAMERA.height, CAMERA.width), dtype=np.float64)
    rays = CAMERA.back_project(np.stack([u.ravel(), v.ravel()], axis=1), np.ones(u.size))
    directions = rays @ MOUNT.T_base_left[:3, :3].T
    down = np.maximum(-directions[:, 2], 1e-9)
    forward_m, left_m = (directions[:, :2] * (MOUNT.height_m / down)[:, None]).T
    mask = np.where(np.abs(left_m) < HALF_WIDTH_M, FLOOR, NOT_FLOOR).astype(np.uint8)
    mask[(forward_m > SIGHT_M) & (mask == FLOOR)] = NO_EVIDENCE
    return mask.reshape(u.shape)


def _points(length_m: float, rng: np.random.Generator) -> Array:
    """Return map points (N, 3) on floor and walls, in the order in which they come into sight."""
    count = round(length_m * POINTS_PER_M)
    x = np.sort(rng.uniform(0.0, length_m, count))
    on_floor = rng.random(count) < 0.5
    side = np.where(rng.random(count) < 0.5, HALF_WIDTH_M, -HALF_WIDTH_M)
    y = np.where(on_floor, rng.uniform(-HALF_WIDTH_M, HALF_WIDTH_M, count), side)
    z = np.where(on_floor, 0.0, rng.uniform(0.05, 1.5, count))
    noise = rng.normal(scale=POINT_NOISE_M, size=(count, 2))
    return np.stack([x, y + noise[:, 0], z + noise[:, 1]], axis=1)


def _corrections() -> Array:
    """Return the two ways in which the map lies in turns, (2, 4, 4)."""
    c, s = np.cos(CORRECTION_RAD), np.sin(CORRECTION_RAD)
    turn = make_transform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
    return np.stack([np.eye(4), turn])
