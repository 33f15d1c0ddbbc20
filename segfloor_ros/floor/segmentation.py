"""The floor segmentation stage: a rectified stereo pair in, the floor out."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.disparity import DisparityMatcher, disparity_range
from segfloor_ros.floor.evidence import Evidence, FloorView, HeightTable, judge
from segfloor_ros.floor.filling import (
    fill_gaps,
    fill_regions,
    floor_pixels,
    floor_positions,
    trim_to_edges,
)
from segfloor_ros.floor.histograms import filtered_v_disparity
from segfloor_ros.floor.memory import REACH_M, FloorMemory, cells_around, floor_at
from segfloor_ros.floor.observation import (
    FLOOR,
    NO_EVIDENCE,
    NOT_FLOOR,
    FloorObservation,
    FloorScan,
)
from segfloor_ros.floor.photometric import floor_costs
from segfloor_ros.floor.plane import PlaneFit, Samples, refine, scores
from segfloor_ros.floor.profile import BINS_PER_PX, FloorLine, FloorProfile, fit_profile
from segfloor_ros.floor.scan import ScanGeometry, make_scan
from segfloor_ros.floor.settings import FloorSegmentationSettings
from segfloor_ros.floor.texture import enough_texture_grey, noise_grey, texture_grey
from segfloor_ros.floor.tracking import FloorTracker
from segfloor_ros.geometry import Array

_ROWS_ABOVE_HORIZON = 16
"""The matcher's paths get a run-up, and the horizon some play."""
_TEXTURE_WINDOW_PX = 11
_PLANE_SAMPLES = 4000
_PLANE_SCALES_PX = (2.0, 1.5, 1.0, 0.7, 0.5, 0.5)
_FAITH = 1.3
"""So much more must speak for the second expectation than for the first."""


class FloorSegmentation:
    """Finds the floor in rectified stereo pairs of one camera."""

    def __init__(self, camera: StereoCamera, settings: FloorSegmentationSettings) -> None:
        self._camera = camera
        self._settings = settings
        self._tracker = FloorTracker(settings)
        self._memory = FloorMemory()
        self._cells = cells_around()
        self._mount: Mount | None = None
        self._matcher: DisparityMatcher
        self._scan_geometry: ScanGeometry

    def process(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        mount: Mount,
        T_map_base: Array | None = None,
    ) -> FloorObservation:
        """Return the floor of a rectified grey pair (H, W) uint8.

        mount: where the left camera sits above the floor. T_map_base: pose (4, 4) of the base in
        the map, where known; with it the floor found by earlier keyframes helps.
        """
        self._prepare(mount)
        expected = self._tracker.predictions(mount, T_map_base)
        first_row = min(self._first_row(_with_angles(mount, one)) for one in expected)
        disparity = self._disparity(first_row, left, right)
        below = disparity[first_row:]
        texture = texture_grey(left[first_row:], _TEXTURE_WINDOW_PX)
        enough = enough_texture_grey(left[first_row:], self._settings.min_texture_grey)
        fit = self._plane(first_row, below, texture, enough, expected)
        self._tracker.update(mount, T_map_base, fit)
        view = FloorView.of(self._camera, _with_angles(mount, fit.angles_height), first_row)
        textured = texture > enough
        profile = self._profile(view, below, texture > 2 * enough)
        costs = floor_costs(view, profile, left[first_row:], right[first_row:], below)
        noise = noise_grey(left[first_row:])
        table = HeightTable.of(view.line, profile, self._matcher.num_disparities, self._settings)
        against = costs.floor > 1.3 * costs.matched + 1.0 + 0.5 * noise
        distinct = costs.shifted - costs.floor > 0.4 + 0.1 * noise
        self.dbg = (costs, textured, against, distinct, fit, profile)
        evidence = judge(view, profile, below, textured, against, table, self._settings)
        mask = trim_to_edges(evidence.mask, left[first_row:], _TEXTURE_WINDOW_PX // 2 + 3)
        evidence = Evidence(mask, evidence.height_m)
        mask = self._recall(view, mask, T_map_base)
        consistent = ~against & (costs.floor < 4 + 2 * noise)
        mask = fill_regions(mask, left[first_row:], consistent, 0.3)
        mask = fill_gaps(view, profile, mask, self._settings.fill_gap_m)
        scan = self._scan(view, below, evidence, mask, T_map_base)
        whole = np.full(disparity.shape, NOT_FLOOR, np.uint8)
        whole[first_row:] = mask
        return FloorObservation(
            disparity_px=disparity,
            mask=whole,
            profile_px=profile.at_rows(np.arange(self._camera.height)),
            scan=scan,
            min_disparity_px=0.0,
            max_disparity_px=float(self._matcher.num_disparities),
        )

    def _prepare(self, mount: Mount) -> None:
        if mount == self._mount:
            return
        searched = self._settings.num_disparities or disparity_range(self._camera, mount)
        self._matcher = DisparityMatcher(-(-searched // 16) * 16, self._settings)
        self._scan_geometry = ScanGeometry(self._camera, mount, self._settings)
        self._tracker = FloorTracker(self._settings)
        self._memory = FloorMemory()
        self._mount = mount

    def _first_row(self, expected: Mount) -> int:
        camera = self._camera
        line = FloorLine.of(camera, expected)
        shear = abs(line.shear) * max(camera.cx, camera.width - camera.cx)
        top = math.floor(line.horizon - shear) - _ROWS_ABOVE_HORIZON
        return int(np.clip(top, 0, camera.height - 32))

    def _disparity(
        self, first_row: int, left: NDArray[np.uint8], right: NDArray[np.uint8]
    ) -> NDArray[np.float32]:
        top = 0 if self._settings.disparity_above_horizon else first_row
        disparity = np.zeros(left.shape, np.float32)
        disparity[top:] = self._matcher.compute(left[top:], right[top:])
        return disparity

    def _plane(
        self,
        first_row: int,
        disparity: NDArray[np.float32],
        texture: NDArray[np.float32],
        enough: float,
        expected: Array,
    ) -> PlaneFit:
        """Return the plane of the floor in this frame, in its own camera's axes, starting from
        what is expected (P, 3).
        """
        camera = self._camera
        step = max(2, round(math.sqrt(disparity.size / _PLANE_SAMPLES)))
        rows, columns = np.nonzero(disparity[::step, ::step] > 0)
        grey = texture[::step, ::step][rows, columns].astype(np.float64) / (4 * enough)
        found = disparity[::step, ::step][rows, columns].astype(np.float64)
        uv = np.stack([columns * step, rows * step + first_row], axis=1)
        samples = Samples(
            rays=camera.back_project(uv, np.ones(len(uv))),
            position_m=np.zeros(3),
            disparity_px=found,
            weight=grey**4 / (grey**4 + 1),
            disparity_m=camera.disparity_times_depth,
        )
        likelihood = scores(samples, expected)
        likelihood[0] *= _FAITH
        start = expected[int(np.argmax(likelihood))]
        assert self._mount is not None
        sigma = self._tracker.sigma(self._mount)
        unknown, no_travel = np.full(3, np.nan), np.zeros((0, 3))
        return refine([samples], start, unknown, no_travel, sigma, _PLANE_SCALES_PX)

    def _profile(
        self, view: FloorView, disparity: NDArray[np.float32], textured: NDArray[np.bool_]
    ) -> FloorProfile:
        settings = self._settings
        counts, first = filtered_v_disparity(
            view, disparity, textured, self._matcher.num_disparities, BINS_PER_PX, settings
        )
        return fit_profile(counts, first, 1 / BINS_PER_PX, view.line, self._camera, settings)

    def _recall(
        self, view: FloorView, mask: NDArray[np.uint8], T_map_base: Array | None
    ) -> NDArray[np.uint8]:
        """Return the mask with floor where nothing is seen now and floor was seen before."""
        if T_map_base is None:
            return mask
        rows, columns = np.nonzero(mask == NO_EVIDENCE)
        xy_base = floor_positions(view, rows + view.first_row, columns)
        near = np.hypot(xy_base[:, 0], xy_base[:, 1]) < REACH_M
        rows, columns, xy_base = rows[near], columns[near], xy_base[near]
        known = self._memory.recall(_in_map(T_map_base, xy_base))
        recalled = mask.copy()
        recalled[rows[known], columns[known]] = FLOOR
        return recalled

    def _scan(
        self,
        view: FloorView,
        disparity: NDArray[np.float32],
        evidence: Evidence,
        mask: NDArray[np.uint8],
        T_map_base: Array | None,
    ) -> FloorScan:
        camera = self._camera
        T_base_left = view.mount.T_base_left

        def in_base(where: NDArray[np.bool_]) -> Array:
            rows, columns = np.nonzero(where[:, ::2])
            d = disparity[:, ::2][rows, columns]
            uv = np.stack([2.0 * columns, rows + view.first_row], axis=1)
            points = camera.back_project(uv, camera.disparity_times_depth / d)
            return points @ T_base_left[:2, :3].T + T_base_left[:2, 3]

        floor = in_base((evidence.mask == FLOOR) & (disparity > 0))
        obstacle = in_base((evidence.mask == NOT_FLOOR) & (evidence.height_m > 0))
        if T_map_base is not None:
            pixels = floor_pixels(view, self._cells) - (0, view.first_row)
            seen = floor_at(evidence.mask, pixels)
            self._memory.learn(
                _in_map(T_map_base, self._cells[seen]),
                _in_map(T_map_base, obstacle[np.hypot(*obstacle.T) < REACH_M]),
                T_map_base[:2, 3],
            )
        return make_scan(self._scan_geometry, floor, obstacle, self._settings, camera, view.mount)


def _with_angles(mount: Mount, angles_height: Array) -> Mount:
    pitch, roll, height = (float(value) for value in angles_height)
    return dataclasses.replace(mount, height_m=height, pitch_rad=pitch, roll_rad=roll)


def _in_map(T_map_base: Array, xy_base: Array) -> Array:
    return xy_base @ T_map_base[:2, :2].T + T_map_base[:2, 3]
