"""Stamps of recordings: read, checked and made; and two streams of images paired by them.

Names that stereo recordings give to their two sides.

Pairs of image files: what KITTI, EuRoC and plain image folders have in common.
"""

from __future__ import annotations

import logging
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.calibration.parameters import StereoCalibration
from segfloor_ros.camera.sources.sensor_files import check_shared_clock
from segfloor_ros.camera.sources.source import DEFAULT_RATE_HZ, PairEntry, StereoSource
from segfloor_ros.errors import InputError
from segfloor_ros.files.images import CorruptImageError, Grey, read_grey
from segfloor_ros.files.whole import nanoseconds, read_lines
from segfloor_ros.measurements import RecordedSensor

T = TypeVar('T')

logger = logging.getLogger(__name__)

SIDES = (
    ('left', 'right'),
    ('Left', 'Right'),
    ('LEFT', 'RIGHT'),
    ('infra1', 'infra2'),
    ('cam0', 'cam1'),
    ('cam_0', 'cam_1'),
    ('camera0', 'camera1'),
    ('camera_0', 'camera_1'),
    ('image0', 'image1'),
    ('image_00', 'image_01'),
    ('image_0', 'image_1'),
    ('image_02', 'image_03'),
    ('image_2', 'image_3'),
)
"""Words for left and right inside a name, the usual ones first."""

IMAGE_SUFFIXES = {'.png', '.jpg', '.jpeg', '.bmp', '.pgm', '.ppm', '.tif', '.tiff', '.webp'}


def read_times(path: Path) -> list[int]:
    """Return the stamps in ns of a file with one time in seconds per line.

    Raises InputError naming the line where one is no number or earlier than the one before.
    """
    stamps: list[int] = []
    for where, line in read_lines(path):
        try:
            stamp_ns = nanoseconds(line.split()[0])
        except ValueError as error:
            raise InputError(f'{where}: expected a time in seconds ({error})') from None
        check_forward(where, stamps[-1:], stamp_ns)
        stamps.append(stamp_ns)
    return stamps


def check_times(path: Path, stamps: Sequence[int], images: Sequence[Path]) -> None:
    """Raise InputError unless a file has as many times as there are left images."""
    if len(stamps) != len(images):
        raise InputError(
            f'{path}: {len(stamps)} times for {len(images)} pairs of images; it needs one line '
            'for each, or remove it to read the images at stereo_camera.rate_hz'
        )


def check_forward(where: str, last_ns: Sequence[int], stamp_ns: int) -> None:
    """Raise InputError when `stamp_ns` is earlier than the last one, if there was one."""
    if last_ns and stamp_ns < last_ns[-1]:
        raise InputError(
            f'{where}: the stamp goes backwards, from {last_ns[-1] / 1e9:.9f} s to '
            f'{stamp_ns / 1e9:.9f} s; cut the recording there and use one part'
        )


def stamps_of_rate(count: int, rate_hz: float) -> list[int]:
    """Return `count` stamps in ns from 0 on at `rate_hz`, or at the usual rate where that is 0."""
    return [round(i * 1e9 / (rate_hz or DEFAULT_RATE_HZ)) for i in range(count)]


def rate_of(stamps_ns: Sequence[int]) -> float:
    """Return the frame rate in Hz of ascending stamps: of their median interval."""
    intervals = np.diff(stamps_ns)
    intervals = intervals[intervals > 0]
    return float(1e9 / np.median(intervals)) if intervals.size else DEFAULT_RATE_HZ


@dataclass(frozen=True)
class Stamped(Generic[T]):
    """Something with a stamp."""

    stamp_ns: int
    item: T


class StampPairing(Generic[T]):
    """Pairs each image with the nearest of the other side, if that is within the tolerance.

    Images are added in the order of their arrival, side 0 the left, side 1 the right. One that
    comes one place late on its side is put where it belongs; one that comes later still means
    that the clock went backwards, an InputError. A side waits for the other with at most
    `limit` images. names: of both sides, for messages.

    pairs, and by side: unpaired, images without a partner; duplicates, images with a stamp that
    was there before.
    """

    def __init__(self, tolerance_s: float, names: tuple[str, str], limit: int | None = 64) -> None:
        self.pairs = 0
        self.unpaired = [0, 0]
        self.duplicates = [0, 0]
        self._smallest_gap_ns: int | None = None
        self._tolerance_ns = round(tolerance_s * 1e9)
        self._names = names
        self._limit = limit
        self._queues: tuple[deque[Stamped[T]], deque[Stamped[T]]] = deque(), deque()
        self._latest: list[list[int]] = [[], []]
        self._closing = False

    def add(self, side: int, stamp_ns: int, item: T) -> Iterator[tuple[Stamped[T], Stamped[T]]]:
        """Take in an image and yield the pairs that are complete now."""
        latest, queue = self._latest[side], self._queues[side]
        if stamp_ns in latest:
            self.duplicates[side] += 1
            return
        if len(latest) == 2:
            check_forward(self._names[side], latest[:1], stamp_ns)
        late = bool(latest) and stamp_ns < latest[-1]
        # The last image of a side stays in its queue, so a late one always finds its place.
        queue.insert(len(queue) - 1 if late else len(queue), Stamped(stamp_ns, item))
        self._latest[side] = sorted([*latest, stamp_ns])[-2:]
        yield from self._complete_pairs()
        if self._overflows(side):
            self._drop(side)

    def finish(self) -> Iterator[tuple[Stamped[T], Stamped[T]]]:
        """Yield the last pairs; nothing is added after this."""
        self._closing = True
        yield from self._complete_pairs()
        for side in (0, 1):
            while self._queues[side]:
                self._drop(side)

    def report(self) -> None:
        """Warn of images that were left out. Raises InputError when there was no pair at all."""
        names = f'{self._names[0]} and {self._names[1]}'
        if not self.pairs:
            gap = self._smallest_gap_ns
            nearest = '' if gap is None else f'; the nearest are {gap / 1e9:.6f} s apart'
            raise InputError(
                f'{names}: no two images within {self._tolerance_ns / 1e9:g} s{nearest}; are both '
                'cameras on one clock? else raise stereo_camera.pairing_tolerance_s'
            )
        if any(self.unpaired):
            logger.warning('%s: %d and %d images have no partner', names, *self.unpaired)
        if any(self.duplicates):
            logger.warning('%s: %d and %d images came twice', names, *self.duplicates)

    def _complete_pairs(self) -> Iterator[tuple[Stamped[T], Stamped[T]]]:
        left, right = self._queues
        while self._decidable(0) and self._decidable(1):
            gap_ns = left[0].stamp_ns - right[0].stamp_ns
            early = 0 if gap_ns < 0 else 1
            if self._next_is_nearer(early):
                self._drop(early)
            elif abs(gap_ns) <= self._tolerance_ns:
                self.pairs += 1
                yield left.popleft(), right.popleft()
            else:
                self._smallest_gap_ns = min(abs(gap_ns), self._smallest_gap_ns or abs(gap_ns))
                self._drop(early)

    def _decidable(self, side: int) -> bool:
        """Whether the first image of a side can be paired: its successor, which might fit better,
        is there, or need not be waited for.
        """
        count = len(self._queues[side])
        return count > 1 or (count == 1 and (self._closing or self._overflows(1 - side)))

    def _overflows(self, side: int) -> bool:
        return self._limit is not None and len(self._queues[side]) > self._limit

    def _next_is_nearer(self, early: int) -> bool:
        queue, target_ns = self._queues[early], self._queues[1 - early][0].stamp_ns
        if len(queue) < 2:
            return False
        return abs(queue[1].stamp_ns - target_ns) < abs(queue[0].stamp_ns - target_ns)

    def _drop(self, side: int) -> None:
        self._queues[side].popleft()
        self.unpaired[side] += 1


def side_pairs(names: Iterable[str]) -> list[tuple[str, str]]:
    """Return the (left, right) names that differ only in the word for the side, in the order of
    `SIDES`, then of `names`.
    """
    known = list(names)
    pairs: dict[tuple[str, str], None] = {}
    for left_word, right_word in SIDES:
        for name in known:
            partner = name.replace(left_word, right_word)
            if partner != name and partner in known:
                pairs[name, partner] = None
    return list(pairs)


def is_side(name: str, side: int) -> bool:
    """Whether `name` says, in letters, that it is the left (0) or the right (1) side."""
    return ('left', 'right')[side] in name.lower()


@dataclass(frozen=True)
class FilePair:
    """Two image files of one moment; index: their number in the recording."""

    index: int
    stamp_ns: int
    left: Path
    right: Path


def file_pair_source(
    name: str,
    pairs: Sequence[FilePair],
    calibration: StereoCalibration,
    bit_depth: int,
    sensors: Sequence[RecordedSensor] = (),
    read_right: Callable[[Path], NDArray[Any]] | None = None,
) -> StereoSource:
    """Return a recording of image files. read_right: of what stands in place of the right images.
    Raises InputError.
    """

    def entries(source: StereoSource) -> Iterator[PairEntry]:
        last_ns = None
        for pair in pairs:
            if pair.stamp_ns == last_ns:
                source.skip(pair.index, f'its stamp {last_ns} ns was there before')
                continue
            last_ns = pair.stamp_ns
            yield PairEntry(pair.index, pair.stamp_ns, partial(load, pair))

    def load(pair: FilePair) -> tuple[Grey, NDArray[Any]]:
        return read_grey(pair.left), (read_right or read_grey)(pair.right)

    stamps = [pair.stamp_ns for pair in pairs]
    source = StereoSource(
        name,
        calibration,
        entries,
        frame_count=len(pairs),
        rate_hz=rate_of(stamps),
        bit_depth=bit_depth,
        sensors=sensors,
    )
    check_shared_clock(sensors, stamps)
    return source


def read_index(index: Path, parse: Callable[[str, str], Stamped[Path]]) -> list[Stamped[Path]]:
    """Return the images that the lines of a file name, those with `#` in front left out. parse:
    gets the line and what to call it. Raises InputError, also for stamps that go backwards.
    """
    entries: list[Stamped[Path]] = []
    for where, line in read_lines(index):
        entry = parse(line, where)
        check_forward(where, [e.stamp_ns for e in entries[-1:]], entry.stamp_ns)
        entries.append(entry)
    return entries


def pairs_by_stamp(
    left: Sequence[Stamped[Path]],
    right: Sequence[Stamped[Path]],
    tolerance_s: float,
    names: tuple[str, str],
) -> list[FilePair]:
    """Return the images of two lists that belong together. names: of both, for messages. Raises
    InputError where there are none.
    """
    pairing: StampPairing[Path] = StampPairing(tolerance_s, names, limit=None)
    matches = [
        *(pair for image in left for pair in pairing.add(0, image.stamp_ns, image.item)),
        *(pair for image in right for pair in pairing.add(1, image.stamp_ns, image.item)),
        *pairing.finish(),
    ]
    pairing.report()
    return [
        FilePair(i, one.stamp_ns, one.item, other.item) for i, (one, other) in enumerate(matches)
    ]


def first_image_size(paths: Sequence[Path], name: str) -> tuple[int, int]:
    """Return (width, height) of the first image that can be decoded. Raises InputError."""
    for path in paths:
        try:
            height, width = read_grey(path).shape
        except CorruptImageError:
            continue
        return width, height
    raise InputError(f'{name}: none of its {len(paths)} images can be decoded')


def images_in(folder: Path) -> list[Path]:
    """Return the image files of a folder in natural order: `left2` before `left10`."""
    files = (path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    return sorted((path for path in files if not path.name.startswith('.')), key=natural_key)


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Return a sort key that reads runs of digits as numbers."""
    parts = re.split(r'(\d+)', path.name.casefold())
    return [(int(part), '') if part.isdecimal() else (0, part) for part in parts]


def check_equal_numbers(name: str, left: Sequence[Path], right: Sequence[Path]) -> None:
    """Raise InputError unless there are as many left as right images, and at least one."""
    if not left and not right:
        raise InputError(f'{name}: there are no images in its folders')
    if len(left) != len(right):
        raise InputError(
            f'{name}: {len(left)} left and {len(right)} right images; every left image needs its '
            'right one: complete the copy, or remove the images without partner'
        )
