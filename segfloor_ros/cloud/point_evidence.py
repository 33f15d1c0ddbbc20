"""What speaks for floor (negative) and for an obstacle (positive)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.cloud.settings import CloudLabellingSettings
from segfloor_ros.floor.observation import FLOOR, NOT_FLOOR
from segfloor_ros.geometry import Array, invert, transform_points


def mask_evidence(mask: NDArray[np.uint8], uv_px: NDArray[np.float32]) -> Array:
    """Return -1 for floor, +1 for not floor and 0 for neither at pixels (N, 2) of a mask (H, W).

    A pixel on the border of floor and not floor says nothing: corners lie on such borders, and
    the mask is not exact to the pixel.
    """
    rows, columns = mask.shape
    u = np.clip(np.rint(uv_px[:, 0]), 0, columns - 1).astype(np.intp)
    v = np.clip(np.rint(uv_px[:, 1]), 0, rows - 1).astype(np.intp)
    offsets = np.arange(-1, 2)
    near_v = np.clip(v[:, None] + np.repeat(offsets, 3), 0, rows - 1)
    near_u = np.clip(u[:, None] + np.tile(offsets, 3), 0, columns - 1)
    near = mask[near_v, near_u]
    floor, upright = (near == FLOOR).any(axis=1), (near == NOT_FLOOR).any(axis=1)
    centre = mask[v, u]
    evidence = np.where(centre == FLOOR, -1.0, np.where(centre == NOT_FLOOR, 1.0, 0.0))
    return np.where(floor & upright, 0.0, evidence)


def local_floor_m(xyz_map: Array, T_map_base: Array) -> tuple[Array, Array]:
    """Return the height (N,) of the floor, the base's plane, below points (N, 3), and the distances
    (N,) of the points from the base in metres.
    """
    in_base = transform_points(invert(T_map_base), xyz_map)
    return xyz_map[:, 2] - in_base[:, 2], np.hypot(in_base[:, 0], in_base[:, 1])


def height_evidence(height_m: Array, sigma_m: Array, settings: CloudLabellingSettings) -> Array:
    """Return the log-odds (N,) of an obstacle from heights (N,) above the floor.

    Floor lies at 0, obstacles anywhere above the step: the log of the ratio of the two Gaussian
    tails, which is close to linear in the distance from the middle of the step.
    """
    log_odds = (height_m - settings.step_height_m) / sigma_m
    limit = settings.max_height_log_odds
    return np.clip(log_odds, -limit, limit)
