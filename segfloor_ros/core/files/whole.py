"""Files as bytes, text and JSON, and as tables of numbers and stamps in text: one row per line,
words parted by blanks or commas.
"""

from __future__ import annotations

import json
import logging
import math
import re
import stat
from collections.abc import Iterable, Iterator
from datetime import datetime
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.errors import InputError, SegfloorError

logger = logging.getLogger(__name__)

MAX_BYTES = 1 << 28
"""Of a file that is read whole: an hour of an IMU at 1 kHz has about as many."""

END_NS = 2**31 * 10**9
"""Stamps are before this and not before 0: what `builtin_interfaces/Time` can say."""

_NUMBER = re.compile(r'[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?', re.ASCII)


def check_file(path: Path, error_type: type[SegfloorError] = InputError) -> int:
    """Return the size of a file in bytes. Raises an error of a type for what is missing, a folder,
    a FIFO or a device: reading one of these may never end.
    """
    try:
        facts = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        reason = getattr(error, 'strerror', None) or error
        raise error_type(f'{path}: cannot be read ({reason})') from None
    if not stat.S_ISREG(facts.st_mode):
        what = 'a folder' if stat.S_ISDIR(facts.st_mode) else 'a device or pipe'
        raise error_type(f'{path}: cannot be read (is {what}, not a file)')
    return facts.st_size


def read_bytes(
    path: Path, error_type: type[SegfloorError] = InputError, at_most: int = MAX_BYTES
) -> bytes:
    """Return what a file holds. Raises an error of a type, also for more than `at_most` bytes."""
    if check_file(path, error_type) > at_most:
        raise error_type(f'{path}: has more than {at_most / 1e6:.1f} MB; is it the right file?')
    try:
        return path.read_bytes()
    except OSError as error:
        raise error_type(f'{path}: cannot be read ({error.strerror})') from None


def read_text(
    path: Path, error_type: type[SegfloorError] = InputError, at_most: int = MAX_BYTES
) -> str:
    """Return the text of a file in UTF-8. Raises an error of a type."""
    try:
        return read_bytes(path, error_type, at_most).decode('utf-8-sig')
    except UnicodeDecodeError as error:
        raise error_type(f'{path}, byte {error.start}: is not UTF-8; save it as that') from None


def read_json(path: Path, expected: str) -> dict[str, Any]:
    """Return the object that a JSON file holds. expected: what it should be, in words. Raises
    InputError.
    """
    document = json_object(read_text(path))
    if document is None:
        raise InputError(f'{path}: not {expected}: no object in JSON')
    return document


def json_object(text: str | bytes) -> dict[str, Any] | None:
    """Return the object that a JSON text is, None where it is none."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None


def number(word: str) -> float:
    """Return the finite number that a word is. Raises ValueError."""
    value = float(word) if _NUMBER.fullmatch(word) else math.nan
    if not math.isfinite(value):
        raise ValueError(f'{word[:40]}: not a finite number')
    return value


def nanoseconds(time: str, digits: int = 0) -> int:
    """Return a time, as text, in ns, exactly. digits: as `digits_of`. Raises ValueError for what is
    no stamp.
    """
    value = Decimal(time) if -1 < number(time) < 10 ** (10 + digits) else Decimal(-1)
    return checked_ns(int(value.scaleb(9 - digits).to_integral_value()), time)


_UNITS = ((3, 'ms', 5, 1e11), (6, 'µs', 3e3, 1e14), (9, 'ns', 3e5, 1e17))
"""Units of time: their digits below one second, name, the step from row to row from which on times
that count from a start are in this unit, and the time from which on it is one whatever the step:
5 s to 3,000 ms are no step of a robot, 1e11 s is no date."""

_DATES_S, _LONGEST_S = (9e8, 4e9), 1e4
"""Seconds since 1970 from 1998 to 2096, and from row to row."""


def digits_of(times: Iterable[str], where: str) -> int:
    """Return how many digits below a second the unit of times has, as they are written: 0 for
    seconds, 9 for ns. Those without fraction in large steps, or beyond all dates, are in ms, µs or
    ns; a warning says so.
    """
    words = list(times)
    try:
        values = np.array([number(word) for word in words])
    except ValueError:
        return 0  # its line is named where it is read
    steps = np.diff(values)
    is_whole = all('.' not in word or 'e' in word.lower() for word in words)
    step = float(np.median(steps)) if len(steps) and is_whole else 0.0
    latest = float(values.max(initial=0.0))
    fitting = [unit for unit in _UNITS if latest >= unit[3]]
    first_s, last_s = _DATES_S
    are_dates = (
        len(values) > 0 and values.min() >= first_s and latest < last_s and step < _LONGEST_S
    )
    if not fitting and not are_dates:
        fitting = [unit for unit in _UNITS if step >= unit[2]]
    if not fitting:
        return 0
    digits, name, *_ = fitting[-1]
    logger.warning('%s: its times are read as %s: they are up to %.3g', where, name, latest)
    return digits


_DATE = re.compile(r'(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d)(?:[.,](\d+))?')


def time_of(line: str) -> str:
    """Return the time that a line begins with as a number, as text; a date and time of day, as in
    KITTI's raw recordings, in seconds since 1970.
    """
    found = _DATE.match(line.strip())
    if found is None:
        return next(iter(line.replace(',', ' ').split()), line)
    try:
        then = datetime.fromisoformat(f'{found[1]}T{found[2]}+00:00')
    except ValueError:
        return found[0]
    return f'{int(then.timestamp())}' + (f'.{found[3]}' if found[3] else '')


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


def shortened(text: str) -> str:
    """Return a text that may be long, for a message."""
    return text if len(text) <= 40 else f'{text[:37]}…'
