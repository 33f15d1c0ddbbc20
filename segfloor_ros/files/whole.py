"""Files as bytes, text and JSON."""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any

from segfloor_ros.errors import InputError, SegfloorError

MAX_BYTES = 1 << 28
"""Of a file that is read whole: an hour of an IMU at 1 kHz has about as many."""


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
