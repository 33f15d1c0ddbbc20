"""Where earlier keyframes have seen floor: a raster around the robot, fixed in the map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.floor.observation import FLOOR
from segfloor_ros.geometry import Array

CELL_M = 0.03
_SIZE = 512
REACH_M = 4.0
_MOST_VOTES = 6
_ENOUGH_VOTES = 2
_BLOCKED = -2


class FloorMemory:
    """Votes for floor per cell of the map's x-y plane, within some metres of the robot."""

    def __init__(self) -> None:
        self._votes = np.zeros((_SIZE, _SIZE), np.int8)
        self._corner = np.full(2, -_SIZE // 2, np.int64)

    def recall(self, xy_map: Array) -> NDArray[np.bool_]:
        """Tell for positions (N, 2) in the map whether they were seen to be floor before."""
        index, inside = self._index(xy_map)
        known = np.zeros(len(xy_map), np.bool_)
        known[inside] = self._votes.reshape(-1)[index[inside]] >= _ENOUGH_VOTES
        return known

    def learn(self, floor_map: Array, obstacle_map: Array, centre_map: Array) -> None:
        """Note cells seen as floor and points that stand up, (N, 2) each, in the map."""
        self._follow(centre_map)
        votes = self._votes.reshape(-1)
        index, inside = self._index(floor_map)
        index = index[inside]
        votes[index] = np.minimum(votes[index] + 1, _MOST_VOTES)
        index, inside = self._index(obstacle_map)
        votes[index[inside]] = _BLOCKED

    def _index(self, xy_map: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        cell = np.floor(xy_map / CELL_M).astype(np.int64) - self._corner
        inside = ((cell >= 0) & (cell < _SIZE)).all(axis=1)
        return cell[:, 1] * _SIZE + cell[:, 0], inside

    def _follow(self, centre_map: Array) -> None:
        """Move the raster along when the robot comes near its border."""
        wanted = np.floor(centre_map / CELL_M).astype(np.int64) - _SIZE // 2
        shift = wanted - self._corner
        if np.abs(shift).max() * CELL_M < 0.25 * _SIZE * CELL_M:
            return
        moved = np.zeros_like(self._votes)
        if np.abs(shift).max() < _SIZE:
            dx, dy = (int(value) for value in shift)
            target = moved[max(0, -dy) : _SIZE - max(0, dy), max(0, -dx) : _SIZE - max(0, dx)]
            target[:] = self._votes[
                max(0, dy) : _SIZE - max(0, -dy), max(0, dx) : _SIZE - max(0, -dx)
            ]
        self._votes, self._corner = moved, wanted


def cells_around() -> Array:
    """Return the centres (N, 2) of the cells within reach, relative to the robot."""
    steps = np.arange(-REACH_M, REACH_M, CELL_M) + CELL_M / 2
    x, y = np.meshgrid(steps, steps, indexing='ij')
    near = np.hypot(x, y) < REACH_M
    return np.stack([x[near], y[near]], axis=1)


def floor_at(mask: NDArray[np.uint8], pixels: Array) -> NDArray[np.bool_]:
    """Tell which of the pixels (N, 2) are floor in a mask (H, W)."""
    u, v = np.rint(pixels).astype(np.int64).T
    inside = (u >= 0) & (u < mask.shape[1]) & (v >= 0) & (v < mask.shape[0])
    floor = np.zeros(len(pixels), np.bool_)
    floor[inside] = mask[v[inside], u[inside]] == FLOOR
    return floor
