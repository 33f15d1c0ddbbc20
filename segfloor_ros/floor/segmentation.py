"""The floor segmentation stage: a rectified stereo pair in, the floor out."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.disparity import SUBPIXEL, DisparityMatcher, disparity_range
from segfloor_ros.floor.histograms import obstacle_rows, u_disparity, v_disparity
from segfloor_ros.floor.observation import (
    FLOOR,
    NO_EVIDENCE,
    NOT_FLOOR,
    FloorObservation,
    FloorScan,
)
from segfloor_ros.floor.profile import FloorLine, FloorProfile, fit_profile
from segfloor_ros.floor.scan import ScanGeometry, make_scan
from segfloor_ros.floor.settings import FloorSegmentationSettings
from segfloor_ros.geometry import Array

_BINS_PER_PX = 4
_CONTACT_HEIGHT_M = 0.12
"""Up to this height an upright surface is taken to stand on the floor below it."""


@dataclass(frozen=True)
class _View:
    """What depends on camera and mount alone, for the rows that can show floor."""

    matcher: DisparityMatcher
    line: FloorLine
    scan: ScanGeometry
    first_row: int
    derolled: NDArray[np.float32]
    column: NDArray[np.intp]


class FloorSegmentation:
    """Finds the floor in rectified stereo pairs of one camera."""

    def __init__(self, camera: StereoCamera, settings: FloorSegmentationSettings) -> None:
        self._camera = camera
        self._settings = settings
        self._views: dict[Mount, _View] = {}

    def process(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        mount: Mount,
        T_map_base: Array | None = None,
    ) -> FloorObservation:
        """Return the floor of a rectified grey pair (H, W) uint8.

        mount: where the left camera sits above the floor. T_map_base: pose (4, 4) of the base in
        the map, where known.
        """
        view = self._view(mount)
        disparity = self._disparity(view, left, right)
        below = disparity[view.first_row :]
        profile = self._profile(view, below)
        height = self._heights(view, profile, below)
        mask = self._evidence(view, profile, below, height)
        mask = self._fill(view, profile, mask)
        scan = self._scan(view, mount, profile, below, height, mask)
        whole = np.full(disparity.shape, NOT_FLOOR, np.uint8)
        whole[view.first_row :] = mask
        return FloorObservation(
            disparity_px=disparity,
            mask=whole,
            profile_px=profile.at_rows(np.arange(self._camera.height)),
            scan=scan,
            min_disparity_px=0.0,
            max_disparity_px=float(view.matcher.num_disparities),
        )

    def _view(self, mount: Mount) -> _View:
        if mount not in self._views:
            self._views = {mount: self._make_view(mount)}
        return self._views[mount]

    def _make_view(self, mount: Mount) -> _View:
        camera, settings = self._camera, self._settings
        line = FloorLine.of(camera, mount)
        columns = np.arange(camera.width)
        shear = line.shear * (columns - camera.cx)
        first = int(np.clip(np.floor(line.horizon - shear.max()), 0, camera.height - 16))
        rows = np.arange(first, camera.height)
        derolled = (rows[:, None] + shear[None, :]).astype(np.float32)
        searched = settings.num_disparities or disparity_range(camera, mount)
        return _View(
            matcher=DisparityMatcher(-(-searched // 16) * 16, settings),
            line=line,
            scan=ScanGeometry(camera, mount, settings),
            first_row=first,
            derolled=derolled,
            column=columns,
        )

    def _disparity(
        self, view: _View, left: NDArray[np.uint8], right: NDArray[np.uint8]
    ) -> NDArray[np.float32]:
        # A few rows above the horizon give the matcher's paths a run-up.
        top = 0 if self._settings.disparity_above_horizon else max(0, view.first_row - 16)
        disparity = np.zeros(left.shape, np.float32)
        disparity[top:] = view.matcher.compute(left[top:], right[top:])
        return disparity

    def _profile(self, view: _View, disparity: NDArray[np.float32]) -> FloorProfile:
        settings, camera = self._settings, self._camera
        bins = (disparity + 0.5).astype(np.intp)
        num = view.matcher.num_disparities + 1
        upright = (
            u_disparity(bins, num)
            > obstacle_rows(
                np.arange(num),
                settings.obstacle_height_m,
                camera.fy / (camera.fx * camera.baseline_m),
                1 / view.line.slope,
            )[:, None]
        )
        keep = (disparity > 0) & ~upright[bins, view.column]
        rows = (view.derolled + 0.5).astype(np.intp)
        first, last = int(rows.min()), int(rows.max())
        counts = v_disparity(
            rows - first,
            (disparity * _BINS_PER_PX + 0.5).astype(np.intp),
            keep,
            (last - first + 1, num * _BINS_PER_PX),
        )
        return fit_profile(counts, first, 1 / _BINS_PER_PX, view.line, camera, settings)

    def _heights(
        self, view: _View, profile: FloorProfile, disparity: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return metres above the floor that has the same disparity, (R, W); NaN unmatched."""
        grid = np.arange(view.matcher.num_disparities * SUBPIXEL + 1) / SUBPIXEL
        with np.errstate(divide='ignore'):
            scale = view.line.metres_per_row / grid
        scale[0] = np.nan
        offset = np.where(grid > 0, scale * profile.row_of_disparity(grid), np.nan)
        index = (disparity * SUBPIXEL).astype(np.intp)
        return offset.astype(np.float32)[index] - scale.astype(np.float32)[index] * view.derolled

    def _tolerances(
        self, view: _View, disparity: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        settings = self._settings
        noise = settings.disparity_noise_px * view.line.metres_per_row / view.line.slope
        noise_m = np.float32(noise) / np.maximum(disparity, np.float32(0.25))
        up = np.sqrt(np.float32(settings.step_height_m**2) + noise_m**2)
        down = np.float32(settings.drop_height_m) + 2 * noise_m
        return up.astype(np.float32), down.astype(np.float32)

    def _evidence(
        self,
        view: _View,
        profile: FloorProfile,
        disparity: NDArray[np.float32],
        height: NDArray[np.float32],
    ) -> NDArray[np.uint8]:
        up, down = self._tolerances(view, disparity)
        mask = np.full(disparity.shape, NO_EVIDENCE, np.uint8)
        mask[(height <= up) & (height >= -down)] = FLOOR
        mask[(height > up) | (height < -down)] = NOT_FLOOR
        mask[view.derolled <= view.line.horizon] = NOT_FLOOR
        low = (height > up) & (height < up + np.float32(_CONTACT_HEIGHT_M))
        mask[self._below_contact(view, profile, disparity, low)] = NOT_FLOOR
        return mask

    def _below_contact(
        self,
        view: _View,
        profile: FloorProfile,
        disparity: NDArray[np.float32],
        low: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        """Return the pixels between the foot of an upright surface and where it meets the floor.

        They are lower than a step, but belong to the same surface: its disparity says at which
        row the floor is.
        """
        rows, columns = np.nonzero(low)
        shear = view.line.shear * (columns - self._camera.cx)
        foot = profile.row_of_disparity(disparity[rows, columns]) - shear - view.first_row
        end = np.clip(np.floor(foot), rows, low.shape[0] - 1).astype(np.intp) + 1
        height, width = low.shape
        size = (height + 1) * width
        change = np.bincount(rows * width + columns, minlength=size) - np.bincount(
            end * width + columns, minlength=size
        )
        covered = np.cumsum(change.reshape(height + 1, width), axis=0)[:height]
        return covered >= 2

    def _fill(
        self, view: _View, profile: FloorProfile, mask: NDArray[np.uint8]
    ) -> NDArray[np.uint8]:
        """Fill small gaps without evidence between floor pixels."""
        gap = max(3, round(self._settings.fill_gap_m * self._camera.fx / 2.0) | 1)
        kernel = np.ones((3, gap), np.uint8)
        floor = (mask == FLOOR).astype(np.uint8)
        closed = cv2.morphologyEx(floor, cv2.MORPH_CLOSE, kernel, borderType=cv2.BORDER_REPLICATE)
        filled = mask.copy()
        filled[(mask == NO_EVIDENCE) & (closed > 0)] = FLOOR
        return filled

    def _scan(
        self,
        view: _View,
        mount: Mount,
        profile: FloorProfile,
        disparity: NDArray[np.float32],
        height: NDArray[np.float32],
        mask: NDArray[np.uint8],
    ) -> FloorScan:
        floor = (mask == FLOOR)[:, ::2] & (disparity > 0)[:, ::2]
        obstacle = ((mask == NOT_FLOOR) & (height > 0))[:, ::2]
        T = view.scan.T_base_left
        camera = self._camera

        def in_base(where: NDArray[np.bool_]) -> Array:
            rows, columns = np.nonzero(where)
            d = disparity[:, ::2][where]
            uv = np.stack([2.0 * columns, rows + view.first_row], axis=1)
            points = camera.back_project(uv, camera.disparity_times_depth / d)
            return points @ T[:2, :3].T + T[:2, 3]

        return make_scan(
            view.scan, in_base(floor), in_base(obstacle), self._settings, camera, mount
        )
