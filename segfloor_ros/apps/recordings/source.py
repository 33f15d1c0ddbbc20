"""What every source of stereo pairs has in common: masks that may go with its frames, decoding
ahead, and the left and right images of a recording joined by their stamps, in their order.
"""

from __future__ import annotations

import logging
import re
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.calibration import StereoCalibration
from segfloor_ros.core.camera.images import EightBitScale, to_grey
from segfloor_ros.core.camera.model import StereoCamera, is_disparity
from segfloor_ros.core.camera.pixels import Grey
from segfloor_ros.core.camera.recording import DEPTH, RawPair, RecordedSensor
from segfloor_ros.core.camera.rectification import StereoRectifier
from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.core.errors import CalibrationError, CorruptImageError, InputError
from segfloor_ros.core.files.images import check_same_size, read_mask
from segfloor_ros.nodes.shared.joining import Stamped, StampJoiner
from segfloor_ros.nodes.shared.stamp_order import AGREEING, InTime, StampOrder

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
        check_same_size(mask, self._shape, path)
        return mask


@dataclass(frozen=True)
class PairEntry:
    """A pair that has not been decoded yet. `load` returns both grey images, the left one with its
    colours (H, W, 3), BGR, where the source takes them; it raises CorruptImageError where one of
    them is damaged. A depth camera has a disparity for the right one.
    """

    index: int
    stamp_ns: int
    load: Callable[[], tuple[Grey, NDArray[Any]]]


class StereoSource:
    """A recording or device as a sequence of stereo pairs with one calibration.

    name: of the recording, for messages. calibration: of the raw pairs. read: gets this source and
    yields its pairs in order, without decoding them. takes_colour: whether frames have colours,
    where the camera has them. camera: the rectified one. frame_count: pairs expected, None when
    unknown. rate_hz: frames per second.
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
        sensors: Sequence[RecordedSensor] = (),
    ) -> None:
        self.name = name
        self.sensors = sensors
        self.calibration = calibration
        self._read = read
        self.frame_count = frame_count
        self.rate_hz = rate_hz
        self.masks: MaskFolder | None = None
        self.takes_colour = False
        self._part = slice(0, None)
        self.skipped_frames = 0
        self._warned_of: dict[str, str] = {}
        self._has_read_pair = self._has_read_mask = False
        self._eight_bit = EightBitScale()
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

    def mask(self, index: int) -> NDArray[np.uint8] | None:
        """Return the mask (H, W) of what moves in a raw frame, None where there is none."""
        return None if self.masks is None else self.masks.read(index)

    def _check_first_pair(self) -> None:
        """Read up to the first good pair: its size must be the calibration's, its pixels tell the
        bit depth.
        """
        if next(self._decoded(), None) is None:
            reasons = ''.join(f'; {reason}' for reason in self._warned_of.values())
            raise InputError(f'{self.name}: no pair of images in it can be read{reasons}')

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
        frames = map(self._rectified_pair, self._decoded())
        return (frame for frame in frames if frame is not None)

    def _rectified_pair(self, pair: RawPair) -> StereoFrame | None:
        """Return a pair rectified; None where its mask cannot be read, and others could."""
        try:
            mask = self.mask(pair.index)
        except InputError as error:
            if not self._has_read_mask:
                raise
            self.skip(pair.index, str(error))
            return None
        self._has_read_mask |= mask is not None
        left, right = self._rectifier.rectify(pair.left, pair.right)
        excluded = self._rectifier.rectify_mask(mask) if mask is not None else None
        colour = None if pair.colour is None else self._rectifier.rectify_colour(pair.colour)
        return StereoFrame(pair.index, pair.stamp_ns, left, right, excluded, colour)

    def _decoded(self) -> Iterator[RawPair]:
        pairs = map(self._decoded_pair, self.entries())
        return (pair for pair in pairs if pair is not None)

    def _decoded_pair(self, entry: PairEntry) -> RawPair | None:
        try:
            left, right = entry.load()
        except CorruptImageError as error:
            self.skip(entry.index, str(error))
            return None
        is_depth = is_disparity(right)
        for image, kind in (
            (left, 'frame'),
            (right, 'the depth image of frame' if is_depth else 'frame'),
        ):
            what = f'{self.name}: {kind} {entry.index}'
            try:
                self.calibration.check_size(image.shape[1], image.shape[0], what)
            except CalibrationError as error:
                if not self._has_read_pair:
                    raise
                self.skip(entry.index, str(error))
                return None
        self._has_read_pair = True
        colour, left = left if left.ndim == 3 else None, to_grey(left)
        if is_depth:
            left, right = self._eight_bit(left, left)[0], right.astype(np.float32, copy=False)
        else:
            left, right = self._eight_bit(left, right)
        if colour is not None:
            colour = self._eight_bit(colour, colour)[0]
        return RawPair(entry.index, entry.stamp_ns, left, right, colour)

    @cached_property
    def _rectifier(self) -> StereoRectifier:
        return StereoRectifier(self.calibration)

    def skip(self, index: int, reason: str) -> None:
        """Count a pair that is left out, with a warning for the first one of a kind."""
        self.skipped_frames += 1
        kind = re.sub(r'[0-9]+', '', reason)
        if kind not in self._warned_of:  # recordings are read more than once
            self._warned_of[kind] = reason
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


def check_forward(where: str, last_ns: Sequence[int], stamp_ns: int) -> None:
    """Raise InputError when `stamp_ns` is earlier than the last one, if there was one."""
    if last_ns and stamp_ns < last_ns[-1]:
        raise InputError(
            f'{where}: the stamp goes backwards, from {last_ns[-1] / 1e9:.9f} s to '
            f'{stamp_ns / 1e9:.9f} s; cut the recording there and use one part'
        )


class StampPairing(Generic[T]):
    """Pairs the images of a recording, and yields the pairs in the order of their stamps.

    Images are added in the order of their arrival, side 0 the left, side 1 the right. A pair that
    comes one place late is put where it belongs; where the clock went backwards, several in a row
    say so, an InputError. At most `limit` images wait. names: of both sides, for messages.

    pairs, and by side: unpaired, images without a partner; duplicates, images with a stamp that
    was there before; elsewhere, single images with a stamp that is far from those around it.
    """

    def __init__(self, tolerance_s: float, names: tuple[str, str], limit: int = 64) -> None:
        self.pairs = 0
        self.unpaired = [0, 0]
        self.duplicates = [0, 0]
        self.elsewhere = [0, 0]
        self._tolerance_s = tolerance_s
        self._names = names
        self._joiner = StampJoiner(names, limit, round(tolerance_s * 1e9))
        self._latest: list[list[int]] = [[], []]
        self._orders = StampOrder(), StampOrder()
        self._uncertain: tuple[list[tuple[int, T]], list[tuple[int, T]]] = [], []
        self._alone: list[list[int]] = [[], []]
        self._held: list[tuple[Stamped[T], Stamped[T]]] = []

    def add(self, side: int, stamp_ns: int, item: T) -> Iterator[tuple[Stamped[T], Stamped[T]]]:
        """Take in an image and yield the pairs that are complete now, but the last one."""
        order, uncertain = self._orders[side], self._uncertain[side]
        found = order.take(stamp_ns)
        if found is InTime.ELSEWHERE:
            uncertain.append((stamp_ns, item))
        surplus = len(uncertain) - (
            AGREEING - 1 if found is InTime.JUMPED else len(order.elsewhere_ns)
        )
        self.elsewhere[side] += surplus
        del uncertain[:surplus]
        if found is InTime.JUMPED:
            for one in uncertain:
                yield from self._add(side, *one)
            uncertain.clear()
        if found is not InTime.ELSEWHERE:
            yield from self._add(side, stamp_ns, item)

    def _add(self, side: int, stamp_ns: int, item: T) -> Iterator[tuple[Stamped[T], Stamped[T]]]:
        latest, name = self._latest[side], self._names[side]
        if stamp_ns in latest:
            self.duplicates[side] += 1
            return
        if len(latest) == 2:
            check_forward(name, latest[:1], stamp_ns)
        self._latest[side] = sorted([*latest, stamp_ns])[-2:]
        pair = self._joiner.add(name, stamp_ns, Stamped(stamp_ns, item))
        self._count_dropped()
        if pair is not None:
            self.pairs += 1
            self._held.append((pair[self._names[0]], pair[self._names[1]]))
            self._held.sort(key=lambda both: both[0].stamp_ns)
            if len(self._held) > 1:
                yield self._held.pop(0)

    def finish(self) -> Iterator[tuple[Stamped[T], Stamped[T]]]:
        """Yield the last pair; nothing is added after this."""
        for side in (0, 1):
            self.elsewhere[side] += len(self._uncertain[side])
        yield from self._held
        self._joiner.give_up()
        self._count_dropped()

    def report(self) -> None:
        """Warn of images that were left out. Raises InputError when there was no pair at all."""
        names = f'{self._names[0]} and {self._names[1]}'
        if not self.pairs:
            alone = sorted((ns, side) for side in (0, 1) for ns in self._alone[side])
            apart = (b - a for (a, one), (b, other) in pairwise(alone) if one != other)
            gap_ns = min(apart, default=None)
            nearest = '' if gap_ns is None else f'; the nearest are {gap_ns / 1e9:.6f} s apart'
            raise InputError(
                f'{names}: no two images within {self._tolerance_s:g} s{nearest}; are both '
                'cameras on one clock? else raise stereo_camera.pairing_tolerance_s'
            )
        if any(self.unpaired):
            logger.warning('%s: %d and %d images have no partner', names, *self.unpaired)
        if any(self.duplicates):
            logger.warning('%s: %d and %d images came twice', names, *self.duplicates)
        if any(self.elsewhere):
            logger.warning(
                '%s: %d and %d images have a stamp of another time', names, *self.elsewhere
            )

    def _count_dropped(self) -> None:
        for dropped in self._joiner.take_dropped():
            side = 1 - self._names.index(dropped.missing[0])
            self.unpaired[side] += 1
            self._alone[side].append(dropped.stamp_ns)
