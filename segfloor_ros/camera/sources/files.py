"""Pairs of image files: what KITTI, EuRoC and plain image folders have in common."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from segfloor_ros.camera.calibration import StereoCalibration
from segfloor_ros.camera.images import CorruptImageError, Grey, decode_compressed
from segfloor_ros.camera.sources.sensor_files import check_shared_clock
from segfloor_ros.camera.sources.source import PairEntry, StereoSource
from segfloor_ros.camera.sources.stamps import rate_of
from segfloor_ros.errors import InputError
from segfloor_ros.measurements import RecordedSensor

IMAGE_SUFFIXES = {'.png', '.jpg', '.jpeg', '.bmp', '.pgm', '.ppm', '.tif', '.tiff', '.webp'}


@dataclass(frozen=True)
class FilePair:
    """Two image files of one moment; index: their number in the recording."""

    index: int
    stamp_ns: int
    left: Path
    right: Path


class FilePairSource(StereoSource):
    """A recording of image files."""

    def __init__(
        self,
        name: str,
        pairs: Sequence[FilePair],
        calibration: StereoCalibration,
        bit_depth: int,
        sensors: Sequence[RecordedSensor] = (),
    ) -> None:
        self._pairs = pairs
        stamps = [pair.stamp_ns for pair in pairs]
        super().__init__(
            name,
            calibration,
            frame_count=len(pairs),
            rate_hz=rate_of(stamps),
            bit_depth=bit_depth,
            sensors=sensors,
        )
        check_shared_clock(sensors, stamps)

    def _entries(self) -> Iterator[PairEntry]:
        last_ns = None
        for pair in self._pairs:
            if pair.stamp_ns == last_ns:
                self._skip(pair.index, f'its stamp {last_ns} ns was there before')
                continue
            last_ns = pair.stamp_ns
            yield PairEntry(pair.index, pair.stamp_ns, self._loader(pair))

    def _loader(self, pair: FilePair) -> Callable[[], tuple[Grey, NDArray[Any]]]:
        return lambda: (read_grey(pair.left), read_grey(pair.right))


def read_grey(path: Path) -> Grey:
    """Return the grey image (H, W), uint8 or uint16, of a file.

    Raises CorruptImageError naming the file when it is truncated or damaged, InputError when it
    cannot be read.
    """
    try:
        return decode_compressed(path.read_bytes())
    except CorruptImageError as error:
        raise CorruptImageError(f'{path}: {error}') from None
    except OSError as error:
        raise InputError(f'{path}: cannot read the image ({error.strerror})') from None


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
    return [(int(part), '') if part.isdigit() else (0, part) for part in parts]


def check_equal_numbers(name: str, left: Sequence[Path], right: Sequence[Path]) -> None:
    """Raise InputError unless there are as many left as right images, and at least one."""
    if not left and not right:
        raise InputError(f'{name}: there are no images in its folders')
    if len(left) != len(right):
        raise InputError(
            f'{name}: {len(left)} left and {len(right)} right images; every left image needs its '
            'right one: complete the copy, or remove the images without partner'
        )
