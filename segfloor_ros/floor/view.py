"""The pixels that can show floor, and where they look."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.profile import FloorLine

_WIDE_PX = 480
"""Of wider images every other column is used: neighbours say the same."""


@dataclass(frozen=True)
class FloorView:
    """The image rows that can show floor, as seen with the mount of this very frame.

    first_row: image row of the first one. step: of the columns. columns: (W,) float32, their
    image columns. shear_px: (W,) float32, what de-rolling adds to the rows of a column.
    derolled: (R, W) float32, the de-rolled rows. Pixels of the view are (row, column) of these.
    """

    camera: StereoCamera
    mount: Mount
    line: FloorLine
    first_row: int
    step: int
    columns: NDArray[np.float32]
    shear_px: NDArray[np.float32]
    derolled: NDArray[np.float32]

    @classmethod
    def of(cls, camera: StereoCamera, mount: Mount, first_row: int) -> FloorView:
        """Return the view from `mount` of the rows from `first_row` on."""
        line = FloorLine.of(camera, mount)
        step = column_step(camera)
        columns = np.arange(0, camera.width, step, dtype=np.float32)
        shear = (line.shear * (columns - camera.cx)).astype(np.float32)
        rows = np.arange(first_row, camera.height, dtype=np.float32)
        return cls(camera, mount, line, first_row, step, columns, shear, rows[:, None] + shear)

    def rays(self, rows: NDArray[np.integer], columns: NDArray[np.integer]) -> NDArray[np.float32]:
        """Return the rays (3, N) of pixels of the view at depth 1, in the base's axes."""
        camera = self.camera
        x = (self.columns[columns] - np.float32(camera.cx)) / np.float32(camera.fx)
        y = ((rows + (self.first_row - camera.cy)) / camera.fy).astype(np.float32)
        R = self.mount.T_base_left[:3, :3].astype(np.float32)
        return R[:, 0:1] * x + R[:, 1:2] * y + R[:, 2:3]

    def positions(
        self,
        rows: NDArray[np.integer],
        columns: NDArray[np.integer],
        disparity_px: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Return where pixels of known disparity (N,) are in the base's x-y plane, (2, N)."""
        depth = np.float32(self.camera.disparity_times_depth) / disparity_px
        offset = self.mount.T_base_left[:2, 3:4].astype(np.float32)
        return self.rays(rows, columns)[:2] * depth + offset

    def floor_positions(
        self, rows: NDArray[np.integer], columns: NDArray[np.integer]
    ) -> NDArray[np.float32]:
        """Return where the rays of pixels meet the floor's plane, (2, N) in the base's plane;
        very far where they do not.
        """
        rays = self.rays(rows, columns)
        depth = np.float32(self.mount.height_m) / np.maximum(-rays[2], np.float32(1e-5))
        return rays[:2] * depth + self.mount.T_base_left[:2, 3:4].astype(np.float32)

    def pixels_of_floor(self, xy_base: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the view's pixels, (2, N) of row and column, of positions (2, N) on the floor;
        negative where they are behind the camera.
        """
        camera = self.camera
        R_base_left = self.mount.T_base_left[:3, :3].astype(np.float32)
        t = self.mount.T_base_left[:3, 3].astype(np.float32)
        x, y = xy_base[0] - t[0], xy_base[1] - t[1]
        in_camera = R_base_left[0][:, None] * x + R_base_left[1][:, None] * y
        in_camera -= (R_base_left[2] * t[2])[:, None]
        depth = in_camera[2]
        behind = depth < 0.05
        depth = np.where(behind, np.float32(1), depth)
        v = in_camera[1] / depth * np.float32(camera.fy) + np.float32(camera.cy - self.first_row)
        u = in_camera[0] / depth * np.float32(camera.fx) + np.float32(camera.cx)
        pixels: NDArray[np.float32] = np.stack([v, u / np.float32(self.step)])
        pixels[:, behind] = -1
        return pixels


def column_step(camera: StereoCamera) -> int:
    """Return which columns of the image are used: every one, or every other."""
    return 2 if camera.width > _WIDE_PX else 1
