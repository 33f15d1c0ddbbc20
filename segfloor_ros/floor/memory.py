"""Where earlier keyframes have seen floor: a raster around the robot, fixed in the map.

It fills in what this keyframe cannot see, such as the left border that the right image does not
reach. Evidence against the floor wins: what stands up clears the cells below it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.floor.evidence import FloorView
from segfloor_ros.floor.observation import FLOOR, NO_EVIDENCE
from segfloor_ros.geometry import Array

CELL_M = 0.03
_SIZE = 512
_REACH_M = 4.0
_MOST_VOTES = 6
_ENOUGH_VOTES = 2
_BLOCKED = -2


class FloorMemory:
    """Votes for floor per cell of the map's x-y plane, within some metres of the robot."""

    def __init__(self) -> None:
        self._votes = np.zeros((_SIZE, _SIZE), np.int8)
        self._corner = np.full(2, -_SIZE // 2, np.int64)
        self._around = _cells_around()

    def fill(
        self, view: FloorView, mask: NDArray[np.uint8], T_map_base: Array
    ) -> NDArray[np.uint8]:
        """Return the mask (R, W) with floor where nothing is seen now and floor was before."""
        rows, columns = np.nonzero(mask == NO_EVIDENCE)
        x, y = view.floor_positions(rows, columns)
        near = np.hypot(x, y) < _REACH_M
        rows, columns = rows[near], columns[near]
        index, inside = self._index(_in_map(T_map_base, np.stack([x[near], y[near]], axis=1)))
        known = inside & (self._votes.reshape(-1)[index] >= _ENOUGH_VOTES)
        filled = mask.copy()
        filled[rows[known], columns[known]] = FLOOR
        return filled

    def learn(
        self,
        view: FloorView,
        mask: NDArray[np.uint8],
        obstacle_base: Array,
        T_map_base: Array,
    ) -> None:
        """Note the cells that are floor in the mask (R, W), and points (N, 2) that stand up."""
        self._follow(T_map_base[:2, 3])
        votes = self._votes.reshape(-1)
        seen = _floor_at(mask, view.pixels_of_floor(self._around))
        index, inside = self._index(_in_map(T_map_base, self._around[seen]))
        index = index[inside]
        votes[index] = np.minimum(votes[index] + 1, _MOST_VOTES)
        near = np.hypot(obstacle_base[:, 0], obstacle_base[:, 1]) < _REACH_M
        index, inside = self._index(_in_map(T_map_base, obstacle_base[near]))
        votes[index[inside]] = _BLOCKED

    def _index(self, xy_map: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        cell = np.floor(xy_map / CELL_M).astype(np.int64) - self._corner
        inside = ((cell >= 0) & (cell < _SIZE)).all(axis=1)
        return np.where(inside, cell[:, 1] * _SIZE + cell[:, 0], 0), inside

    def _follow(self, centre_map: Array) -> None:
        """Move the raster along when the robot comes near its border."""
        wanted = np.floor(centre_map / CELL_M).astype(np.int64) - _SIZE // 2
        dx, dy = (int(value) for value in wanted - self._corner)
        if max(abs(dx), abs(dy)) < _SIZE // 4:
            return
        moved = np.zeros_like(self._votes)
        if max(abs(dx), abs(dy)) < _SIZE:
            moved[max(0, -dy) : _SIZE - max(0, dy), max(0, -dx) : _SIZE - max(0, dx)] = self._votes[
                max(0, dy) : _SIZE - max(0, -dy), max(0, dx) : _SIZE - max(0, -dx)
            ]
        self._votes, self._corner = moved, wanted


def _cells_around() -> Array:
    """Return the centres (N, 2) of the cells within reach, relative to the robot."""
    steps = np.arange(-_REACH_M, _REACH_M, CELL_M) + CELL_M / 2
    x, y = np.meshgrid(steps, steps, indexing='ij')
    near = np.hypot(x, y) < _REACH_M
    return np.stack([x[near], y[near]], axis=1)


def _floor_at(mask: NDArray[np.uint8], pixels: Array) -> NDArray[np.bool_]:
    """Tell which of the pixels (N, 2) are floor in a mask (H, W)."""
    u, v = np.rint(pixels).astype(np.int64).T
    inside = (u >= 0) & (u < mask.shape[1]) & (v >= 0) & (v < mask.shape[0])
    return inside & (mask[np.where(inside, v, 0), np.where(inside, u, 0)] == FLOOR)


def _in_map(T_map_base: Array, xy_base: Array) -> Array:
    return xy_base @ T_map_base[:2, :2].T + T_map_base[:2, 3]
