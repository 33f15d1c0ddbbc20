"""Tables of numbers and stamps in text: one row per line, words parted by blanks or commas."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.errors import InputError, SegfloorError
from segfloor_ros.files.whole import read_bytes

END_NS = 2**31 * 10**9
"""Stamps are before this and not before 0: what `builtin_interfaces/Time` can say."""

_NUMBER = re.compile(r'[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?', re.ASCII)


def number(word: str) -> float:
    """Return the finite number that a word is. Raises ValueError."""
    value = float(word) if _NUMBER.fullmatch(word) else math.nan
    if not math.isfinite(value):
        raise ValueError(f'{word[:40]}: not a finite number')
    return value


def nanoseconds(seconds: str) -> int:
    """Return a time in seconds, as text, in ns, exactly. Raises ValueError for what is no stamp."""
    value = Decimal(seconds) if -1 < number(seconds) < 1e10 else Decimal(-1)
    return checked_ns(int(value.scaleb(9).to_integral_value()), seconds)


def whole_nanoseconds(word: str) -> int:
    """Return a stamp in ns. Raises ValueError for what is none."""
    if not (word.isascii() and word.isdigit() and len(word) < 20):
        raise ValueError(f'{word[:40]}: not a stamp in ns')
    return checked_ns(int(word), word)


def checked_ns(stamp_ns: int, word: str) -> int:
    """Return a stamp in ns. Raises ValueError for one that no clock shows."""
    if not 0 <= stamp_ns < END_NS:
        raise ValueError(f'{word[:40]}: not a stamp from 0 to {END_NS // 10**9} s')
    return stamp_ns


def read_lines(
    path: Path, error_type: type[SegfloorError] = InputError
) -> Iterator[tuple[str, str]]:
    """Yield the lines of a text, and what to call each in a message; without empty ones and
    comments (`#`). Bytes that are no text stay in their lines, where they are no numbers. Raises an
    error of a type.
    """
    text = read_bytes(path, error_type).decode('utf-8-sig', errors='replace')
    for number_of_line, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.lstrip().startswith('#'):
            yield f'{path}, line {number_of_line}', line


def read_table(path: Path) -> NDArray[np.float64]:
    """Return the numbers of a text file (rows, columns), all finite. Raises InputError."""
    rows: list[list[float]] = []
    for where, line in read_lines(path):
        words = line.partition('#')[0].split()
        try:
            rows.append([number(word) for word in words])
        except ValueError as error:
            raise InputError(f'{where}: {error}') from None
        if len(rows[-1]) != len(rows[0]):
            raise InputError(f'{where}: has {len(words)} numbers, the first row {len(rows[0])}')
    if not rows:
        raise InputError(f'{path}: is empty')
    return np.array(rows, np.float64)
