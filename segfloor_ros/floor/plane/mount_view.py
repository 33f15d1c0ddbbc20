"""What one stereo pair shows of the floor, for measuring the camera's mount."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.floor.disparity.matching import (
    DisparityMatcher,
    TwoScaleMatcher,
    disparity_range,
    stereo_view,
)
from segfloor_ros.floor.plane.feet import COLUMN_STEP_PX, find_feet
from segfloor_ros.floor.plane.mirror import MirrorView
from segfloor_ros.floor.plane.plane_fit import Samples
from segfloor_ros.floor.settings import FloorSegmentationSettings
from segfloor_ros.geometry import Array

_SAMPLES = 4000
_LEAST_HALVED_PX = 480
"""Images less wide than this are never matched at half the resolution alone."""
_TEXTURE_GREY = 1.2
"""Horizontal grey gradient per pixel below which a disparity is mostly invented."""


@dataclass(frozen=True)
class MountView:
    """surfaces: samples of all that has texture, with the images in which mirrors show. feet: of
    where upright things stand on blank floor.
    """

    surfaces: MirrorView
    feet: Samples


class MountViewer:
    """Looks at the rectified pairs of one camera; only the first is matched in full."""

    def __init__(self, camera: StereoCamera) -> None:
        self._camera = camera
        searched = disparity_range(camera, None)
        self._first: DisparityMatcher | None = DisparityMatcher(searched)
        self._matcher = TwoScaleMatcher(searched, FloorSegmentationSettings())
        self._fine_rows = 0 if camera.width >= _LEAST_HALVED_PX else camera.height

    def view(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8], T_world_left: Array
    ) -> MountView:
        """Return what a grey pair (H, W) from a pose (4, 4) shows."""
        right, measured = stereo_view(left, right)
        disparity = self._disparity(left, right) if measured is None else measured
        self._first = None
        smooth = cv2.GaussianBlur(left.astype(np.float32), (0, 0), 1.0)
        gradient = np.abs(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8))
        texture = cv2.blur(gradient, (9, 9))
        step = max(2, round(math.sqrt(left.size / 2 / _SAMPLES)))
        grid = disparity[step // 2 :: step, step // 2 :: step]
        rows, columns = (step // 2 + step * index for index in np.nonzero(grid >= 1))
        grey = texture[rows, columns].astype(np.float64)
        weight = grey**4 / (grey**4 + _TEXTURE_GREY**4)
        if measured is not None:
            # A depth camera needs no texture.
            weight = np.ones(len(rows))
        disparity_px = disparity[rows, columns]
        samples = self._placed(rows, columns, disparity_px, weight, T_world_left)
        surfaces = MirrorView.of(self._camera, left, disparity, samples, T_world_left)
        foot_rows, foot_columns, foot_px = find_feet(left, disparity)
        weight = np.full(len(foot_rows), float(COLUMN_STEP_PX))
        feet = self._placed(foot_rows, foot_columns, foot_px, weight, T_world_left)
        return MountView(surfaces, feet)

    def _disparity(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        if self._first is not None:
            return self._first.compute(left, right)
        return self._matcher.compute(left, right, self._fine_rows)

    def _placed(
        self,
        rows: NDArray[np.intp],
        columns: NDArray[np.intp],
        disparity_px: NDArray[np.floating],
        weight: Array,
        T_world_left: Array,
    ) -> Samples:
        pixels = np.stack([columns, rows], axis=1).astype(np.float64)
        rays = self._camera.back_project(pixels, np.ones(len(rows)))
        return Samples(
            rays=rays @ T_world_left[:3, :3].T,
            position_m=T_world_left[:3, 3].astype(np.float64),
            disparity_px=disparity_px.astype(np.float64),
            weight=weight,
            disparity_m=self._camera.disparity_times_depth,
        )
