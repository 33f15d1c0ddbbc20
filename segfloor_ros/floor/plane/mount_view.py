"""What one stereo pair shows of the floor, for measuring the camera's mount.

Where upright things stand on a blank floor: the feet of walls and furniture.

A floor of one colour shows nothing that both cameras see alike, but what stands on it ends there:
below the lower edge of a textured upright surface there is nothing but blank floor. The disparity
of the surface places that edge.

The search for the plane that most samples of several frames lie on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoCamera, Up
from segfloor_ros.floor.disparity.matching import (
    DisparityMatcher,
    TwoScaleMatcher,
    disparity_range,
    stereo_view,
)
from segfloor_ros.floor.disparity.photometric import (
    EDGE_SLOPE,
    MIN_TEXTURE_GREY,
    NOISE_TEXTURE,
    noise_grey,
    row_slope,
    texture_grey,
)
from segfloor_ros.floor.plane.mirror import MirrorView
from segfloor_ros.floor.plane.plane_fit import (
    SCALES_PX,
    PlaneFit,
    Samples,
    angles_height_of,
    on_and_below,
    plane_of,
    preference,
    propose,
    refine,
    scores,
    with_known,
)
from segfloor_ros.geometry import Array

_SAMPLES = 4000
_LEAST_HALVED_PX = 480
"""Images less wide than this are never matched at half the resolution alone."""
_TEXTURE_GREY = 1.2
"""Horizontal grey gradient per pixel below which a disparity is mostly invented."""

COLUMN_STEP_PX = 2
"""Every other column is looked at."""
_TEXTURE_WINDOW_PX = 11
_AROUND_ROWS = 15
"""An edge is the strongest of so many rows."""
_BLANK_GAP, _BLANK_ROWS = 7, 12
"""Below an edge, beyond what borrows its texture, so many rows are blank."""
_UPRIGHT_GAP, _UPRIGHT_ROWS, _UPRIGHT_COLUMNS = 3, 12, 5
"""Above an edge, beyond where the matcher mixes both surfaces, so much is upright."""
_UPRIGHT_SHARE = 0.8
_UPRIGHT_SPREAD_PX = 0.6
"""On floor of that many rows disparities spread more."""

_KEPT = 60
_SCORED, _REFINED = 6000, 60000
"""So many samples of all frames together tell which guess is best, and refine it: neighbours err
together.
"""
_FINE_STEPS = 4
"""So many steps of the refinement take them all; before, what scores will do."""
_LEVEL_SIGMA = np.array([np.inf, math.radians(2.0), np.inf])
"""Cameras are mounted level, more or less: with little floor in view, roll is least certain."""
_FLOOR_SLOPE = math.radians(1.5)
"""Floors on which robots start are level, more or less."""


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
        self._matcher = TwoScaleMatcher(searched)
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


def find_feet(
    left: NDArray[np.uint8], disparity_px: NDArray[np.float32]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.floating]]:
    """Return rows, columns (N,) and disparities (N,) of the feet in an image (H, W) of known
    disparities (H, W), 0 for none.
    """
    image, disparity = left[:, ::COLUMN_STEP_PX], disparity_px[:, ::COLUMN_STEP_PX]
    enough = max(MIN_TEXTURE_GREY, NOISE_TEXTURE * noise_grey(left))
    texture = texture_grey(left, _TEXTURE_WINDOW_PX)[:, ::COLUMN_STEP_PX]
    slope = row_slope(image)
    strongest = cv2.dilate(slope, np.ones((_AROUND_ROWS, 1), np.uint8))
    foot = (slope == strongest) & (slope >= EDGE_SLOPE)
    foot &= _below((texture < 1.5 * enough).astype(np.float32))
    counted = ((disparity >= 1) & (texture > 2 * enough)).astype(np.float32)
    share = _mean_above(counted)
    safe = np.maximum(share, np.float32(1e-6))
    mean = _mean_above(counted * disparity) / safe
    variance = _mean_above(counted * disparity**2) / safe - mean**2
    foot &= (share > _UPRIGHT_SHARE) & (variance < _UPRIGHT_SPREAD_PX**2)
    foot[-_BLANK_GAP - _BLANK_ROWS :] = False
    rows, columns = np.nonzero(foot)
    return rows, COLUMN_STEP_PX * columns, mean[rows, columns]


def _below(blank: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Tell of each pixel whether what is below it is blank (H, W)."""
    mean = cv2.blur(blank, (1, _BLANK_ROWS), anchor=(0, 0))
    below = np.zeros(blank.shape, np.bool_)
    below[:-_BLANK_GAP] = mean[_BLANK_GAP:] > 0.95
    return below


def _mean_above(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean of the values (H, W) in the window above each pixel."""
    anchor = (_UPRIGHT_COLUMNS // 2, _UPRIGHT_ROWS - 1)
    mean = cv2.blur(values, (_UPRIGHT_COLUMNS, _UPRIGHT_ROWS), anchor=anchor)
    above = np.zeros_like(mean)
    above[_UPRIGHT_GAP:] = mean[:-_UPRIGHT_GAP]
    return above


class PlaneSearch:
    """Finds the plane anew with each frame; the best guesses of earlier frames compete with those
    of the new one. known: (3,), pitch, roll and height that are given, NaN where not.
    """

    def __init__(self, known: Array) -> None:
        self._known = known
        self._rng = np.random.default_rng(0)
        self._guesses = np.zeros((0, 3))
        self._up: Up | None = None

    def expect(self, up_world: Up | None) -> None:
        """Expect a floor that is level as an accelerometer feels it, in the world's axes."""
        self._up = up_world

    def find(
        self, frames: list[Samples], travel: Array, proposals: int, contrary: list[Samples]
    ) -> PlaneFit | None:
        """Return the plane that the samples of the frames, the newest one last, lie on; None where
        none is plausible.

        travel: (T, 3), where the camera went. contrary: further samples, which can but speak
        against a plane, by lying below it.
        """
        fresh = propose(frames[-1], proposals, self._rng, self._known)
        guesses = np.concatenate([with_known(self._guesses, self._known), fresh])
        if len(guesses) == 0:
            return None
        total = np.sum([scores(few, guesses) for few in _thinned(frames, _SCORED)], axis=0)
        for frame in _thinned(contrary, _SCORED):
            total -= frame.weight @ on_and_below(frame, plane_of(guesses))[1]
        total = np.maximum(total, 0) * self._preference(guesses, travel)
        order = np.argsort(-total, kind='stable')[:_KEPT]
        self._guesses = guesses[order]
        fit = self.refined(frames, self._guesses[0], travel)
        self._guesses = np.concatenate([fit.angles_height[None], self._guesses])
        return fit

    def refined(self, frames: list[Samples], start: Array, travel: Array) -> PlaneFit:
        """Return the plane near `start`, (3,), that fits all samples best."""
        mean, sigma = self._prior(len(frames))
        roughly, finely = SCALES_PX[:-_FINE_STEPS], SCALES_PX[-_FINE_STEPS:]
        rough = refine(
            _thinned(frames, _SCORED), start, self._known, travel, sigma, roughly, mean
        ).angles_height
        some = _thinned(frames, _REFINED)
        return refine(some, rough, self._known, travel, sigma, finely, mean)

    def _preference(self, guesses: Array, travel: Array) -> Array:
        if self._up is None:
            return preference(guesses, travel)
        mean, sigma = self._prior(1)
        return preference(guesses, travel, mean[:2], sigma[:2])

    def _prior(self, count: int) -> tuple[Array, Array]:
        """Return what pitch, roll and height (3,) are expected, and their standard deviations."""
        # Frames that show the same err together: the prior counts once per frame, too.
        if self._up is None:
            return np.zeros(3), _LEVEL_SIGMA / math.sqrt(count)
        pitch, roll, _ = angles_height_of(self._up.direction)
        sigma = math.hypot(self._up.sigma_rad, _FLOOR_SLOPE) / math.sqrt(count)
        return np.array([pitch, roll, 0.0]), np.array([sigma, sigma, np.inf])


def _thinned(frames: list[Samples], most: int) -> list[Samples]:
    """Return frames with so many samples at most."""
    step = math.ceil(sum(len(frame.weight) for frame in frames) / most)
    return [frame.every(max(1, step)) for frame in frames]
