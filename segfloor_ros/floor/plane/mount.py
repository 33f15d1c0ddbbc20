"""The camera's height, pitch and roll, measured from the floor it sees.

Two things show a floor: the plane on which what has texture lies, and the base of what stands on
it. A floor of one colour shows nothing that both cameras see alike, but below the lower edge of a
textured upright surface there is nothing but blank floor, and the disparity of the surface places
that edge. Both are samples of one plane, which is known once its covariance says so.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera, Up
from segfloor_ros.floor.disparity.matching import (
    BLOCK_PX,
    DisparityMatcher,
    TwoScaleMatcher,
    disparity_range,
    stereo_view,
)
from segfloor_ros.floor.disparity.profile import STEP_PX, column_step, pixels_where, surface_above
from segfloor_ros.floor.mask.pixel_evidence import (
    EDGE_SLOPE,
    TEXTURE_WINDOW_PX,
    enough_texture,
    noise_grey,
    row_slope,
    texture_grey,
)
from segfloor_ros.floor.plane.plane import (
    LEVEL_SIGMA,
    LOOKS,
    SAMPLES,
    SWAY,
    PlaneFit,
    Samples,
    angles_height_of,
    plane_of,
    plausible,
    preference,
    propose,
    refine,
    scores,
    shares,
    texture_weight,
)
from segfloor_ros.geometry import Array, invert

_USUAL = np.array([0.0, 0.0, 0.3])
"""Pitch, roll and height while nothing is known."""
_MAX_FRAMES = 12
_PROPOSALS, _KEPT = 200, 60
"""Guesses by the newest frame, and those that are kept for the next."""
_COMPARED = 6000
"""So many samples of all frames together are compared with a plane: neighbours err together."""
_LEAST_SAMPLES = 20
_SIGMA = np.array([math.radians(0.4), math.radians(1.0), 0.015])
"""How well pitch, roll and height, as a share of it, must be known."""
_SURE = 3.0
"""Sigmas within which nearly all lies: guesses, or what is seen but once, are no surer."""
_FLOOR_SLOPE = math.radians(1.5)
"""Floors on which robots start are level, more or less."""
_HEIGHT_TOLERANCE = 0.05
_TILT_TOLERANCE_DEG = 1.0
MAX_KEYFRAMES = 20
"""Where so many do not show the floor well enough, nothing is said."""

MORE_TEXTURE = 1.25
"""A mount is kept, so it asks for more texture than the plane of one frame. As measured: with 1 the
mount of KITTI 06 rolls by 1.6° in place of 0.8°, with 1.5 a rug alone shows none.
"""

_BASE_WEIGHT = 8.0
"""All of the surface above places a base: it counts as so many samples."""
_AROUND_ROWS = 15
"""An edge is the strongest of so many rows."""
_BLANK_GAP, _BLANK_ROWS = 7, 12
"""Below an edge, beyond what borrows its texture, so many rows are blank."""
_UPRIGHT_GAP, _UPRIGHT_ROWS, _UPRIGHT_COLUMNS = 3, 12, 5
"""Above an edge, beyond where the matcher mixes both surfaces, so much is upright."""
_UPRIGHT_SHARE = 0.8
_UPRIGHT_SPREAD_PX = 0.6
"""On floor of that many rows disparities spread more."""


class MountEstimator:
    """Measures the mount over the first keyframes, in SLAM's own frame.

    known values are kept and only the others measured; NaN where not known. Deterministic: the
    same frames give the same mount.
    """

    def __init__(
        self,
        camera: StereoCamera,
        height_m: float = math.nan,
        pitch_rad: float = math.nan,
        roll_rad: float = math.nan,
        forward_m: float = 0.0,
        left_m: float = 0.0,
    ) -> None:
        self._known = np.array([pitch_rad, roll_rad, height_m])
        self._offset = (forward_m, left_m)
        self._viewer = MountViewer(camera)
        self.reset()

    def reset(self) -> None:
        """Forget all frames: the next ones are of another world."""
        self._surfaces, self._bases = PlaneSearch(self._known), PlaneSearch(self._known)
        self._poses: list[Array] = []
        self.mount: Mount | None = None

    @property
    def provisional(self) -> Mount:
        """The mount as it seems so far, at first a level camera at a usual height."""
        for search in (self._bases, self._surfaces):
            if search.fits and self._is_possible(search.fits[-1]):
                return self._mount_of(search.fits[-1].angles_height)
        return self._mount_of(np.where(np.isnan(self._known), _USUAL, self._known))

    def _mount_of(self, angles_height: Array) -> Mount:
        pitch, roll, height = (float(value) for value in angles_height)
        return Mount(height, pitch, roll, *self._offset)

    def add(
        self,
        left: NDArray[np.uint8],
        right: NDArray[Any],
        T_world_left: Array,
        up_world: Up | None = None,
        is_new_view: bool = True,
    ) -> None:
        """Use one more rectified grey pair (H, W) uint8.

        T_world_left: pose (4, 4) of the camera in a frame whose origin is the first camera's.
        up_world: where an accelerometer has up in that frame. is_new_view: else it shows what the
        last one does, and takes its place: their errors are the same.
        """
        if self.mount is not None:
            return
        if not is_new_view:
            del self._poses[-1:]
        self._poses.append(T_world_left)
        right, measured = stereo_view(left, right)
        disparity = self._viewer.disparity(left, right) if measured is None else measured
        enough = enough_texture(noise_grey(left))
        needed = enough if measured is None else None
        surfaces = self._viewer.surfaces(left, disparity, needed, T_world_left)
        prior = level_prior(up_world)
        fit = self._surfaces.add(surfaces, prior, [], is_new_view)
        if not self._settles(self._surfaces, fit):
            bases = self._viewer.bases(left, disparity, enough, T_world_left)
            fit = self._bases.add(bases, prior, self._surfaces.frames, is_new_view)
            self._settles(self._bases, fit)

    def _settles(self, search: PlaneSearch, fit: PlaneFit | None) -> bool:
        """Take over the plane of a search where it is known, and one that a robot can drive on."""
        if fit is not None and search.is_known() and self._is_possible(fit):
            self.mount = self._mount_of(fit.angles_height)
        return self.mount is not None

    def _is_possible(self, fit: PlaneFit) -> bool:
        """Return whether a robot drove on the plane: on its way the camera keeps its place above
        it. A hand does not, and on uneven ground or with a wrong plane nothing does.
        """
        if not plausible(fit.angles_height):
            return False
        height_m = float(fit.angles_height[2])
        normal = plane_of(fit.angles_height) * height_m
        poses = np.array(self._poses)
        heights_m = height_m + poses[:, :3, 3] @ normal
        seen = angles_height_of((normal @ poses[:, :3, :3]) / heights_m[:, None])
        spread = seen.std(axis=0) / (1.0, 1.0, height_m)
        return bool(heights_m.min() > 0 and (spread < SWAY).all())


def level_prior(up: Up | None) -> tuple[Array, Array]:
    """Return what pitch, roll and height (3,) are expected, and their standard deviations: a floor
    is level as an accelerometer has it.
    """
    if up is None:
        return np.zeros(3), LEVEL_SIGMA
    sigma = math.hypot(up.sigma_rad, _FLOOR_SLOPE)
    return angles_height_of(up.direction), np.array([sigma, sigma, math.inf])


class PlaneSearch:
    """Finds the plane that the samples of the last frames lie on, anew with each frame; the best
    guesses of earlier frames compete with those of the newest one.
    """

    def __init__(self, known: Array) -> None:
        self._known = known
        self._rng = np.random.default_rng(0)
        self._guesses = np.zeros((0, 3))
        self._looks = 0
        self.frames: list[Samples] = []
        self.fits: list[PlaneFit] = []
        self._before = self.frames, self.fits

    def add(
        self,
        samples: Samples,
        prior: tuple[Array, Array],
        contrary: list[Samples],
        is_new_view: bool = True,
    ) -> PlaneFit | None:
        """Take in the samples of a frame and return the plane, None where none is plausible.

        prior: pitch, roll and height (3,) that are expected, and their standard deviations.
        contrary: further samples, which can but speak against a plane, by lying below it.
        is_new_view: else the samples take the place of those of the last view.
        """
        if is_new_view:
            self._before = self.frames, self.fits
        if len(samples.weight) < _LEAST_SAMPLES or samples.weight.sum() < 1:
            return None
        self.frames, self.fits = self._before
        frames = self.frames = [*self.frames, samples][-_MAX_FRAMES:]
        mean, sigma = prior
        positions = np.array([frame.position_m for frame in frames])
        travel = positions[1:] - positions[:1]
        travel = travel[np.linalg.norm(travel, axis=1) > 0.05]
        fresh = propose(samples, _PROPOSALS, self._rng, self._known)
        guesses = np.concatenate([self._guesses, fresh])
        if len(guesses) == 0:
            return None
        some = _thinned(frames)
        total = np.sum([scores(few, guesses) for few in some], axis=0)
        for few in _thinned(contrary):
            total += np.minimum(scores(few, guesses), 0)
        total = np.maximum(total, 0) * preference(guesses, travel, mean, _SURE * sigma)
        order = np.argsort(-total, kind='stable')[:_KEPT]
        # Frames that show the same err together: the prior counts once per frame, too.
        sigma = sigma / math.sqrt(len(frames))
        fit = refine(some, guesses[order[0]], self._known, travel, mean, sigma)
        if contrary:
            below = max(fit.violations, shares(contrary, fit.angles_height)[1])
            fit = replace(fit, violations=below)
        self._guesses = np.concatenate([fit.angles_height[None], guesses[order]])
        self._guesses = self._guesses[plausible(self._guesses)]
        self.fits = [*self.fits, fit]
        self._looks += 1
        return fit

    def is_known(self) -> bool:
        """Return whether the last plane is known: by its own covariance and by how much it varies
        from frame to frame, as what is wrong in all frames of a scene is in no covariance. One view
        is enough where that of a single one is much smaller. In the end a plane that is off by some
        per cent is better than none.
        """
        fit, count = self.fits[-1], len(self.fits)
        is_late = self._looks >= MAX_KEYFRAMES
        sigma = fit.sigma / (1.0, 1.0, fit.angles_height[2])
        if count > 1 or (_SURE * sigma > _SIGMA).any():
            recent = np.array([one.angles_height for one in self.fits[-LOOKS:]])
            sigma = np.hypot(sigma, recent.std(axis=0) / (1.0, 1.0, fit.angles_height[2]))
            if count < LOOKS and not is_late:
                return False
        limit = _SIGMA * (2 if is_late else 1)
        return fit.is_seen and bool((sigma < limit).all())


def _thinned(frames: list[Samples]) -> list[Samples]:
    step = math.ceil(sum(len(frame.weight) for frame in frames) / _COMPARED)
    return [frame.every(max(1, step)) for frame in frames]


def disagreement(used: Mount, seen: Mount) -> str | None:
    """Return in words how the mount in use differs from the one that the floor shows, or None
    where they agree.
    """
    parts = []
    if abs(used.height_m - seen.height_m) > _HEIGHT_TOLERANCE * seen.height_m:
        parts.append(f'height {used.height_m:.3f} m, the floor shows {seen.height_m:.3f} m')
    for name in ('pitch', 'roll'):
        given = math.degrees(getattr(used, f'{name}_rad'))
        measured = math.degrees(getattr(seen, f'{name}_rad'))
        if abs(given - measured) > _TILT_TOLERANCE_DEG:
            parts.append(f'{name} {given:.1f} deg, the floor shows {measured:.1f} deg')
    if not parts:
        return None
    return (
        'camera mount: ' + '; '.join(parts) + '; correct the tf to the camera, or the parameters '
        'camera_height_m, camera_pitch_rad and camera_roll_rad of stereo_slam; or where these are '
        'right, the baseline and the focal length of the calibration'
    )


class MountCheck:
    """Measures the mount beside its use, once. A wrong one tilts the map or shifts its heights.
    problem: in words, with the numbers, how both differ, once that is known.
    """

    def __init__(self, camera: StereoCamera, mount: Mount) -> None:
        self._mount = mount
        self._estimator = MountEstimator(camera, forward_m=mount.forward_m, left_m=mount.left_m)
        self._T_first_map: Array | None = None
        self._keyframes = 0
        self.problem: str | None = None

    def add(self, left: NDArray[np.uint8], right: NDArray[Any], T_map_base: Array) -> None:
        """Use a keyframe: rectified images (H, W), or of a depth camera its disparity in place of
        the right one, and the base's pose (4, 4).
        """
        if self._estimator.mount is not None or self._keyframes >= MAX_KEYFRAMES:
            return
        T_map_left = T_map_base @ self._mount.T_base_left
        if self._T_first_map is None:
            self._T_first_map = invert(T_map_left)
        self._estimator.add(left, right, self._T_first_map @ T_map_left)
        self._keyframes += 1
        seen = self._estimator.mount
        self.problem = None if seen is None else disagreement(self._mount, seen)


class MountViewer:
    """Looks at the rectified pairs of one camera; only the first is matched in full."""

    def __init__(self, camera: StereoCamera) -> None:
        self._camera = camera
        searched = disparity_range(camera, None)
        self._first: DisparityMatcher | None = DisparityMatcher(searched)
        self._matcher = TwoScaleMatcher(searched)
        self._fine_rows = camera.height if column_step(camera) == 1 else 0

    def disparity(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the disparities (H, W) of a pair, 0 where there is no match."""
        first, self._first = self._first, None
        if first is not None:
            return first.compute(left, right)
        return self._matcher.compute(left, right, self._fine_rows)

    def surfaces(
        self,
        left: NDArray[np.uint8],
        disparity: NDArray[np.float32],
        enough: float | None,
        T_world_left: Array,
    ) -> Samples:
        """Return samples of all that has texture. enough: what is no noise; None where depth is
        measured, which needs none.
        """
        # Matched at half the resolution two rows share a disparity: odd steps meet both alike.
        step = max(2, round(math.sqrt(left.size / 2 / SAMPLES))) | 1
        part = np.s_[step // 2 :: step, step // 2 :: step]
        at = pixels_where(disparity[part] >= 1)
        rows, columns = (step // 2 + step * index for index in at)
        weight: Array = np.ones(len(rows))
        shown_at: NDArray[np.number] = rows
        if enough is not None:
            slope, block = texture_grey(left, 1), (BLOCK_PX, BLOCK_PX)
            texture = cv2.blur(slope, block)[rows, columns]
            weight = texture_weight(texture, MORE_TEXTURE * enough)
            # A disparity is that of the texture in its block, and belongs where that is.
            slope *= np.arange(len(left), dtype=np.float32)[:, None]
            shown_at = cv2.blur(slope, block)[rows, columns] / np.maximum(texture, 1e-6)
        above, below = (
            disparity[np.clip(rows + by, 0, len(left) - 1), columns] for by in (-BLOCK_PX, BLOCK_PX)
        )
        rise = np.where((above > 0) & (below > 0), (below - above) / (2 * BLOCK_PX), 0.0)
        return self._placed(shown_at, columns, disparity[rows, columns], weight, T_world_left, rise)

    def bases(
        self,
        left: NDArray[np.uint8],
        disparity: NDArray[np.float32],
        enough: float,
        T_world_left: Array,
    ) -> Samples:
        """Return samples of where upright things stand on blank floor."""
        rows, columns, found_px = find_bases(left, disparity, enough)
        weight = np.full(len(rows), _BASE_WEIGHT)
        return self._placed(rows, columns, found_px, weight, T_world_left)

    def _placed(
        self,
        rows: NDArray[np.number],
        columns: NDArray[np.integer],
        disparity_px: NDArray[np.floating],
        weight: Array,
        T_world_left: Array,
        rise: Array | None = None,
    ) -> Samples:
        uv_px = np.stack([columns, rows], axis=1).astype(np.float64)
        found_px = disparity_px.astype(np.float64)
        return Samples.of(self._camera, uv_px, found_px, weight, T_world_left, rise)


def find_bases(
    left: NDArray[np.uint8], disparity_px: NDArray[np.float32], enough: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.floating]]:
    """Return rows, columns (N,) and disparities (N,) of where upright things stand on blank floor
    in an image (H, W) of known disparities (H, W), 0 for none. enough: texture that is no noise.
    """
    image, disparity = left[:, ::STEP_PX], disparity_px[:, ::STEP_PX]
    texture = texture_grey(left, TEXTURE_WINDOW_PX)[:, ::STEP_PX]
    slope = row_slope(image)
    strongest = cv2.dilate(slope, np.ones((_AROUND_ROWS, 1), np.uint8))
    base = (slope == strongest) & (slope >= EDGE_SLOPE)
    base &= _below((texture < 1.5 * enough).astype(np.float32))
    counted = ((disparity >= 1) & (texture > 2 * enough)).astype(np.float32)
    window = (_UPRIGHT_COLUMNS, _UPRIGHT_ROWS)
    mean, variance, share = surface_above(disparity, counted, window, _UPRIGHT_GAP)
    base &= (share > _UPRIGHT_SHARE) & (variance < _UPRIGHT_SPREAD_PX**2)
    base[-_BLANK_GAP - _BLANK_ROWS :] = False
    rows, columns = np.nonzero(base)
    return rows, STEP_PX * columns, mean[rows, columns]


def _below(blank: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Tell of each pixel whether what is below it is blank (H, W)."""
    mean = cv2.blur(blank, (1, _BLANK_ROWS), anchor=(0, 0))
    below = np.zeros(blank.shape, np.bool_)
    below[:-_BLANK_GAP] = mean[_BLANK_GAP:] > 0.95
    return below
