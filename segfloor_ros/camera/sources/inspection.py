"""What a recording is and whether it will do: its streams with rates and gaps, the calibration, the
sensors, and what the check of the rig says of some pairs spread over it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from segfloor_ros.camera.model import RecordedSensor
from segfloor_ros.camera.rig.check import BURST, RigCheck
from segfloor_ros.camera.sources.bag_file import is_bag, open_bag_file
from segfloor_ros.camera.sources.opening import kind_of
from segfloor_ros.camera.sources.source import StereoSource

BURSTS = 8
"""Parts of the recording that are looked at."""

PAUSE_S, PAUSE_FRAMES = 0.5, 5
"""A camera moves far in so long a gap; a slow one is no gap where all of them are as long."""


@dataclass(frozen=True)
class Stream:
    """Messages or files of one kind: where, what they are, how many, how many a second and their
    longest gap; None where that is not known.
    """

    where: str
    what: str
    messages: int
    rate_hz: float | None = None
    longest_gap_s: float | None = None


@dataclass(frozen=True)
class Inspection:
    """What there is to say of a recording. fov_deg: across and along the rectified image. rows_px:
    by how much the same points stand in other rows, None where too little is seen. faults: as
    `InputFault`. to_mend: what is wrong and what to do, in lines.
    """

    name: str
    kind: str
    size_mb: float
    pairs: int
    skipped: int
    duration_s: float
    rate_hz: float
    image: str
    distortion: str
    is_rectified: bool
    baseline_m: float | None
    focal_px: float
    fov_deg: tuple[float, float]
    rows_px: float | None
    streams: list[Stream]
    faults: list[dict[str, Any]]
    to_mend: list[str]


def inspect_recording(
    source: StereoSource, path: str, on_progress: Callable[[int], None]
) -> Inspection:
    """Read an open recording once and look at some of its pairs. path: of the input. Raises
    InputError or CalibrationError where it is inconsistent.
    """
    check = RigCheck(source.camera)
    stamps = _look_through(source, check, on_progress)
    faults = [*check.faults.values()]
    camera, eye = source.camera, source.calibration.left
    size_px = np.array([camera.width, camera.height])
    across, along = 2 * np.degrees(np.arctan(size_px / 2 / (camera.fx, camera.fy)))
    pairs = _stream('pairs', 'left with depth' if source.takes_depth else 'left and right', stamps)
    sensors = [_sensor_stream(sensor) for sensor in source.sensors]
    return Inspection(
        name=source.name,
        kind=kind_of(path),
        size_mb=_size_mb(Path(path)),
        pairs=len(stamps),
        skipped=source.skipped_frames,
        duration_s=1e-9 * (stamps[-1] - stamps[0]) if stamps else 0.0,
        rate_hz=source.rate_hz,
        image=f'{camera.width}x{camera.height}',
        distortion='none' if eye.is_straight else eye.distortion_model,
        is_rectified=source.calibration.is_rectified,
        baseline_m=None if source.takes_depth else camera.baseline_m,
        focal_px=camera.fx,
        fov_deg=(float(across), float(along)),
        rows_px=None if math.isnan(check.rows_px) else check.rows_px,
        streams=[pairs, *sensors, *_other_topics(Path(path), sensors)],
        faults=check.as_dicts(),
        to_mend=[*(fault.line() for fault in faults), *_gaps(stamps, source)],
    )


def _look_through(
    source: StereoSource, check: RigCheck, on_progress: Callable[[int], None]
) -> list[int]:
    """Return the stamps of all pairs; those of some bursts are looked at."""
    count = source.frame_count or BURST * BURSTS
    starts = np.unique(np.linspace(0, max(count - BURST, 0), BURSTS).astype(int)).tolist()
    looked_at = {start + i for start in starts for i in range(BURST)}
    stamps: list[int] = []
    for number, entry in enumerate(source.entries()):
        if number in starts and number - 1 not in looked_at:
            check.jump()
        stamps.append(entry.stamp_ns)
        frame = source.frame(entry) if number in looked_at else None
        if frame is not None:
            check.see(frame)
        on_progress(number + 1)
        if source.frame_count is None and len(stamps) >= count:
            break
    return stamps


def _stream(where: str, what: str, stamps_ns: Sequence[int]) -> Stream:
    steps_s = 1e-9 * np.diff(stamps_ns)
    if len(steps_s) == 0 or steps_s.max() <= 0:
        return Stream(where, what, len(stamps_ns))
    rate_hz = float(1 / np.median(steps_s[steps_s > 0]))
    return Stream(where, what, len(stamps_ns), rate_hz, float(steps_s.max()))


def _sensor_stream(sensor: RecordedSensor) -> Stream:
    stamps = sorted(m.stamp_ns for m in sensor.read()) if sensor.used else []
    what = sensor.name if sensor.used else f'{sensor.name}, not used'
    found = _stream(sensor.where, what, stamps)
    return found if stamps else Stream(sensor.where, what, sensor.messages)


def _other_topics(path: Path, sensors: Sequence[Stream]) -> list[Stream]:
    """Return the other topics of a bag."""
    if not path.exists() or not is_bag(path):
        return []
    known = {sensor.where for sensor in sensors}
    with open_bag_file(path) as bag:
        return [
            Stream(name, topic.msgtype, topic.num_messages)
            for name, topic in sorted(bag.topics.items())
            if name not in known
        ]


def _gaps(stamps: Sequence[int], source: StereoSource) -> list[str]:
    """Return in words what is missing among the pairs."""
    found = []
    steps_s = 1e-9 * np.diff(stamps)
    usual_s = float(np.median(steps_s)) if len(steps_s) else 0.0
    pauses = np.flatnonzero(steps_s > max(PAUSE_S, PAUSE_FRAMES * usual_s))
    if len(pauses):
        longest = int(np.argmax(steps_s))
        found.append(
            f'{len(pauses)} pauses, the longest of {steps_s[longest]:.1f} s after '
            f'{1e-9 * (stamps[longest] - stamps[0]):.1f} s; record to a faster disk, or expect '
            'the camera to be lost there until it sees a known place again'
        )
    if source.skipped_frames:
        found.append(
            f'{source.skipped_frames} pairs cannot be read or came twice; record them again where '
            'they matter'
        )
    return found


def _size_mb(path: Path) -> float:
    files = path.rglob('*') if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file()) / 1e6
