"""The pixels that can show floor, where they look, and their v-disparity without what is upright.

Labayrade, Aubert, Tarel, Real Time Obstacle Detection in Stereovision on Non Flat Road Geometry
Through V-disparity Representation (2002); Hu, Uchimura, U-V-Disparity (2005).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.images import SUBPIXEL
from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.disparity.matching import SAME_PX
from segfloor_ros.floor.disparity.profile import FloorLine, FloorProfile
from segfloor_ros.floor.observation import VDisparity

_WIDE_PX = 480
"""Of wider images every other column is used: neighbours say the same."""

STEP_PX = 2
"""Every so many pixels of the image, in rows and columns, are compared, and filled, alike."""
_NEAR_M, _FAR_M = 0.05, 1000.0
"""Depths are between these."""

_OBSTACLE_M = 0.2
"""An upright surface of this height is taken out before the profile is fitted."""
_RISE_TOLERANCE = 0.75


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

    @cached_property
    def plane_px(self) -> NDArray[np.float32]:
        """Disparity (R, W) of a floor that does not bend."""
        return np.float32(self.line.slope) * (self.derolled - np.float32(self.line.horizon))

    def rays(self, rows: NDArray[np.number], columns: NDArray[np.integer]) -> NDArray[np.float32]:
        """Return the rays (3, N) of pixels of the view at depth 1, in the base's axes."""
        camera = self.camera
        x = (self.columns[columns] - np.float32(camera.cx)) / np.float32(camera.fx)
        y = ((rows + (self.first_row - camera.cy)) / camera.fy).astype(np.float32)
        R = self.mount.T_base_left[:3, :3].astype(np.float32)
        return R[:, 0:1] * x + R[:, 1:2] * y + R[:, 2:3]

    def positions(
        self,
        rows: NDArray[np.number],
        columns: NDArray[np.integer],
        disparity_px: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Return where pixels of known disparity (N,) are in the base's x-y plane, (2, N)."""
        depth = np.float32(self.camera.disparity_times_depth) / disparity_px
        offset = self.mount.T_base_left[:2, 3:4].astype(np.float32)
        return self.rays(rows, columns)[:2] * depth + offset

    def pixels_of_profile(
        self, xy_base: NDArray[np.float32], profile: FloorProfile
    ) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
        """Return the view's rows and columns (N,) of positions (2, N) on the floor as it bends,
        and its disparity there (N,); negative columns where they are behind the camera.
        """
        x, _, depth = self._in_camera(xy_base)
        camera = self.camera
        disparity = np.float32(camera.disparity_times_depth) / depth
        u = x / depth * np.float32(camera.fx) + np.float32(camera.cx)
        steps = np.arange(0, int(disparity.max() * SUBPIXEL) + 2)
        row_of = profile.row_of_disparity(steps / SUBPIXEL).astype(np.float32)
        derolled = row_of[(disparity * np.float32(SUBPIXEL) + np.float32(0.5)).astype(np.int32)]
        v = derolled - np.float32(self.line.shear) * (u - np.float32(camera.cx)) - self.first_row
        columns = np.rint(u / np.float32(self.step))
        columns[depth > _FAR_M] = -1
        return np.rint(v).astype(np.int32), columns.astype(np.int32), disparity

    def _in_camera(
        self, xy_base: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Return positions (2, N) on the floor's plane in the camera's axes, very far ahead where
        they are behind it.
        """
        R_base_left = self.mount.T_base_left[:3, :3].astype(np.float32)
        t = self.mount.T_base_left[:3, 3].astype(np.float32)
        dx, dy = xy_base[0] - t[0], xy_base[1] - t[1]
        x, y, depth = (
            R_base_left[0, i] * dx + R_base_left[1, i] * dy - R_base_left[2, i] * t[2]
            for i in range(3)
        )
        return x, y, np.where(depth < _NEAR_M, np.float32(2 * _FAR_M), depth)


def column_step(camera: StereoCamera) -> int:
    """Return which columns of the image are used: every one, or every other."""
    return 2 if camera.width > _WIDE_PX else 1


def surface_above(
    disparity: NDArray[np.float32],
    counted: NDArray[np.float32],
    window_px: tuple[int, int],
    gap_rows: int,
) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
    """Return mean and variance of the disparities (R, W) of what stands right above each pixel, and
    the share of it that counts, each (R, W).

    counted: 1 where a disparity counts, else 0. window_px: columns and rows of the surface, which
    ends `gap_rows` above the pixel: below that the matcher mixes it with what it stands on.
    """
    columns, rows = window_px

    def mean_above(values: NDArray[np.float32]) -> NDArray[np.float32]:
        above = np.zeros_like(values)
        above[gap_rows:] = cv2.blur(values, window_px, anchor=(columns // 2, rows - 1))[:-gap_rows]
        return above

    share = mean_above(counted)
    safe = np.maximum(share, np.float32(1e-6))
    mean = mean_above(counted * disparity) / safe
    return mean, mean_above(counted * disparity**2) / safe - mean**2, share


def u_disparity(bins: NDArray[np.intp], num_bins: int) -> NDArray[np.intp]:
    """Return how often each disparity bin occurs per column, (num_bins, W).

    bins: (H, W) disparity bin per pixel; bin 0 is `no match` and stays 0.
    """
    width = bins.shape[1]
    counts = np.bincount((bins * width + np.arange(width)).ravel(), minlength=num_bins * width)
    counts = counts[: num_bins * width].reshape(num_bins, width)
    counts[0] = 0
    return counts


def obstacle_rows(
    disparity_px: NDArray[np.floating] | NDArray[np.integer],
    height_m: float,
    rows_per_m_px: float,
    floor_rows_per_px: float,
) -> NDArray[np.float64]:
    """Return the count at which a u-disparity cell is an obstacle, per disparity.

    An upright surface of `height_m` covers `height_m * rows_per_m_px * d` rows (with
    rows_per_m_px = fy / (fx * baseline)). The floor itself puts `floor_rows_per_px` rows into
    each bin of one pixel, so the threshold never falls below twice that.
    """
    return np.maximum(height_m * rows_per_m_px * disparity_px, 2 * floor_rows_per_px + 2)


def v_disparity(
    rows: NDArray[np.intp], bins: NDArray[np.intp], shape: tuple[int, int]
) -> NDArray[np.intp]:
    """Return how often each disparity bin occurs per row, `shape` = (rows, bins).

    rows, bins: (N,) of the pixels that count.
    """
    index = rows * shape[1] + bins
    return np.bincount(index, minlength=shape[0] * shape[1])[: shape[0] * shape[1]].reshape(shape)


def rising(disparity: NDArray[np.float32], slope: float) -> NDArray[np.bool_]:
    """Tell where disparities (R, W) rise down the image as those of a floor do, (R, W).

    They are compared over as many rows as it takes a floor to rise by more than noise.

    slope: of a level floor, in pixels per row. Upright surfaces do not rise; nor does floor of
    little texture, where semi-global matching prefers level steps.
    """
    half = math.ceil(SAME_PX / slope / 2)
    rise = np.zeros_like(disparity)
    rise[half:-half] = disparity[2 * half :] - disparity[: -2 * half]
    return is_rise(rise / np.float32(2 * half), slope)


def is_rise(rise: NDArray[np.floating], slope: float) -> NDArray[np.bool_]:
    """Tell which of how much disparities grow per row are, more or less, a floor's `slope`."""
    return np.abs(rise / slope - 1) < _RISE_TOLERANCE


def filtered_v_disparity(
    view: FloorView,
    disparity: NDArray[np.float32],
    textured: NDArray[np.bool_],
    num_disparities: int,
    bins_per_px: int,
) -> VDisparity:
    """Return the v-disparity of what is textured and not upright."""
    camera = view.camera
    # Half of the columns tell as much.
    disparity = np.ascontiguousarray(disparity[:, ::2])
    # What is nearer than any floor counts as if it were right before it: measured depth has no end.
    nearest = np.float32(num_disparities)
    disparity = np.minimum(disparity, nearest)
    bins = (disparity + np.float32(0.5)).astype(np.intp)
    num = num_disparities + 1
    limit = obstacle_rows(
        np.arange(num),
        _OBSTACLE_M,
        camera.fy / (camera.fx * camera.baseline_m),
        1 / view.line.slope,
    )
    upright = u_disparity(bins, num) > limit[:, None]
    width = bins.shape[1]
    keep = (disparity > 0) & textured[:, ::2] & rising(disparity, view.line.slope)
    keep &= ~upright.take(bins * width + np.arange(width))
    at = np.flatnonzero(keep)
    rows, columns = np.divmod(at.astype(np.int32), np.int32(width))
    derolled = view.derolled[:, 0].take(rows) + (view.shear_px[::2] - view.shear_px[0]).take(
        columns
    )
    first = math.floor(float(view.derolled.min()))
    last = math.ceil(float(view.derolled.max()))
    rows = (derolled - np.float32(first - 0.5)).astype(np.intp)
    fine = (disparity.take(at) * np.float32(bins_per_px) + np.float32(0.5)).astype(np.intp)
    counts = v_disparity(rows, fine, (last - first + 1, num * bins_per_px))
    return VDisparity(counts * (2 * view.step), first, bins_per_px)
