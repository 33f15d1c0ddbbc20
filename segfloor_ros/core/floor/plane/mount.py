"""The camera's height, pitch and roll, measured from the floor it sees.

Two things show a floor: the plane on which what has texture lies, and the base of what stands on
it. A floor of one colour shows nothing that both cameras see alike, but below the lower edge of a
textured upright surface there is nothing but blank floor, and the disparity of the surface places
that edge. Both are samples of one plane, which is known once its covariance says so.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import StereoCamera, is_disparity
from segfloor_ros.core.camera.pixels import noise_grey
from segfloor_ros.core.contracts import Mount, Up
from segfloor_ros.core.floor.disparity.matching import (
    BLOCK_PX,
    NOISE_PX,
    SIGMAS,
    TwoScaleMatcher,
    disparity_range,
    equal_exposure,
    refined,
)
from segfloor_ros.core.floor.disparity.profile import (
    STEP_PX,
    column_step,
    first_floor_row,
    last_fine_row,
    pixels_where,
    surface_above,
)
from segfloor_ros.core.floor.pair import (
    EDGE_SLOPE,
    TEXTURE_WINDOW_PX,
    enough_texture,
    row_slope,
    texture_grey,
)
from segfloor_ros.core.floor.plane.plane import (
    FINER_SCALES_PX,
    HEIGHT_RANGE_M,
    LEVEL_SIGMA,
    LOOKS,
    PROPOSALS,
    SAMPLES,
    SURE,
    SWAY,
    PlaneFit,
    Samples,
    angles_height_of,
    mean_climb,
    plane_of,
    plausible,
    refine,
    scores,
    shares,
)
from segfloor_ros.core.geometry import Array, invert

Image = NDArray[np.uint8]
Disparities = NDArray[np.float32]

_USUAL = np.array([0.0, 0.0, 0.3])
"""Pitch, roll and height while nothing is known."""
_KEPT = 40
"""So many guesses are kept for the next frame."""
_COMPARED = 6000
"""So many samples of all frames together are compared with a plane: neighbours err together."""
_LEAST_SAMPLES = 20
_NEAR_SHARE = 2.0
"""What is nearer than a floor at half the height of the mount is not looked for."""
_LEAST_NOISE_GREY = 0.5
"""Grey levels are rounded, and the eyes differ: no image is less noisy."""
_SIGMA = np.array([math.radians(0.8), math.radians(2.0), 0.03])
"""How well pitch, roll and height, as a share of it, must be known: the map is redone should they
turn out to be others.
"""
_FLOOR_SLOPE = math.radians(1.5)
"""Floors on which robots start are level, more or less."""
_TOLERANCE = np.array([math.radians(1.0), math.radians(1.0), 0.03])
"""A mount whose pitch, roll or height, as a share of it, are off by less does no harm."""
MAX_KEYFRAMES = 20
"""So many looks a plane is made of at most, a mount is changed by, and it is looked at again. Where
so many do not show the floor well enough, half as well will do.
"""

_IS_WRONG = (
    'correct the tf to the camera, or the parameters camera_height_m, camera_pitch_rad and '
    'camera_roll_rad of stereo_slam; or where these are right, the baseline and the focal length '
    'of the calibration'
)
_IS_REDONE = 'the map is made anew with what it shows'

_ODD = (
    (
        (-1.0, -1.0, 1.0),
        1.0,
        'what is level lies {height:.1f} m above the camera: a ceiling, or the camera hangs upside '
        'down; then turn its images by 180 deg and exchange both eyes',
    ),
    (
        (1.0, 1.0, 1.0),
        0.125,
        'a level floor is seen {height:.1f} m below the camera, where none is mounted; correct the '
        'baseline, the focal length or the unit of the depth',
    ),
)
"""Planes that no mount has: axes that the camera would have, the scale of its world, and words."""

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
    """Measures the mount over the first keyframes, and looks at it again on the way, whether it was
    measured or is given.

    known values are kept and only the others measured; NaN where not known. given: the mount, where
    all is known, which is never changed. mount: in use, None while it is not known; one that was
    measured changes where later looks show another. remark: in words, with the numbers, how both
    differ. Deterministic: the same frames give the same mount.
    """

    def __init__(
        self,
        camera: StereoCamera,
        height_m: float = math.nan,
        pitch_rad: float = math.nan,
        roll_rad: float = math.nan,
        forward_m: float = 0.0,
        left_m: float = 0.0,
        given: Mount | None = None,
    ) -> None:
        self._known = np.array([pitch_rad, roll_rad, height_m])
        self._offset = (forward_m, left_m)
        self._viewer = MountViewer(camera)
        self.mount = self._given = given
        self._sigma: Array = np.zeros(3)
        self.remark: str | None = None
        self.reset()

    def use(self, mount: Mount) -> None:
        """Take a mount for given."""
        self.mount = self._given = mount

    def reset(self) -> None:
        """Forget all frames: the next ones are of another world."""
        self._surfaces, self._bases = PlaneSearch(self._known), PlaneSearch(self._known)
        self._poses: list[Array] = []
        self._looks_again = 0

    @property
    def is_final(self) -> bool:
        """Whether the mount is known, and was looked at often enough."""
        return self._looks_again >= MAX_KEYFRAMES

    @property
    def may_change(self) -> bool:
        """Whether later looks may show another mount."""
        return self._given is None and not self.is_final

    @property
    def provisional(self) -> Mount:
        """The mount as it seems so far, at first a level camera at a usual height."""
        for search in (self._bases, self._surfaces):
            if search.fit is not None and self._is_possible(search.fit):
                return self._mount_of(search.fit.angles_height)
        return self._mount_of(np.where(np.isnan(self._known), _USUAL, self._known))

    def _mount_of(self, angles_height: Array) -> Mount:
        pitch, roll, height = (float(value) for value in angles_height)
        return Mount(height, pitch, roll, *self._offset)

    def add(
        self,
        left: Image,
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
        if self.is_final:
            return
        self._looks_again += self.mount is not None
        self._poses = [*(self._poses if is_new_view else self._poses[:-1]), T_world_left]
        self._viewer = viewer = self._viewer.for_mount(self.mount)
        noise, is_measured = noise_grey(left), is_disparity(right)
        right = np.nan_to_num(right, nan=0.0) if is_measured else equal_exposure(left, right)
        left, right = left[viewer.first_row :], right[viewer.first_row :]
        disparity: NDArray[Any] = right if is_measured else viewer.disparity(left, right)
        seen = None if is_measured else max(noise, _LEAST_NOISE_GREY)
        surfaces = viewer.surfaces(left, right, disparity, seen)
        prior, travel = level_prior(up_world, T_world_left), self._travel()
        fit = self._surfaces.add(surfaces, prior, travel, [], is_new_view)
        if not self._settles(self._surfaces, fit):
            bases = viewer.bases(left, disparity, enough_texture(noise))
            fit = self._bases.add(bases, prior, travel, self._surfaces.frames, is_new_view)
            self._settles(self._bases, fit)
        if self.mount is None and len(self._poses) == MAX_KEYFRAMES:
            self.remark = self._odd_plane()

    def _odd_plane(self) -> str | None:
        """Return in words the plane that is seen but that no mount has; None without one."""
        for axes, scale, words in _ODD:
            frames = [
                replace(frame, rays=frame.rays * axes, disparity_m=frame.disparity_m * scale)
                for frame in _thinned(self._surfaces.frames)
            ]
            search = PlaneSearch(self._known)
            travel = self._travel() * axes * scale
            fit = search.add(Samples.joined(frames), level_prior(None, np.eye(4)), travel, [])
            if fit is not None and search.is_known():
                height_m = float(fit.angles_height[2]) / scale
                if scale == 1 or height_m > HEIGHT_RANGE_M[1]:
                    return f'camera mount: {words.format(height=height_m)}'
        return None

    def _travel(self) -> Array:
        """Return how far the camera has come (T, 3) m, in its own axes at the end of each way."""
        poses = np.array(self._poses[-MAX_KEYFRAMES:])
        way = poses[1:, :3, 3] - poses[:1, :3, 3]
        own = np.einsum('nji,nj->ni', poses[1:, :3, :3], way)
        return own[np.linalg.norm(own, axis=1) > 0.05]

    def _settles(self, search: PlaneSearch, fit: PlaneFit | None) -> bool:
        """Take over the plane of a search where it is known, one that a robot can drive on, and
        none that agrees with the mount in use.
        """
        if fit is None or not (search.is_known() and self._is_possible(fit)):
            return False
        seen, is_given = self._mount_of(fit.angles_height), self._given is not None
        sigma, words = fit.sigma, None
        # A robot sways: what is to be changed takes more looks than one.
        if self.mount is not None and (is_given or len(search.frames) >= MAX_KEYFRAMES):
            words = disagreement(self.mount, seen, np.hypot(sigma, self._sigma))
        if words is not None:
            self.remark = f'camera mount: {words}; {_IS_WRONG if is_given else _IS_REDONE}'
        if self.mount is None or (words is not None and not is_given):
            self.mount, self._sigma = seen, sigma
        return True

    def _is_possible(self, fit: PlaneFit) -> bool:
        """Return whether a robot drove on the plane: on its way the camera keeps its place above
        it. A hand does not, and on uneven ground or with a wrong plane nothing does.
        """
        if not plausible(fit.angles_height):
            return False
        height_m = float(fit.angles_height[2])
        normal = plane_of(fit.angles_height) * height_m
        poses = np.array(self._poses[-MAX_KEYFRAMES:])
        poses = invert(poses[0]) @ poses
        heights_m = height_m + poses[:, :3, 3] @ normal
        seen = angles_height_of((normal @ poses[:, :3, :3]) / heights_m[:, None])
        spread = seen.std(axis=0) / (1.0, 1.0, height_m)
        return bool(heights_m.min() > 0 and (spread < SWAY).all())


def level_prior(up: Up | None, T_world_left: Array) -> tuple[Array, Array]:
    """Return what pitch, roll and height (3,) are expected of a camera at a pose (4, 4), and their
    standard deviations: a floor is level as an accelerometer has it in the world.
    """
    if up is None:
        return np.zeros(3), LEVEL_SIGMA
    sigma = math.hypot(up.sigma_rad, _FLOOR_SLOPE)
    level = angles_height_of(T_world_left[:3, :3].T @ up.direction)
    return level, np.array([sigma, sigma, math.inf])


class PlaneSearch:
    """Finds the plane below a camera on which the samples of its last frames lie, each in the
    camera's own axes: there the floor always is, and all else is now here, now there. It is looked
    for anew with each frame; the best guesses of earlier frames compete with those of the newest.
    """

    def __init__(self, known: Array) -> None:
        self._known = known
        self._rng = np.random.default_rng(0)
        self._guesses = np.zeros((0, 3))
        self._looks = 0
        self.frames: list[Samples] = []
        self.fit: PlaneFit | None = None
        self._before = self.frames

    def add(
        self,
        samples: Samples,
        prior: tuple[Array, Array],
        travel: Array,
        contrary: list[Samples],
        is_new_view: bool = True,
    ) -> PlaneFit | None:
        """Take in the samples of a frame and return the plane, None where none is plausible.

        prior: pitch, roll and height (3,) that are expected, and their standard deviations.
        travel: (T, 3), ways in metres along which the floor runs. contrary: further samples, which
        can but speak against a plane, by lying below it. is_new_view: else the samples take the
        place of those of the last view.
        """
        if is_new_view:
            self._before = self.frames
        if len(samples.weight) < _LEAST_SAMPLES or samples.weight.sum() < 1:
            return None
        frames = self.frames = [*self._before, samples][-MAX_KEYFRAMES:]
        mean, sigma = prior
        fresh = propose(samples, PROPOSALS, self._rng, self._known)
        guesses = np.concatenate([self._guesses, fresh])
        if len(guesses) == 0:
            return None
        some, others = _thinned(frames), _thinned(contrary)
        total = np.sum([scores(few, guesses) for few in some], axis=0)
        for few in others:
            total += np.minimum(scores(few, guesses), 0)
        total = np.maximum(total, 0) * preference(guesses, travel, mean, SURE * sigma)
        order = np.argsort(-total, kind='stable')[:_KEPT]
        # Frames that show the same err together: the prior counts once per frame, too.
        sigma = sigma / math.sqrt(len(frames))
        fit = refine(Samples.joined(some), guesses[order[0]], self._known, travel, mean, sigma)
        near = [frame.near(fit.angles_height) for frame in frames]
        finer = self._finer(near, fit.angles_height, travel, (mean, sigma))
        groups = [Samples.joined(few) for few in (some, others) if few]
        seen = [shares(few, finer.angles_height) for few in groups]
        fit = replace(finer, support=seen[0][0], violations=max(below for _, below in seen))
        self._guesses = np.concatenate([fit.angles_height[None], guesses[order]])
        self._guesses = self._guesses[plausible(self._guesses)]
        self._looks += 1
        self.fit = fit
        if self.is_known():
            self.fit = replace(fit, sigma=np.hypot(fit.sigma, self._scatter(near, fit, prior)))
        return self.fit

    def _finer(
        self, near: list[Samples], start: Array, travel: Array, prior: tuple[Array, Array]
    ) -> PlaneFit:
        """Return a plane (3,) that is nearly known, refined by all samples of frames near it."""
        return refine(Samples.joined(near), start, self._known, travel, *prior, FINER_SCALES_PX)

    def _scatter(self, frames: list[Samples], fit: PlaneFit, prior: tuple[Array, Array]) -> Array:
        """Return the standard deviations (3,) of a plane by how much those of parts of the drive
        differ: what is wrong in all samples of a scene is in no covariance of theirs (batch means).
        """
        if len(frames) < LOOKS:
            return np.zeros(3)
        ends = np.linspace(0, len(frames), LOOKS + 1).astype(int)
        mean, sigma = prior[0], prior[1] * math.sqrt(LOOKS / len(frames))
        still = np.zeros((0, 3))
        planes = [
            self._finer(frames[first:end], fit.angles_height, still, (mean, sigma))
            for first, end in pairwise(ends)
        ]
        return np.std([plane.angles_height for plane in planes], axis=0, ddof=1) / math.sqrt(LOOKS)

    def is_known(self) -> bool:
        """Return whether the last plane is known, by what varies within a frame and over the drive.
        Before that can vary it must be known four times better. In the end any view will do, and a
        plane that is off by some per cent is better than none.
        """
        if self.fit is None:
            return False
        is_late = self._looks >= MAX_KEYFRAMES
        sure = 1.0 if is_late or len(self.frames) >= LOOKS else SIGMAS * SIGMAS
        sigma = sure * self.fit.sigma / (1.0, 1.0, self.fit.angles_height[2])
        return self.fit.is_seen and bool((sigma < _SIGMA * (2 if is_late else 1)).all())


def _thinned(frames: list[Samples]) -> list[Samples]:
    step = math.ceil(sum(len(frame.weight) for frame in frames) / _COMPARED)
    return [frame.every(max(1, step)) for frame in frames]


def disagreement(used: Mount, seen: Mount, sigma: Array) -> str | None:
    """Return in words how the mount in use differs from the one that the floor shows, by more than
    does harm and than its standard deviations (3,) of pitch, roll and height explain; None where
    they agree.
    """
    scale = np.array([1.0, 1.0, seen.height_m])
    own, other = (
        np.array([mount.pitch_rad, mount.roll_rad, mount.height_m]) for mount in (used, seen)
    )
    pitch, roll, height = np.abs(own - other) > np.maximum(_TOLERANCE * scale, SIGMAS * sigma)
    parts = []
    if height:
        parts.append(f'height {used.height_m:.3f} m, the floor shows {seen.height_m:.3f} m')
    for name, is_other in (('pitch', pitch), ('roll', roll)):
        if is_other:
            degrees = (math.degrees(getattr(mount, f'{name}_rad')) for mount in (used, seen))
            parts.append('{} {:.1f} deg, the floor shows {:.1f} deg'.format(name, *degrees))
    return '; '.join(parts) or None


class MountViewer:
    """Looks at the rectified pairs of one camera: with a mount only at the rows that can show its
    floor, from first_row on.
    """

    def __init__(self, camera: StereoCamera, mount: Mount | None = None) -> None:
        self._camera, self._mount = camera, mount
        self.first_row = 0 if mount is None else first_floor_row(camera, mount)
        self._matcher = TwoScaleMatcher(disparity_range(camera, mount, _NEAR_SHARE))
        last_fine = camera.height if mount is None else last_fine_row(camera, mount)
        self._fine_rows = last_fine - self.first_row if column_step(camera) == 1 else 0

    def for_mount(self, mount: Mount | None) -> MountViewer:
        """Return one that looks at the floor below a mount."""
        return self if mount == self._mount else MountViewer(self._camera, mount)

    def disparity(self, left: Image, right: Image) -> Disparities:
        """Return the disparities (R, W) of these rows of a pair, 0 where there is no match."""
        return self._matcher.compute(left, right, self._fine_rows)

    def surfaces(
        self, left: Image, right: Image, disparity: Disparities, noise: float | None
    ) -> Samples:
        """Return samples of all that has texture. noise: of the images, in grey levels; None where
        depth is measured, which needs no texture.
        """
        # Matched at half the resolution two rows share a disparity: odd steps meet both alike.
        step = max(2, round(math.sqrt(self._camera.width * self._camera.height / 2 / SAMPLES))) | 1
        part = np.s_[step // 2 :: step, step // 2 :: step]
        rows, columns = (step // 2 + step * index for index in pixels_where(disparity[part] >= 1))
        above, below = (
            disparity[np.clip(rows + by, 0, len(left) - 1), columns] for by in (-BLOCK_PX, BLOCK_PX)
        )
        rise = np.where((above > 0) & (below > 0), (below - above) / (2 * BLOCK_PX), 0.0)
        if noise is None:
            return self._placed(rows, columns, disparity[rows, columns], np.ones(len(rows)), rise)
        row, column, found_px, sigma = refined(left, right, disparity, noise, (rows, columns))
        weight = 1.0 / (1.0 + (sigma / NOISE_PX) ** 2)
        return self._placed(row, column, found_px, weight, rise)

    def bases(self, left: Image, disparity: Disparities, enough: float) -> Samples:
        """Return samples of where upright things stand on blank floor."""
        rows, columns, found_px = find_bases(left, disparity, enough)
        return self._placed(rows, columns, found_px, np.full(len(rows), _BASE_WEIGHT))

    def _placed(
        self,
        rows: NDArray[np.number],
        columns: NDArray[np.number],
        found_px: NDArray[np.floating],
        weight: Array,
        rise: Array | None = None,
    ) -> Samples:
        uv_px = np.stack([columns, rows + self.first_row], axis=1).astype(np.float64)
        return Samples.of(self._camera, uv_px, found_px.astype(float), weight, rise)


def find_bases(
    left: Image, disparity_px: Disparities, enough: float
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


def propose(samples: Samples, count: int, rng: np.random.Generator, known: Array) -> Array:
    """Return plausible pitch, roll and height (M, 3) of planes through few samples each.

    Half of them go through three samples, half through two, without roll. known: (3,), values
    that are given, NaN where not.
    """
    probability = samples.weight / samples.weight.sum()
    chosen = rng.choice(len(samples.weight), size=(count, 3), p=probability)
    q = samples.rays[chosen]
    inverse_depth = samples.disparity_px[chosen] / samples.disparity_m
    rows = q.copy()
    half = count // 2
    rows[half:, 2] = (1.0, 0.0, 0.0)
    inverse_depth[half:, 2] = 0.0
    regular = np.abs(np.linalg.det(rows)) > 1e-6
    planes = np.linalg.solve(rows[regular], -inverse_depth[regular][..., None])[..., 0]
    planes = planes[np.isfinite(planes).all(axis=1) & (np.abs(planes).max(axis=1) > 1e-6)]
    guesses = np.where(np.isnan(known), angles_height_of(planes), known)
    return guesses[plausible(guesses)]


def preference(angles_height: Array, travel: Array, mean: Array, sigma: Array) -> Array:
    """Return how far each plane (M, 3) is what one expects, in (0, 1]: pitch, roll and height (3,)
    with their standard deviations, and a camera that travels (T, 3), in metres, parallel to it.
    """
    squares = (((angles_height - mean) / sigma) ** 2).sum(axis=1)
    return np.exp(-0.5 * (squares + mean_climb(angles_height, travel) ** 2))
