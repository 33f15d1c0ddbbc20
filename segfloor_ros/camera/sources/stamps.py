"""Stamps of recordings: reading, checking and making them."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from segfloor_ros.camera.sources.source import DEFAULT_RATE_HZ
from segfloor_ros.errors import InputError


def read_times(path: Path, comments: str = '') -> list[int]:
    """Return the stamps in ns of a file with one time in seconds per line; lines that begin with
    `comments`, if given, are passed over.

    Raises InputError naming the line where one is no number or earlier than the one before.
    """
    stamps: list[int] = []
    for number, line in enumerate(path.read_text(errors='replace').splitlines(), 1):
        if not line.strip() or (comments and line.lstrip().startswith(comments)):
            continue
        try:
            stamp_ns = int(Decimal(line.split()[0]).scaleb(9).to_integral_value())
        except (InvalidOperation, ValueError, OverflowError):
            raise InputError(f'{path}, line {number}: expected a time in seconds') from None
        check_forward(f'{path}, line {number}', stamps[-1:], stamp_ns)
        stamps.append(stamp_ns)
    return stamps


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
