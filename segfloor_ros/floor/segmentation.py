"""The floor segmentation stage: a rectified stereo pair in, the floor out."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.blank_border import blank_border
from segfloor_ros.camera.depth import is_disparity
from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.disparity import BLOCK_PX, TwoScaleMatcher, disparity_range, stereo_view
from segfloor_ros.floor.filling import (
    beside_something,
    beyond_texture,
    drop_islands,
    fill_gaps,
    fill_regions,
    trim_to_edges,
)
from segfloor_ros.floor.hidden import clear_hidden, drop_hidden
from segfloor_ros.floor.histograms import filtered_v_disparity, rising
from segfloor_ros.floor.observation import (
    FLOOR,
    NOT_FLOOR,
    FloorObservation,
    FloorScan,
    VDisparity,
)
from segfloor_ros.floor.overhead import OverheadMatcher
from segfloor_ros.floor.photometric import compare
from segfloor_ros.floor.pixel_evidence import Comparison, Evidence, HeightTable, judge
from segfloor_ros.floor.plane import PlaneFit, Samples, angles_height_of, propose, refine, scores
from segfloor_ros.floor.profile import (
    BINS_PER_PX,
    HEIGHT_SIGMA,
    PITCH_SIGMA_RAD,
    FloorLine,
    FloorProfile,
    fit_profile,
)
from segfloor_ros.floor.remembered_floor import FloorMemory
from segfloor_ros.floor.runs import pixels_where
from segfloor_ros.floor.scan import FloorScanner
from segfloor_ros.floor.settings import FloorSegmentationSettings
from segfloor_ros.floor.texture import MIN_TEXTURE_GREY, NOISE_TEXTURE, noise_grey, texture_grey
from segfloor_ros.floor.view import FloorView, column_step
from segfloor_ros.geometry import Array
from segfloor_ros.slam.excluded import join
from segfloor_ros.timing import NoTimes, StageTimes

DISPARITY, DISPARITY_ABOVE = 'disparity', 'disparity above the horizon'
_ROWS_ABOVE_HORIZON = 16
"""The matcher's paths get a run-up, and the horizon some play."""
_TEXTURE_WINDOW_PX = 11
_PLAIN_TO_SEE = 100.0
_BORDER_BLOCKS = 2
"""So near to the border of the right image, in blocks that are matched, matches are unsure."""
_PLANE_SAMPLES = 4000
_PLANE_SCALES_PX = (2.0, 1.5, 1.0, 0.7, 0.5, 0.5)
_FAITH = 2.0
"""So much more must speak for the second expectation than for the first."""
_SWING_RAD = math.radians(3.0)
"""So far robots swing on their wheels; what the map says beyond that is drift."""
_MAX_SLOPE_RAD = math.radians(18.0)
_SLOPE_HEIGHT = 0.35
"""By how much the camera's height above a slope ahead may differ from that above the floor."""
_SLOPE_EVERY = 4
_SLOPE_PROPOSALS = 100
_SLOPE_SIGMA = np.array([math.radians(5.0), math.radians(1.0), 0.1])
_PLAIN_SHARE = 0.4
"""So much of all that is seen must lie on a slope that nobody expects."""
_BOARD = 2
"""Table tops are thinner than what stands: so many times what is seen of them counts."""
_FLAT_WEIGHT = 0.1
"""Of samples whose disparity does not rise down the image as a floor's does."""


class FloorSegmentation:
    """Finds the floor in rectified stereo pairs of one camera. times: told what each step takes."""

    def __init__(
        self,
        camera: StereoCamera,
        settings: FloorSegmentationSettings,
        times: StageTimes | None = None,
    ) -> None:
        self._times = times or NoTimes()
        self._camera = camera
        self._settings = settings
        self._memory = FloorMemory()
        self._mount: Mount | None = None
        self._matcher: TwoScaleMatcher
        self._overhead: OverheadMatcher
        self._scanner: FloorScanner

    def process(
        self,
        left: NDArray[np.uint8],
        right: NDArray[Any],
        mount: Mount,
        T_map_base: Array | None = None,
        moving: NDArray[np.uint8] | None = None,
    ) -> FloorObservation:
        """Return the floor of a rectified grey pair (H, W) uint8; of a depth camera, right is its
        disparity (H, W) float32.

        mount: where the left camera sits above the floor. T_map_base: pose (4, 4) of the base in
        the map, where known; with it the floor found by earlier keyframes helps. moving: mask
        (H, W) of the left image, 255 where something moves: it is neither floor nor in the way, and
        what it hides is unknown. The black border that rectification leaves is treated alike.
        """
        measure = self._times.measure
        self._prepare(mount)
        expected = self._expectations(mount, T_map_base)
        first_row = min(self._first_row(_with_angles(mount, one)) for one in expected)
        columns = np.s_[first_row:, :: column_step(self._camera)]
        with measure('texture'):
            moving = join(moving, blank_border(left))
            right_border = None if is_disparity(right) else blank_border(right)
            right, measured = stereo_view(left, right)
            left_rows, right_rows = left[first_row:], right[first_row:]
            noise = noise_grey(left_rows)
            enough = max(MIN_TEXTURE_GREY, NOISE_TEXTURE * noise)
            texture = texture_grey(left_rows, _TEXTURE_WINDOW_PX)[:, columns[1]]
            if measured is not None:
                # Depth is measured on plain surfaces, too.
                texture = np.full_like(texture, _PLAIN_TO_SEE * enough)
        with measure(DISPARITY):
            disparity = measured
            if disparity is None:
                disparity = self._disparity(first_row, left, right)
            drop_hidden(disparity, moving, right_border)
        below, textured = disparity[columns], texture > enough
        with measure('plane'):
            fit = self._plane(first_row, below, texture, enough, expected)
        view = FloorView.of(self._camera, _with_angles(mount, fit.angles_height), first_row)
        with measure('profile'):
            counted = self._v_disparity(view, below, texture > 2 * enough)
            profile = fit_profile(counted, view.line, self._camera)
        with measure('comparison'):
            compared = compare(view, profile, left_rows, right_rows, below, noise)
        with measure('evidence'):
            evidence = self._evidence(view, profile, below, left[columns], textured, compared)
            seen = evidence.mask
            clear_hidden(seen, moving, columns)
        with measure('filling'):
            mask = self._fill(view, profile, below, seen, left_rows, textured, compared, T_map_base)
            clear_hidden(mask, moving, columns)
        with measure(DISPARITY_ABOVE):
            overhead_xy = self._overhead.positions(
                left, right, view.mount, first_row, enough, moving, measured
            )
        with measure('scan'):
            scan = self._scan(view, profile, below, evidence, mask, overhead_xy, T_map_base)
        return self._observation(view, profile, disparity, mask, scan, counted)

    def _evidence(
        self,
        view: FloorView,
        profile: FloorProfile,
        below: NDArray[np.float32],
        image: NDArray[np.uint8],
        textured: NDArray[np.bool_],
        compared: Comparison,
    ) -> Evidence:
        """Return what the pixels (R, W) of the view say by themselves, cut back to edges."""
        settings = self._settings
        table = HeightTable.of(view.line, profile, self._matcher.num_disparities, settings)
        evidence = judge(view, profile, below, textured, compared, table, settings)
        seen = trim_to_edges(evidence.mask, image, _TEXTURE_WINDOW_PX // 2 + 3)
        return Evidence(seen, evidence.height_m)

    def _observation(
        self,
        view: FloorView,
        profile: FloorProfile,
        disparity: NDArray[np.float32],
        mask: NDArray[np.uint8],
        scan: FloorScan,
        counted: VDisparity,
    ) -> FloorObservation:
        rows = np.arange(self._camera.height, dtype=np.float64)
        whole = np.full(disparity.shape, NOT_FLOOR, np.uint8)
        whole[view.first_row :] = np.repeat(mask, view.step, axis=1)[:, : self._camera.width]
        return FloorObservation(
            disparity_px=disparity,
            mask=whole,
            profile_px=profile.at_rows(rows).astype(np.float64),
            scan=scan,
            min_disparity_px=0.0,
            max_disparity_px=float(self._matcher.num_disparities),
            v_disparity=counted,
        )

    def change_settings(self, settings: FloorSegmentationSettings) -> None:
        """Segment with changed settings from now on. What is remembered stays as far as it holds:
        floor under a lower step would have been floor under a higher one, but not the reverse.
        """
        before, self._settings = self._settings, settings
        limits = [(s.step_height_m, s.drop_height_m) for s in (before, settings)]
        if any(new < old for old, new in zip(*limits, strict=True)):
            self._memory.forget_floor()
        if any(new > old for old, new in zip(*limits, strict=True)):
            self._memory.forget_blocked()
        if self._mount is not None:
            self._make_tools(self._mount)

    def _prepare(self, mount: Mount) -> None:
        if mount == self._mount:
            return
        self._make_tools(mount)
        self._memory = FloorMemory()
        self._mount = mount

    def _make_tools(self, mount: Mount) -> None:
        searched = self._settings.num_disparities or disparity_range(self._camera, mount)
        self._matcher = TwoScaleMatcher(-(-searched // 16) * 16, self._settings)
        self._overhead = OverheadMatcher(self._camera, searched, self._settings)
        self._scanner = FloorScanner(self._camera, mount, self._settings)

    def _expectations(self, mount: Mount, T_map_base: Array | None) -> Array:
        """Return what pitch, roll and height to expect, (P, 3), the likeliest first.

        As the camera is mounted; or, should the robot pitch or roll on its wheels, level in the
        map.
        """
        mounted = np.array([mount.pitch_rad, mount.roll_rad, mount.height_m])
        if T_map_base is None:
            return mounted[None]
        T_map_left = T_map_base @ mount.T_base_left
        level = angles_height_of(T_map_left[2, :3] / mount.height_m)
        return np.stack([mounted, level])

    def _slope(self, samples: Samples, known_score: float, mounted: Array) -> Array | None:
        """Return pitch, roll and height (3,) above a slope that is all there is to see, as it is
        right before a ramp; None where it is not so.

        known_score: of the best expectation.
        """
        few = samples.every(_SLOPE_EVERY)
        total, known_score = few.weight.sum(), known_score / _SLOPE_EVERY
        if known_score > _PLAIN_SHARE / _FAITH * total or len(few.weight) < _SLOPE_PROPOSALS:
            return None
        known = np.array([math.nan, mounted[1], math.nan])
        rng = np.random.default_rng(len(few.weight))
        found = propose(few, _SLOPE_PROPOSALS, rng, known)
        ratio = found[:, 2] / mounted[2]
        near = np.abs(found[:, 0] - mounted[0]) < _MAX_SLOPE_RAD
        found = found[near & (ratio > 1 - _SLOPE_HEIGHT) & (ratio < 1 + _SLOPE_HEIGHT)]
        if len(found) == 0:
            return None
        score = scores(few, found)
        best = int(np.argmax(score))
        plain = score[best] > max(_PLAIN_SHARE * total, _FAITH * known_score)
        return found[best] if plain else None

    def _first_row(self, expected: Mount) -> int:
        camera = self._camera
        line = FloorLine.of(camera, expected)
        shear = abs(line.shear) * max(camera.cx, camera.width - camera.cx)
        top = math.floor(line.horizon - shear) - _ROWS_ABOVE_HORIZON
        return int(np.clip(top, 0, camera.height - 32))

    def _disparity(
        self, first_row: int, left: NDArray[np.uint8], right: NDArray[np.uint8]
    ) -> NDArray[np.float32]:
        settings, camera = self._settings, self._camera
        top = 0 if settings.disparity_above_horizon else first_row
        assert self._mount is not None
        line = FloorLine.of(camera, self._mount)
        shear = abs(line.shear) * max(camera.cx, camera.width - camera.cx)
        last_fine = line.horizon + settings.coarse_above_px / line.slope + shear
        fine_rows = int(np.clip(last_fine - top, _ROWS_ABOVE_HORIZON, camera.height - top))
        disparity = np.zeros(left.shape, np.float32)
        disparity[top:] = self._matcher.compute(left[top:], right[top:], fine_rows)
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
        part = disparity[::step, ::step]
        rows, columns = pixels_where(part > 0)
        across = step * column_step(camera)
        grey = texture[::step, ::step][rows, columns].astype(np.float64) / (4 * enough)
        grey *= grey
        grey *= grey
        slope = FloorLine.of(camera, Mount(height_m=expected[0, 2], pitch_rad=expected[0, 0])).slope
        inclined = rising(disparity[:, ::step], slope)[::step][rows, columns]
        found = part[rows, columns].astype(np.float64)
        uv = np.stack([columns * across, rows * step + first_row], axis=1).astype(np.float64)
        samples = Samples(
            rays=camera.back_project(uv, np.ones(len(uv))),
            position_m=np.zeros(3),
            disparity_px=found,
            weight=grey / (grey + 1) * np.where(inclined, 1.0, _FLAT_WEIGHT),
            disparity_m=camera.disparity_times_depth,
        )
        likelihood = scores(samples, expected)
        slope_start = self._slope(samples, likelihood.max(), expected[0])
        swing = np.hypot(*(expected - expected[0])[:, :2].T)
        likelihood = likelihood * np.exp(-0.5 * (swing / _SWING_RAD) ** 2)
        likelihood[0] *= _FAITH
        start = expected[int(np.argmax(likelihood))]
        sigma = np.array([*2 * [PITCH_SIGMA_RAD], HEIGHT_SIGMA * start[2]])
        if slope_start is not None:
            start, sigma = slope_start, _SLOPE_SIGMA
        unknown, no_travel = np.full(3, np.nan), np.zeros((0, 3))
        return refine([samples], start, unknown, no_travel, sigma, _PLANE_SCALES_PX)

    def _v_disparity(
        self, view: FloorView, disparity: NDArray[np.float32], textured: NDArray[np.bool_]
    ) -> VDisparity:
        most = self._matcher.num_disparities
        return filtered_v_disparity(view, disparity, textured, most, BINS_PER_PX, self._settings)

    def _fill(
        self,
        view: FloorView,
        profile: FloorProfile,
        disparity: NDArray[np.float32],
        mask: NDArray[np.uint8],
        left_rows: NDArray[np.uint8],
        textured: NDArray[np.bool_],
        compared: Comparison,
        T_map_base: Array | None,
    ) -> NDArray[np.uint8]:
        """Return the mask with floor where this pair of images alone cannot tell."""
        settings = self._settings
        beside = beside_something(view, mask)
        if T_map_base is not None:
            # What is remembered may lie behind a blank wall that stands in front of it now.
            unshared = view.columns < profile.at_pixels(view.derolled)
            mask = self._memory.fill(view, mask, textured & unshared & ~beside, T_map_base)
        barred = beside | beyond_texture(mask, textured)
        mask = fill_regions(
            view, mask, left_rows, disparity, compared, textured, barred, settings.fill_support
        )
        may_be = compared.consistent & ~compared.denied & ~barred
        mask = fill_gaps(view, profile, mask, may_be, settings.fill_gap_m)
        return drop_islands(mask)

    def _scan(
        self,
        view: FloorView,
        profile: FloorProfile,
        disparity: NDArray[np.float32],
        evidence: Evidence,
        mask: NDArray[np.uint8],
        overhead_xy: NDArray[np.float32],
        T_map_base: Array | None,
    ) -> FloorScan:
        """Return the scan, and let the memory learn what was seen. overhead_xy: (2, N), what is in
        the way above the horizon.
        """
        standing = (evidence.mask[::2] == NOT_FLOOR) & (evidence.height_m[::2] > 0)
        rows, columns = pixels_where(standing)
        rows *= 2
        upright_xy = view.positions(rows, columns, disparity[rows, columns])
        if T_map_base is not None:
            self._memory.learn(view, evidence.mask, upright_xy, T_map_base)
        v, u, floor_px = view.pixels_of_profile(self._scanner.cells_xy, profile)
        floor = (v >= 0) & (v < mask.shape[0]) & (u >= 0) & (u < mask.shape[1])
        floor &= mask.take(v * np.int32(mask.shape[1]) + u, mode='clip') == FLOOR
        border_px = np.float32(_BORDER_BLOCKS * BLOCK_PX)
        shared = u * view.step >= floor_px + border_px
        # At half the resolution a pixel tells of four, here of two or, in every other column, four.
        overhead_xy = np.repeat(overhead_xy, _BOARD * 2 // view.step, axis=1)
        upright_xy = np.hstack([upright_xy, overhead_xy])
        return self._scanner.scan(floor, shared, upright_xy, 1 / (2 * view.step))


def _with_angles(mount: Mount, angles_height: Array) -> Mount:
    pitch, roll, height = (float(value) for value in angles_height)
    return dataclasses.replace(mount, height_m=height, pitch_rad=pitch, roll_rad=roll)
