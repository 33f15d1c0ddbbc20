"""Recordings decoded once, kept on disk, and varied: rate, size, noise, quantised disparities; and
their true paths, frame by frame.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.apps.evaluation.trajectory import read_truth
from segfloor_ros.apps.recordings import StereoSource
from segfloor_ros.apps.recordings.calibration_files import read_body_pose
from segfloor_ros.core.camera.model import StereoCamera, is_disparity
from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.core.geometry import Array, invert, make_transform
from segfloor_ros.core.twists import between
from segfloor_ros.nodes.configuration import resolve
from tools.driving import open_recording
from tools.plain_tracker import sgbm_disparity

CACHE = Path('~/.cache/segfloor_tools')
FORMAT = 1
"""Of the files of the cache; another number makes them anew."""

EXACT_S, DENSE_S = 1e-3, 0.12
"""A true pose is that of a frame within the one; between two that are no further apart than the
other, it is interpolated."""

STILL = ('euroc_tiny',)
"""Recordings whose camera stands still: that is their truth."""

SMALL_PX = 320, 240
NOISE_GREY = 4.0


@dataclasses.dataclass(frozen=True)
class Variant:
    """How frames are changed. every: only each n-th one. step_px: disparities in place of the right
    images, in steps of so many pixels, 0 as they are; None keeps the right images. noise_grey: of
    the images. small: shrunk to about 320×240, or to half where they are no larger.
    """

    every: int = 1
    step_px: float | None = None
    noise_grey: float = 0.0
    small: bool = False


VARIANTS = {
    'rate 1': Variant(),
    'rate 1/2': Variant(every=2),
    'rate 1/3': Variant(every=3),
    'rate 1/5': Variant(every=5),
    'depth': Variant(step_px=0.0),
    'half px': Variant(step_px=0.5),
    'whole px': Variant(step_px=1.0),
    'noise': Variant(noise_grey=NOISE_GREY),
    'small': Variant(small=True),
}


class Recorded:
    """A recording whose rectified frames, and the disparities of stereo pairs, are on disk once
    they were asked for.

    every, limit: each n-th frame of the recording, and at most so many of those; 0 for all.
    folder: of its files in the cache. depth: take its depth images in place of the right ones.
    fresh: make its files anew.
    """

    def __init__(
        self,
        path: Path,
        cache: Path,
        every: int = 1,
        limit: int = 0,
        depth: bool = False,
        fresh: bool = False,
    ) -> None:
        self.path, self.name = path, path.name + (' depth' if depth else '')
        self._every, self._limit = every, limit
        settings = {'input': str(path), 'depth': depth}
        self.source: StereoSource = open_recording(path, resolve(stereo_camera=settings))
        key = repr((FORMAT, str(path.resolve()), depth))
        folder = f'{self.name}-{hashlib.sha1(key.encode()).hexdigest()[:8]}'.replace(' ', '_')
        self.folder = cache.expanduser() / folder
        if fresh or not (self.folder / 'stamp_ns.npy').is_file():
            self._write()

    @property
    def part(self) -> str:
        """The part of the recording that is taken, for file names."""
        return f'every{self._every}-limit{self._limit}'

    @property
    def camera(self) -> StereoCamera:
        """The rectified camera."""
        return self.source.camera

    @property
    def has_depth(self) -> bool:
        """Whether frames have disparities in place of right images."""
        return is_disparity(self._stored('right'))

    def frames(self) -> list[StereoFrame]:
        """Return the rectified frames; their images are read from disk when they are looked at."""
        parts = (self._stored(name) for name in ('index', 'stamp_ns', 'left', 'right'))
        rows = zip(*(part[self._rows] for part in parts), strict=True)
        return [StereoFrame(int(i), int(stamp), left, right) for i, stamp, left, right in rows]

    @cached_property
    def disparities(self) -> NDArray[np.float32]:
        """The disparities (N, H, W) of the frames, px, NaN for none."""
        if self.has_depth:
            return np.asarray(self._stored('right')[self._rows])
        file = self.folder / 'disparity.npy'
        if not file.is_file():
            pairs = zip(self._stored('left'), self._stored('right'), strict=True)
            _save(file, [sgbm_disparity(np.asarray(a), np.asarray(b)) for a, b in pairs])
        return np.asarray(self._stored('disparity')[self._rows])

    @property
    def _rows(self) -> slice:
        return slice(None, self._limit * self._every or None, self._every)

    def _stored(self, name: str) -> NDArray[Any]:
        stored: NDArray[Any] = np.load(self.folder / f'{name}.npy', mmap_mode='r')
        return stored

    def _write(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        for file in self.folder.glob('*.np?'):
            file.unlink()
        frames = list(self.source.frames())
        for name in ('left', 'right', 'index', 'stamp_ns'):
            _save(self.folder / f'{name}.npy', [getattr(frame, name) for frame in frames])


@dataclasses.dataclass(frozen=True)
class Drive:
    """A variant of a recording: its camera, its frames, and their left images with disparities (px,
    NaN for none), which are made when they are asked for.
    """

    camera: StereoCamera
    frames: Sequence[StereoFrame]
    views: Callable[[], Iterator[tuple[NDArray[np.uint8], NDArray[np.float32]]]]


def vary(recorded: Recorded, variant: Variant) -> Drive | None:
    """Return a variant of a recording; None where it would be the recording itself: depth images
    that stay as they are, or less than three frames.
    """
    if variant.step_px == 0 and recorded.has_depth:
        return None
    frames = recorded.frames()[:: variant.every]
    if len(frames) < 3:
        return None
    if variant.small or variant.noise_grey:
        return _with_other_images(recorded.camera, frames, variant)

    def disparities() -> Iterator[NDArray[np.float32]]:
        for disparity in recorded.disparities[:: variant.every]:
            yield in_steps(disparity, variant.step_px or 0.0)

    if variant.step_px is not None:
        pairs = zip(frames, disparities(), strict=True)
        frames = [dataclasses.replace(frame, right=disparity) for frame, disparity in pairs]
    return Drive(
        recorded.camera,
        frames,
        lambda: zip((frame.left for frame in frames), disparities(), strict=True),
    )


def _with_other_images(
    camera: StereoCamera, frames: list[StereoFrame], variant: Variant
) -> Drive | None:
    if variant.small:
        camera, frames = shrunk(camera, frames)
    if variant.noise_grey:
        frames = [with_noise(frame, variant.noise_grey) for frame in frames]

    def views() -> Iterator[tuple[NDArray[np.uint8], NDArray[np.float32]]]:
        for frame in frames:
            has_depth = is_disparity(frame.right)
            yield frame.left, frame.right if has_depth else sgbm_disparity(frame.left, frame.right)

    return Drive(camera, frames, views)


def in_steps(disparity: NDArray[np.float32], step_px: float) -> NDArray[np.float32]:
    """Return disparities in steps of so many pixels, NaN where that is 0; 0 leaves them as they
    are.
    """
    if not step_px:
        return np.asarray(disparity)
    rounded = np.rint(disparity / np.float32(step_px)) * np.float32(step_px)
    return np.where(rounded > 0, rounded, np.float32(np.nan)).astype(np.float32)


def with_noise(frame: StereoFrame, sigma_grey: float) -> StereoFrame:
    """Return a frame whose images have noise, the same each time; a disparity stays as it is."""
    rng = np.random.default_rng(frame.index)

    def noisy(image: NDArray[Any]) -> NDArray[Any]:
        if is_disparity(image):
            return image
        off = rng.normal(0.0, sigma_grey, image.shape)
        return np.clip(np.rint(image + off), 0, 255).astype(np.uint8)

    return dataclasses.replace(frame, left=noisy(frame.left), right=noisy(frame.right))


def shrunk(
    camera: StereoCamera, frames: Sequence[StereoFrame]
) -> tuple[StereoCamera, list[StereoFrame]]:
    """Return a camera and its frames, so small that they just cover 320×240; or half as large where
    they are no larger than that.
    """
    scale = max(SMALL_PX[0] / camera.width, SMALL_PX[1] / camera.height)
    if scale >= 1:
        scale = 0.5
    size = round(camera.width * scale), round(camera.height * scale)
    sx, sy = size[0] / camera.width, size[1] / camera.height
    small = dataclasses.replace(
        camera, width=size[0], height=size[1], fx=camera.fx * sx, fy=camera.fy * sy,
        cx=(camera.cx + 0.5) * sx - 0.5, cy=(camera.cy + 0.5) * sy - 0.5,
    )  # fmt: skip

    def resized(image: NDArray[Any]) -> NDArray[Any]:
        image = np.asarray(image)
        if is_disparity(image):
            return cv2.resize(image, size, interpolation=cv2.INTER_NEAREST) * np.float32(sx)
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)

    return small, [
        dataclasses.replace(frame, left=resized(frame.left), right=resized(frame.right))
        for frame in frames
    ]


def true_poses(recorded: Recorded, stamp_ns: Sequence[int]) -> Array | None:
    """Return where the rectified left camera was (N, 4, 4) at stamps (N,), NaN where that is not
    known; None for a recording without such a truth.
    """
    if recorded.path.name in STILL:
        return np.tile(np.eye(4), (len(stamp_ns), 1, 1))
    file = next((f for f in _truth_files(recorded.path) if f.is_file()), None)
    if file is None:
        return None
    times_s, poses = read_truth(file)
    if file.name == 'truth.txt' and (recorded.path / 'mav0').is_dir():
        poses = poses @ read_body_pose(recorded.path / 'mav0' / 'cam0' / 'sensor.yaml')
    if file.name != 'poses.txt':
        poses = poses @ make_transform(recorded.source.calibration.left.R.T, np.zeros(3))
    return poses_at(times_s, poses, np.asarray(stamp_ns) * 1e-9)


def _truth_files(recording: Path) -> list[Path]:
    euroc = recording / 'mav0' / 'state_groundtruth_estimate0' / 'data.csv'
    return [recording / 'poses.txt', euroc, recording / 'truth.txt']


def poses_at(times_s: Array, poses: Array, wanted_s: Array) -> Array:
    """Return the poses (M, 4, 4) at some times (M,) of a path with times (N,) and poses (N, 4, 4):
    those of that time, or interpolated where the path is dense there; else NaN.
    """
    found = np.full((len(wanted_s), 4, 4), np.nan)
    for row, time_s in enumerate(wanted_s):
        after = int(np.searchsorted(times_s, time_s))
        near = [i for i in (after - 1, after) if 0 <= i < len(times_s)]
        gap_s = times_s[near[-1]] - times_s[near[0]]
        nearest = min(near, key=lambda i: abs(times_s[i] - time_s))
        if len(near) == 2 and gap_s <= DENSE_S:
            share = float((time_s - times_s[near[0]]) / gap_s)
            found[row] = between(poses[near[0]], poses[near[1]], share)
        elif abs(times_s[nearest] - time_s) <= EXACT_S:
            found[row] = poses[nearest]
    return found


def motions(poses: Array) -> Array:
    """Return the motions T_before_now (N, 4, 4) between poses (N, 4, 4); NaN for the first."""
    found = np.full_like(poses, np.nan)
    found[1:] = invert(poses[:-1]) @ poses[1:]
    return found


def distance_m(motion: Array) -> Array:
    """Return how far motions (N, 4, 4) lead (N,)."""
    return np.asarray(np.linalg.norm(motion[:, :3, 3], axis=1))


def _save(file: Path, arrays: Sequence[Any]) -> None:
    """Write arrays as one, complete or not at all."""
    part = file.with_suffix('.part.npy')
    np.save(part, np.array(arrays))
    part.replace(file)
