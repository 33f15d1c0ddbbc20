"""Where earlier keyframes have seen floor: a raster around the robot, fixed in the map.

It fills in what this keyframe cannot see, such as the left border that the right image does not
reach. Evidence against the floor wins: what stands up clears the cells below it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.floor.mask.runs import pixels_where
from segfloor_ros.floor.mask.view import FloorView
from segfloor_ros.floor.observation import FLOOR, NO_EVIDENCE
from segfloor_ros.geometry import Array

CELL_M = 0.03
_SIZE = 512
_REACH_M = 4.0
_MOST_VOTES = 6
_ENOUGH_VOTES = 2
_BLOCKED = -2
_UNSURE_ROWS = 3
_SWING = 0.15
"""So far, as a share of the focal length, the robot's pitch and roll may move the picture."""


class FloorMemory:
    """Votes for floor per cell of the map's x-y plane, within some metres of the robot."""

    def __init__(self) -> None:
        self._votes = np.zeros((_SIZE, _SIZE), np.int8)
        self._corner = np.full(2, -_SIZE // 2, np.int32)
        self._around: NDArray[np.float32] | None = None

    def fill(
        self,
        view: FloorView,
        mask: NDArray[np.uint8],
        open_: NDArray[np.bool_],
        T_map_base: Array,
    ) -> NDArray[np.uint8]:
        """Return the mask (R, W) with floor where nothing is seen now and floor was before.

        open_: (R, W), where that may be: remembered floor may lie behind what stands there now, a
        blank wall for one. What stands at the border of what only the left camera sees is taken
        to go on there.
        """
        nearest_row = _first_row_within_reach(view)
        rows, columns = pixels_where((mask[nearest_row:] == NO_EVIDENCE) & open_[nearest_row:])
        rows += nearest_row
        xy = view.floor_positions(rows, columns)
        index, inside = self._index(_in_map(T_map_base, xy))
        known = inside & (self._votes.reshape(-1)[index] >= _ENOUGH_VOTES)
        filled = mask.copy()
        filled[rows[known], columns[known]] = FLOOR
        return filled

    def learn(
        self,
        view: FloorView,
        mask: NDArray[np.uint8],
        upright_base: NDArray[np.float32],
        T_map_base: Array,
    ) -> None:
        """Note the cells that are floor in the mask (R, W), and points (2, N) that stand up."""
        self._follow(T_map_base[:2, 3])
        votes = self._votes.reshape(-1)
        if self._around is None:
            self._around = _cells_in_sight(view)
        seen = _floor_at(_within(mask), view.pixels_of_floor(self._around))
        index, inside = self._index(_in_map(T_map_base, self._around[:, seen]))
        index = index[inside]
        votes[index] = np.minimum(votes[index] + 1, _MOST_VOTES)
        index, inside = self._index(_in_map(T_map_base, upright_base))
        votes[index[inside]] = _BLOCKED

    def forget_floor(self) -> None:
        """Forget where floor was, but not what stands up."""
        np.minimum(self._votes, 0, out=self._votes)

    def forget_blocked(self) -> None:
        """Forget what stands up, but not where floor was."""
        np.maximum(self._votes, 0, out=self._votes)

    def _index(self, xy_map: NDArray[np.float32]) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
        cell = np.floor(xy_map * np.float32(1 / CELL_M)).astype(np.int32)
        column, row = cell[0] - self._corner[0], cell[1] - self._corner[1]
        inside = (column >= 0) & (column < _SIZE) & (row >= 0) & (row < _SIZE)
        return np.where(inside, row * _SIZE + column, 0), inside

    def _follow(self, centre_map: Array) -> None:
        """Move the raster along when the robot comes near its border."""
        wanted = np.floor(centre_map / CELL_M).astype(np.int32) - _SIZE // 2
        dx, dy = (int(value) for value in wanted - self._corner)
        if max(abs(dx), abs(dy)) < _SIZE // 4:
            return
        moved = np.zeros_like(self._votes)
        if max(abs(dx), abs(dy)) < _SIZE:
            moved[max(0, -dy) : _SIZE - max(0, dy), max(0, -dx) : _SIZE - max(0, dx)] = self._votes[
                max(0, dy) : _SIZE - max(0, -dy), max(0, dx) : _SIZE - max(0, -dx)
            ]
        self._votes, self._corner = moved, wanted


def _cells_in_sight(view: FloorView) -> NDArray[np.float32]:
    """Return the centres (2, N) of the cells within reach that the camera sees, relative to the
    robot; also those that it sees when the robot swings.
    """
    steps = np.arange(-_REACH_M, _REACH_M, CELL_M, dtype=np.float32) + np.float32(CELL_M / 2)
    x, y = np.meshgrid(steps, steps, indexing='ij')
    near = np.hypot(x, y) < _REACH_M
    cells = np.stack([x[near], y[near]])
    row, column = view.pixels_of_floor(cells)
    (rows, columns), swing = view.derolled.shape, _SWING * view.camera.fx
    in_sight = (row > -swing) & (row < rows + swing)
    in_sight &= (column > -swing) & (column < columns + swing)
    return cells[:, in_sight]


def _first_row_within_reach(view: FloorView) -> int:
    """Return the view's first row whose middle shows floor within reach."""
    rows = np.arange(len(view.derolled))
    distance = np.hypot(*view.floor_positions(rows, np.full(len(rows), len(view.columns) // 2)))
    return int(np.argmax(distance < _REACH_M)) if (distance < _REACH_M).any() else len(rows)


def _within(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the mask (R, W) without the last rows of floor before it ends, up the image: there
    it may have crept up what stands behind it, and far away a row is much floor.
    """
    upward = np.ones((_UNSURE_ROWS + 1, 1), np.uint8)
    return cv2.erode(mask, upward, anchor=(0, _UNSURE_ROWS))


def _floor_at(mask: NDArray[np.uint8], pixels: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Tell which of the pixels (2, N), row and column, are floor in a mask (R, W)."""
    row, column = np.rint(pixels).astype(np.int32)
    inside = (row >= 0) & (row < mask.shape[0]) & (column >= 0) & (column < mask.shape[1])
    return inside & (mask[np.where(inside, row, 0), np.where(inside, column, 0)] == FLOOR)


def _in_map(T_map_base: Array, xy_base: NDArray[np.float32]) -> NDArray[np.float32]:
    R = T_map_base[:2, :2].astype(np.float32)
    return R @ xy_base + T_map_base[:2, 3:4].astype(np.float32)
