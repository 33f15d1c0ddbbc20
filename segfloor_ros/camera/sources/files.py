"""Pairs of image files: what KITTI, EuRoC and plain image folders have in common."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from segfloor_ros.camera.calibration.parameters import StereoCalibration
from segfloor_ros.camera.sources.pairing import Stamped, StampPairing, check_forward, rate_of
from segfloor_ros.camera.sources.sensor_files import check_shared_clock
from segfloor_ros.camera.sources.source import PairEntry, StereoSource
from segfloor_ros.errors import InputError
from segfloor_ros.files.images import CorruptImageError, Grey, read_grey
from segfloor_ros.files.tables import read_lines
from segfloor_ros.measurements import RecordedSensor

IMAGE_SUFFIXES = {'.png', '.jpg', '.jpeg', '.bmp', '.pgm', '.ppm', '.tif', '.tiff', '.webp'}


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
