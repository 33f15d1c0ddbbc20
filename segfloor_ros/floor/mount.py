"""The camera's height, pitch and roll, measured from the floor it sees."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.disparity import DisparityMatcher, disparity_range, stereo_view
from segfloor_ros.floor.mirror import (
    MIRRORED_SHARE,
    MirrorView,
    mirror_candidates,
    mirrored_share,
)
from segfloor_ros.floor.plane import (
    PlaneFit,
    Samples,
    mean_climb,
    plausible,
    preference,
    propose,
    refine,
    scores,
    with_known,
)
from segfloor_ros.geometry import Array

_MAX_FRAMES = 12
_SAMPLES_PER_FRAME = 4000
_PROPOSALS = 600
_KEPT = 60
_SCORED_EVERY = 5
_PLAIN_SUPPORT = 0.3
_WEAK_SUPPORT = 0.08
_MAX_VIOLATIONS = 0.05
_REST = 5
"""So many keyframes in a row must agree where the floor is not plain to see."""
_LEVEL_SIGMA = np.array([np.inf, math.radians(2.0), np.inf])
"""Cameras are mounted level, more or less: with little floor in view, roll is least certain."""
_HEIGHT_TOLERANCE = 0.05
_TILT_TOLERANCE_DEG = 1.0
_MAX_CLIMB = 3.0
"""Sigmas by which the path may leave the floor: a plane that the robot drives into is none."""
_NEARER = 0.8
"""A mirror at so much of the height of what looks like the floor lies clearly above it."""
_TEXTURE_GREY = 1.2
"""Horizontal grey gradient per pixel below which a disparity is mostly invented."""


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
    return 'camera mount: ' + '; '.join(parts) if parts else None


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
        self._camera = camera
        self._known = np.array([pitch_rad, roll_rad, height_m])
        self._offset = (forward_m, left_m)
        self._views: list[MirrorView] = []
        self._guesses = np.zeros((0, 3))
        self._matcher = DisparityMatcher(disparity_range(camera, None))
        self._rng, self._mirror_rng = (np.random.default_rng(seed) for seed in (0, 1))
        self._fits: list[PlaneFit] = []
        self._settled = False

    @property
    def mount(self) -> Mount | None:
        """The mount of the first camera pose, None until the evidence suffices."""
        if not self._settled:
            return None
        pitch, roll, height = (float(value) for value in self._fits[-1].angles_height)
        return Mount(height, pitch, roll, *self._offset)

    def add(self, left: NDArray[np.uint8], right: NDArray[np.uint8], T_world_left: Array) -> None:
        """Use one more rectified grey pair (H, W) uint8.

        T_world_left: pose (4, 4) of the camera in a frame whose origin is the first camera's.
        """
        if self._settled:
            return
        view = self._view(left, right, T_world_left)
        samples = view.samples
        if len(samples.weight) < 50 or samples.weight.sum() < 1:
            return
        self._views = [*self._views, view][-_MAX_FRAMES:]
        fresh = propose(samples, _PROPOSALS, self._rng, self._known)
        guesses = np.concatenate([with_known(self._guesses, self._known), fresh])
        if len(guesses) == 0:
            return
        # A few samples tell which guess is best; all of them refine it.
        few = [frame.every(_SCORED_EVERY) for frame in self._frames]
        total = np.sum([scores(frame, guesses) for frame in few], axis=0)
        total = np.maximum(total, 0) * preference(guesses, self._travel())
        order = np.argsort(-total, kind='stable')[:_KEPT]
        self._guesses = guesses[order]
        fit = self._refined(self._guesses[0])
        self._guesses = np.concatenate([fit.angles_height[None], self._guesses])
        fit = self._mirror(fit) or fit
        self._fits.append(fit)
        self._settled = self._suffices(fit)

    @property
    def _frames(self) -> list[Samples]:
        return [view.samples for view in self._views]

    def _refined(self, start: Array) -> PlaneFit:
        # Frames that show the same err together: the prior counts once per frame, too.
        sigma = _LEVEL_SIGMA / math.sqrt(len(self._views))
        none, known = np.zeros(3), self._known
        return refine(
            self._frames, start, known, self._travel(), prior_sigma=sigma, prior_mean=none
        )

    def _mirror(self, ordinary: PlaneFit) -> PlaneFit | None:
        """Return the plane that best mirrors what stands on it: of what is seen below it none
        speaks against it. It lies above the ordinary one, unless much is seen below that, too.
        """
        highest_m = _NEARER * ordinary.angles_height[2]
        starts = [*mirror_candidates(self._views, self._mirror_rng, self._known, self._travel())]
        if self._fits and self._fits[-1].is_mirror:
            starts.append(self._fits[-1].angles_height)
        if ordinary.violations > _MAX_VIOLATIONS:
            starts.append(ordinary.angles_height)
            highest_m = math.inf
        best, best_share = None, MIRRORED_SHARE
        for fit in map(self._refined, starts):
            if fit.angles_height[2] > highest_m:
                continue
            share = mirrored_share(self._views, fit.angles_height)
            if share > best_share:
                best, best_share = fit, share
        if best is None:
            return None
        seen = best.support / max(1 - best.violations, 1e-6)
        return replace(best, support=seen, violations=0.0, is_mirror=True)

    def _travel(self) -> Array:
        positions = np.array([frame.position_m for frame in self._frames])
        steps = positions[1:] - positions[:1]
        return steps[np.linalg.norm(steps, axis=1) > 0.05]

    def _suffices(self, fit: PlaneFit) -> bool:
        """Tell whether the floor is plain to see, or weaker evidence has come to rest."""
        climb = float(mean_climb(fit.angles_height[None], self._travel())[0])
        if climb > _MAX_CLIMB or not plausible(fit.angles_height):
            return False
        if fit.violations > _MAX_VIOLATIONS:
            return False
        certain = fit.sigma[2] < 0.015 * fit.angles_height[2]
        if fit.support > _PLAIN_SUPPORT and certain and fit.sigma[:2].max() < math.radians(0.2):
            return True
        if len(self._fits) < _REST or fit.support < _WEAK_SUPPORT:
            return False
        recent = np.array([past.angles_height for past in self._fits[-_REST:]])
        spread = np.ptp(recent, axis=0)
        return bool(
            certain
            and spread[2] < 0.03 * fit.angles_height[2]
            and spread[0] < math.radians(1.0)
            and spread[1] < math.radians(4.0)
        )

    def _view(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8], T_world_left: Array
    ) -> MirrorView:
        camera = self._camera
        right, measured = stereo_view(left, right)
        disparity = self._matcher.compute(left, right) if measured is None else measured
        smooth = cv2.GaussianBlur(left.astype(np.float32), (0, 0), 1.0)
        gradient = np.abs(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8))
        texture = cv2.blur(gradient, (9, 9))
        step = max(2, round(math.sqrt(left.size / 2 / _SAMPLES_PER_FRAME)))
        grid = disparity[step // 2 :: step, step // 2 :: step]
        rows, columns = (step // 2 + step * index for index in np.nonzero(grid >= 1))
        rays = camera.back_project(np.stack([columns, rows], axis=1), np.ones(len(rows)))
        grey = texture[rows, columns].astype(np.float64)
        weight = grey**4 / (grey**4 + _TEXTURE_GREY**4)
        if measured is not None:
            # A depth camera needs no texture.
            weight = np.ones(len(rows))
        samples = Samples(
            rays=rays @ T_world_left[:3, :3].T,
            position_m=T_world_left[:3, 3].astype(np.float64),
            disparity_px=disparity[rows, columns].astype(np.float64),
            weight=weight,
            disparity_m=camera.disparity_times_depth,
        )
        return MirrorView.of(camera, left, disparity, samples, T_world_left)
