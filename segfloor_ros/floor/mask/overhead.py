"""What stands or hangs in the robot's way above the horizon, where there is no floor to be seen.

Boards and table tops end a robot's way although the floor goes on below them, and a wall that is
blank near the floor may have something to be seen higher up. Half the resolution is enough for
that.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.depth import shrunk
from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.disparity.matching import SPECKLE_PX, DisparityMatcher
from segfloor_ros.floor.disparity.photometric import texture_grey
from segfloor_ros.floor.settings import FloorSegmentationSettings
from segfloor_ros.geometry import Array, transform_points

_SCALE = 2
_STEP = 16
_NEAREST_M = 0.5
"""What is nearer than this has been seen before."""
_MIN_ROWS = 16
_BLOCK_PX = 3
_SAME_SURFACE_SHARE = 0.06
_TEXTURE_WINDOW_PX = 7
_BOARD_SHARE = 0.04
"""So much of a board must have texture of its own: its ends have."""


class OverheadMatcher:
    """Finds surfaces above the horizon and below the robot's height."""

    def __init__(
        self, camera: StereoCamera, num_disparities: int, settings: FloorSegmentationSettings
    ) -> None:
        self._camera, self._settings = camera, settings
        nearest_px = min(num_disparities, camera.disparity_times_depth / _NEAREST_M)
        searched = math.ceil(nearest_px / (_SCALE * _STEP)) * _STEP
        self._matcher = DisparityMatcher(searched, _BLOCK_PX, SPECKLE_PX // _SCALE**2)

    def positions(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        mount: Mount,
        horizon_row: int,
        min_texture_grey: float,
        moving: NDArray[np.uint8] | None = None,
        measured: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """Return where in the base's x-y plane something is in the way, (2, N), by the rows above
        `horizon_row` of a rectified pair (H, W); every fourth pixel at most tells.

        mount: of this frame. min_texture_grey: what a disparity needs to mean something. moving:
        mask (H, W), 255 where what stands there moves and does not count. measured: disparity
        (H, W) of a depth camera.
        """
        camera = self._camera
        reach = (self._settings.robot_height_m - mount.height_m) / _NEAREST_M * camera.fy
        first = max(0, horizon_row - int(max(reach, 0.0))) // _SCALE * _SCALE
        last = first + (horizon_row - first) // _SCALE * _SCALE
        if last - first < _MIN_ROWS:
            return np.zeros((2, 0), np.float32)
        size = (camera.width // _SCALE, (last - first) // _SCALE)
        halves = [
            cv2.resize(image[first:last], size, interpolation=cv2.INTER_AREA)
            for image in (left, right)
        ]
        if measured is None:
            disparity = self._matcher.compute(halves[0], halves[1])
            # A slope along the row gets steeper as the image gets smaller.
            textured = texture_grey(halves[0], _TEXTURE_WINDOW_PX) > _SCALE * min_texture_grey
            known = (disparity > 0) & ~_fringes(disparity)
            telling = _with_boards(disparity, known, known & textured)
        else:
            disparity = shrunk(measured[first:last], size)
            telling = disparity > 0
        if moving is not None:
            telling &= cv2.resize(moving[first:last], size, interpolation=cv2.INTER_NEAREST) == 0
        rows, columns = np.nonzero(telling)
        disparity_px = _SCALE * disparity[rows, columns].astype(np.float64)
        centre = 0.5 * (_SCALE - 1)
        uv_px = np.stack([_SCALE * columns + centre, _SCALE * rows + first + centre], axis=1)
        return self._in_the_way(uv_px, disparity_px, mount)

    def _in_the_way(self, uv_px: Array, disparity_px: Array, mount: Mount) -> NDArray[np.float32]:
        """Return those of the pixels (N, 2) as positions (2, M) whose height concerns the robot."""
        camera, settings = self._camera, self._settings
        depth_m = camera.disparity_times_depth / disparity_px
        in_base = transform_points(mount.T_base_left, camera.back_project(uv_px, depth_m))
        height_m = in_base[:, 2]
        way = (height_m > settings.step_height_m) & (height_m < settings.robot_height_m)
        return in_base[way, :2].T.astype(np.float32)


def _with_boards(
    disparity: NDArray[np.float32], known: NDArray[np.bool_], telling: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return what tells (H, W) where to `telling` comes all of a board: above and below it
    something farther is seen. known: where the disparity counts.

    The edge and the grain of a board run along the rows and match anywhere. Its ends do not, and
    the matching carries their disparity along the board.
    """
    near = disparity * np.float32(1 - _SAME_SURFACE_SHARE)
    farther = np.where(disparity > 0, disparity, np.float32(np.inf))
    board = known & (np.minimum.accumulate(farther, axis=0) < near)
    board &= np.minimum.accumulate(farther[::-1], axis=0)[::-1] < near
    for axis in (0, 1):
        step = np.abs(np.diff(disparity, axis=axis, prepend=0))
        board &= step <= _SAME_SURFACE_SHARE * np.maximum(disparity, 1)
    count, label = cv2.connectedComponents(board.astype(np.uint8), connectivity=4)
    size = np.bincount(label[board], minlength=count)
    share = np.bincount(label[board & telling], minlength=count) / np.maximum(size, 1)
    found: NDArray[np.bool_] = telling | (board & (share >= _BOARD_SHARE)[label])
    return found


def _fringes(disparity: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Tell which pixels (H, W) have a farther neighbour in their row: there the block that is
    matched still holds the nearer surface, which makes things wider than they are.
    """
    known = np.where(disparity > 0, disparity, np.float32(np.inf))
    farthest = cv2.erode(known, np.ones((1, 3), np.uint8))
    return farthest < disparity * np.float32(1 - _SAME_SURFACE_SHARE)
