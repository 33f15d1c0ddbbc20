"""What every source of stereo pairs has in common: masks that may go with its frames, decoding
ahead, and the pairing of left and right images by their stamps.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.calibration.parameters import StereoCalibration
from segfloor_ros.camera.calibration.rectification import StereoRectifier
from segfloor_ros.camera.images import EightBitScale, is_disparity
from segfloor_ros.camera.model import DEPTH, RecordedSensor, StereoCamera, StereoFrame
from segfloor_ros.errors import InputError
from segfloor_ros.files.images import CorruptImageError, Grey, read_mask

PLAUSIBLE_HZ = 0.1, 1000.0
"""Pairs per second of a robot's camera; others come of times in another unit."""

DEFAULT_RATE_HZ = 10.0
"""Frame rate of a recording that has no stamps."""

logger = logging.getLogger(__name__)

T = TypeVar('T')

AHEAD = 3
"""Items prepared before they are asked for."""


class MaskFolder:
    """Masks `%06d.png` by frame index, of the left image as recorded, 255 = moving. A frame
    without a file has nothing that moves.
    """

    def __init__(self, folder: Path, camera: StereoCamera) -> None:
        if not folder.is_dir():
            raise InputError(f'{folder}: no such folder; give --masks a folder of %06d.png')
        if next(folder.glob('[0-9]*.png'), None) is None:
            raise InputError(f'{folder}: holds no masks; they are named by frame, e.g. 000012.png')
        self._folder = folder
        self._shape = (camera.height, camera.width)

    def read(self, index: int) -> NDArray[np.uint8] | None:
        """Return the mask (H, W) uint8 of a frame, or None where there is none.

        Raises InputError for a file that is no such mask.
        """
        path = self._folder / f'{index:06d}.png'
        if not path.exists():
            return None
        mask = read_mask(path)
        if mask.shape != self._shape:
            found, expected = (f'{shape[1]}x{shape[0]}' for shape in (mask.shape, self._shape))
            raise InputError(f'{path}: is {found}, but the images are {expected}')
        return mask


@dataclass(frozen=True)
class RawPair:
    """One grey pair as the camera saw it, not rectified: images (H, W) uint8, the pair's number
    in its recording, its stamp in ns.
    """

    index: int
    stamp_ns: int
    left: NDArray[np.uint8]
    right: NDArray[Any]


@dataclass(frozen=True)
class PairEntry:
    """A pair that has not been decoded yet. `load` returns both grey images; it raises
    CorruptImageError where one of them is damaged. A depth camera has a disparity for the right
    one.
    """

    index: int
    stamp_ns: int
    load: Callable[[], tuple[Grey, NDArray[Any]]]


class StereoSource:
    """A recording or device as a sequence of stereo pairs with one calibration.

    name: of the recording, for messages. calibration: of the raw pairs. read: gets this source and
    yields its pairs in order, without decoding them. camera: the rectified
    one. frame_count: pairs expected, None when unknown. rate_hz: frames per second.
    skipped_frames: pairs left out so far because an image was damaged or the stamp was there
    before. sensors: what else was found in the recording. masks: of what moves, where given.
    """

    def __init__(
        self,
        name: str,
        calibration: StereoCalibration,
        read: Callable[[StereoSource], Iterator[PairEntry]],
        *,
        frame_count: int | None,
        rate_hz: float,
        bit_depth: int = 0,
        sensors: Sequence[RecordedSensor] = (),
    ) -> None:
        self.name = name
        self.sensors = sensors
        self.calibration = calibration
        self._read = read
        self.frame_count = frame_count
        self.rate_hz = rate_hz
        self.masks: MaskFolder | None = None
        self._part = slice(0, None)
        self.skipped_frames = 0
        self._warned_of: set[int] = set()
        self._eight_bit = EightBitScale(bit_depth)
        self._check_first_pair()
        slowest, fastest = PLAUSIBLE_HZ
        if not slowest <= rate_hz <= fastest:
            logger.warning(
                '%s: %.3g s from pair to pair; times must be in seconds, where their name does not '
                'say otherwise', name, 1 / rate_hz,
            )  # fmt: skip

    @property
    def camera(self) -> StereoCamera:
        """The rectified stereo camera."""
        return self.calibration.camera

    @property
    def takes_depth(self) -> bool:
        """Whether depth images stand in place of the right ones."""
        return any(sensor.name == DEPTH and sensor.used for sensor in self.sensors)

    def cut(self, start: int, frames: int, every: int) -> None:
        """Read a part of the recording only: from frame `start` on, so many frames (0: all), every
        n-th one. Frames keep their index. Raises InputError where it ends before.
        """
        self._part = slice(start, start + frames * every if frames else None, every)
        if self.frame_count is not None:
            if start >= self.frame_count:
                raise InputError(
                    f'{self.name}: has {self.frame_count} frames; --start {start} is behind its end'
                )
            self.frame_count = len(range(self.frame_count)[self._part])

    def frames(self) -> Iterator[StereoFrame]:
        """Yield the rectified pairs in order of their stamps; the next ones are prepared
        meanwhile on one background thread.

        Raises InputError or CalibrationError where the recording is inconsistent.
        """
        return prefetched(self._rectified())

    def raw_pairs(self) -> Iterator[RawPair]:
        """Yield the pairs of `frames()` unrectified; they belong to `calibration`."""
        return prefetched(self._decoded())

    def _check_first_pair(self) -> None:
        """Read up to the first good pair: its size must be the calibration's, its pixels tell the
        bit depth.
        """
        if next(self._decoded(), None) is None:
            raise InputError(f'{self.name}: no pair of images in it can be read')

    def entries(self) -> Iterator[PairEntry]:
        """Yield the pairs of `frames()`, not decoded yet."""
        self.skipped_frames = 0
        part = self._part
        return islice(self._read(self), part.start, part.stop, part.step)

    def frame(self, entry: PairEntry) -> StereoFrame | None:
        """Return a pair rectified; None where it is damaged and left out."""
        pair = self._decoded_pair(entry)
        return None if pair is None else self._rectified_pair(pair)

    def _rectified(self) -> Iterator[StereoFrame]:
        return (self._rectified_pair(pair) for pair in self._decoded())

    def _rectified_pair(self, pair: RawPair) -> StereoFrame:
        left, right = self._rectifier.rectify(pair.left, pair.right)
        mask = self.masks.read(pair.index) if self.masks is not None else None
        excluded = self._rectifier.rectify_mask(mask) if mask is not None else None
        return StereoFrame(pair.index, pair.stamp_ns, left, right, excluded)

    def _decoded(self) -> Iterator[RawPair]:
        pairs = map(self._decoded_pair, self.entries())
        return (pair for pair in pairs if pair is not None)

    def _decoded_pair(self, entry: PairEntry) -> RawPair | None:
        try:
            left, right = entry.load()
        except CorruptImageError as error:
            self.skip(entry.index, str(error))
            return None
        for image in (left, right):
            what = f'{self.name}: frame {entry.index}'
            self.calibration.check_size(image.shape[1], image.shape[0], what)
        if is_disparity(right):
            left, right = self._eight_bit(left, left)[0], right.astype(np.float32, copy=False)
        else:
            left, right = self._eight_bit(left, right)
        return RawPair(entry.index, entry.stamp_ns, left, right)

    @cached_property
    def _rectifier(self) -> StereoRectifier:
        return StereoRectifier(self.calibration)

    def skip(self, index: int, reason: str) -> None:
        """Count a pair that is left out, with a warning."""
        self.skipped_frames += 1
        if index not in self._warned_of:  # recordings are read more than once
            self._warned_of.add(index)
            logger.warning('%s: frame %d is skipped: %s', self.name, index, reason)


def prefetched(items: Generator[T, None, None] | Iterator[T]) -> Iterator[T]:
    """Yield `items` in order, prepared on one background thread.

    Errors are raised where their item would have come. The thread ends with the last item, with
    an error, and when the consumer stops early.
    """
    end = object()
    worker = ThreadPoolExecutor(1, 'images')
    pending: deque[Future[object]] = deque()
    try:
        while True:
            while len(pending) < AHEAD:
                pending.append(worker.submit(next, items, end))
            item = pending.popleft().result()
            if item is end:
                return
            yield item  # type: ignore[misc]
    finally:
        worker.shutdown(cancel_futures=True)
        if isinstance(items, Generator):
            items.close()
