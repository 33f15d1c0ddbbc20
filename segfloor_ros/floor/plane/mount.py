"""The camera's height, pitch and roll, measured from the floor it sees.

Compares the camera's mount in use with the one that the first keyframes show of the floor.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera, Up
from segfloor_ros.floor.plane.mirror import (
    MIRRORED_SHARE,
    MirrorView,
    mirror_candidates,
    mirrored_share,
)
from segfloor_ros.floor.plane.mount_view import MountViewer, PlaneSearch
from segfloor_ros.floor.plane.plane_fit import (
    PlaneFit,
    Samples,
    angles_height_of,
    plane_of,
    plausible,
    shares,
)
from segfloor_ros.geometry import Array, invert

_USUAL = np.array([0.0, 0.0, 0.3])
"""Pitch, roll and height while nothing is known."""
_MAX_FRAMES = 12
_PROPOSALS_OF_FIRST, _PROPOSALS = 600, 200
_PLAIN_SUPPORT = 0.3
_WEAK_SUPPORT, _LITTLE_SUPPORT = 0.08, 0.2
_MAX_VIOLATIONS = 0.05
_REST = 5
"""So many keyframes in a row must agree where the floor is not plain to see."""
_LEAST_FEET, _ENOUGH_FEET = 20, 150
"""Feet of one keyframe that are worth a look, and those that a floor needs."""
_FEET_SUPPORT = 0.4
_FEET_REST, _AGAIN = 3, 3
_SAME = (0.03, math.radians(1.0), math.radians(2.0))
"""Planes whose height, as a share, pitch and roll differ by less are the same."""
_CONTRADICTED = 0.3
"""A plane below which such a share of the feet stands is no floor."""
_SIGMAS, _FEET_SIGMAS = (0.015, math.radians(0.2)), (0.025, math.radians(0.4))
"""How well height, as a share of it, and tilt must be known, one sigma."""
_PATIENCE, _FAIR_SIGMA = 20, 0.03
"""After so many keyframes the best plane so far will do, if its height is known to such a share:
a map that is off by some per cent is better than none.
"""
_HEIGHT_TOLERANCE = 0.05
_TILT_TOLERANCE_DEG = 1.0
_SWAY = (math.radians(2.0), math.radians(2.5), 0.04)
"""How much pitch, roll and height, as a share of it, of the camera above the floor vary on the way,
as standard deviations: robots sway, and where they are is known so well.
"""
_MIRROR_FIRST, _MIRROR_EVERY = 3, 4
"""A mirror is looked for in so many keyframes, and then in every so-manyth until one is found."""
_NEARER = 0.8
"""A mirror at so much of the height of what looks like the floor lies clearly above it."""

MAX_KEYFRAMES = 20
"""Where so many do not show the floor well enough, nothing is said."""


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

    Two searches run side by side: for the plane on which what has texture lies, and for the one on
    which upright things stand: of a floor of one colour their feet are all there is to see. known
    values are kept and only the others measured; NaN where not known. Deterministic: the same
    frames give the same mount.
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
        self._views: list[MirrorView] = []
        self._feet: list[Samples] = []
        self._rotations: list[Array] = []
        self._positions: list[Array] = []
        self._mirror_rng = np.random.default_rng(1)
        self._on_surfaces, self._on_feet = PlaneSearch(self._known), PlaneSearch(self._known)
        self._fits: list[PlaneFit] = []
        self._feet_fits: list[PlaneFit] = []
        self._fair: list[PlaneFit] = []
        self._settled: PlaneFit | None = None

    @property
    def mount(self) -> Mount | None:
        """The mount of the first camera pose, None until the evidence suffices."""
        return None if self._settled is None else self._mount_of(self._settled.angles_height)

    @property
    def provisional(self) -> Mount:
        """The mount as it seems so far, at first a level camera at a usual height."""
        for fit in (*self._feet_fits[-1:], *self._fits[-1:]):
            if self._is_possible(fit):
                return self._mount_of(fit.angles_height)
        return self._mount_of(np.where(np.isnan(self._known), _USUAL, self._known))

    def _mount_of(self, angles_height: Array) -> Mount:
        pitch, roll, height = (float(value) for value in angles_height)
        return Mount(height, pitch, roll, *self._offset)

    def add(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        T_world_left: Array,
        up_world: Up | None = None,
    ) -> None:
        """Use one more rectified grey pair (H, W) uint8.

        T_world_left: pose (4, 4) of the camera in a frame whose origin is the first camera's.
        up_world: where an accelerometer has up in that frame.
        """
        if self._settled is not None:
            return
        for search in (self._on_surfaces, self._on_feet):
            search.expect(up_world)
        self._rotations.append(T_world_left[:3, :3])
        self._positions.append(T_world_left[:3, 3])
        view = self._viewer.view(left, right, T_world_left)
        samples = view.surfaces.samples
        if len(samples.weight) < 50 or samples.weight.sum() < 1:
            return
        self._views = [*self._views, view.surfaces][-_MAX_FRAMES:]
        if len(view.feet.weight) >= _LEAST_FEET:
            self._feet = [*self._feet, view.feet][-_MAX_FRAMES:]
        proposals = _PROPOSALS if self._fits else _PROPOSALS_OF_FIRST
        fit = self._on_surfaces.find(self._frames, self._travel(), proposals, [])
        if fit is None:
            return
        if self._may_mirror():
            fit = self._mirror(fit) or fit
        self._fits.append(fit)
        if self._is_plain(fit):
            self._settled = fit
        else:
            self._settled = self._at_rest(fit) or self._stood_on(fit) or self._best_so_far()

    @property
    def _frames(self) -> list[Samples]:
        return [view.samples for view in self._views]

    def _may_mirror(self) -> bool:
        """Tell whether to look for a mirror: that is slow, and most floors are none. Below the feet
        of things a mirror shows these things, not a blank floor.
        """
        if len(self._fits) < _MIRROR_FIRST:
            return not self._feet or not self._fits
        found = any(fit.is_mirror for fit in self._fits)
        return not self._feet and (found or len(self._fits) % _MIRROR_EVERY == 0)

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
        for start in starts:
            fit = self._on_surfaces.refined(self._frames, start, self._travel())
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

    def _is_plain(self, fit: PlaneFit) -> bool:
        """Tell whether the floor is plain to see, and seen again where it was not at once."""
        plain = fit.support > _PLAIN_SUPPORT and _is_certain(fit, *_SIGMAS)
        plain &= self._is_possible(fit) and fit.violations <= _MAX_VIOLATIONS
        again = len(self._fits) == 1 or _rests(self._fits, _AGAIN, *_SAME)
        return plain and again

    def _stood_on(self, textured: PlaneFit) -> PlaneFit | None:
        """Return the plane on which things stand, once it has come to rest, where the floor itself
        has no texture by which to measure it.
        """
        if not self._feet or textured.support > _LITTLE_SUPPORT:
            return None
        fit = self._on_feet.find(self._feet, self._travel(), _PROPOSALS, self._frames)
        if fit is None:
            return None
        self._feet_fits.append(fit)
        enough = fit.support * sum(len(feet.weight) for feet in self._feet) > _ENOUGH_FEET
        if not enough or fit.support < _FEET_SUPPORT or not _is_certain(fit, *_FEET_SIGMAS):
            return None
        below = max(fit.violations, shares(self._frames, fit.angles_height)[1])
        if below > _MAX_VIOLATIONS or not self._is_possible(fit):
            return None
        rests = _rests(self._feet_fits, _FEET_REST, 0.02, math.radians(0.5), math.radians(1.0))
        return fit if rests else None

    def _at_rest(self, fit: PlaneFit) -> PlaneFit | None:
        """Return the plane of a floor of weak texture, once it has come to rest."""
        if fit.support < _WEAK_SUPPORT or fit.violations > _MAX_VIOLATIONS:
            return None
        if not _is_certain(fit, _FAIR_SIGMA, math.inf) or not self._is_possible(fit):
            return None
        if self._feet and shares(self._feet, fit.angles_height)[1] > _CONTRADICTED:
            return None
        if not _rests(self._fits, _REST, 0.03, math.radians(1.0), math.radians(4.0)):
            return None
        self._fair.append(fit)
        return fit if _is_certain(fit, _SIGMAS[0], math.inf) else None

    def _best_so_far(self) -> PlaneFit | None:
        """Return the plane that is known best of those that came to rest, after a while."""
        if len(self._fits) < _PATIENCE or not self._fair:
            return None
        best = min(self._fair, key=lambda fit: fit.sigma[2] / fit.angles_height[2])
        return best if self._is_possible(best) else None

    def _is_possible(self, fit: PlaneFit) -> bool:
        """Tell whether a robot drove on the plane: on its way the camera keeps its place above it.
        A hand does not, and on uneven ground or with a wrong plane nothing does.
        """
        if not plausible(fit.angles_height):
            return False
        height_m = float(fit.angles_height[2])
        normal = plane_of(fit.angles_height) * height_m
        rotations, positions = np.array(self._rotations), np.array(self._positions)
        heights_m = height_m + positions @ normal
        seen = angles_height_of((normal @ rotations) / heights_m[:, None])
        spread = seen.std(axis=0) / (1.0, 1.0, height_m)
        return bool(heights_m.min() > 0 and (spread < _SWAY).all())


def _is_certain(fit: PlaneFit, height: float, tilt_rad: float) -> bool:
    """Tell whether a plane is known so well, one sigma, the height within a share of it."""
    height_sigma = float(fit.sigma[2] / fit.angles_height[2])
    return height_sigma < height and float(fit.sigma[:2].max()) < tilt_rad


def _rests(
    fits: list[PlaneFit], count: int, height: float, pitch_rad: float, roll_rad: float
) -> bool:
    """Tell whether the last so many planes are the same, the height within a share of it."""
    recent = np.array([fit.angles_height for fit in fits[-count:]])
    spread = np.ptp(recent, axis=0)
    limits = (pitch_rad, roll_rad, height * recent[-1, 2])
    return len(recent) == count and bool((spread < limits).all())


class MountCheck:
    """Measures the mount beside its use, once. A wrong one tilts the map or shifts its heights."""

    def __init__(self, camera: StereoCamera, mount: Mount) -> None:
        self._mount = mount
        self._estimator = MountEstimator(camera, forward_m=mount.forward_m, left_m=mount.left_m)
        self._T_first_map: Array | None = None
        self._keyframes = 0
        self.is_done = False

    def add(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8], T_map_base: Array
    ) -> str | None:
        """Use a keyframe: rectified images (H, W) and the base's pose (4, 4). Returns in words how
        both mounts differ, with the numbers, once that is known.
        """
        T_map_left = T_map_base @ self._mount.T_base_left
        if self._T_first_map is None:
            self._T_first_map = invert(T_map_left)
        self._estimator.add(left, right, self._T_first_map @ T_map_left)
        self._keyframes += 1
        seen = self._estimator.mount
        self.is_done = seen is not None or self._keyframes >= MAX_KEYFRAMES
        return None if seen is None else disagreement(self._mount, seen)
