"""What decoders of images and videos write to standard error without being asked, kept away."""

from __future__ import annotations

import io
import os
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

_lock = threading.Lock()
_inside = 0
_standard_error: int | None = None


def own_standard_error() -> None:
    """Give this program a way of its own to standard error, so that `silent_libraries` can close
    the usual one; without it that does nothing. For programs, before anything is written.
    """
    global _standard_error
    if _standard_error is None:
        _standard_error = os.dup(2)
        sys.stderr = open(_standard_error, 'w', buffering=1, errors='backslashreplace')  # noqa: SIM115
    if not sys.warnoptions:
        warnings.simplefilter('ignore')  # of NumPy, about numbers of the input
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors='backslashreplace')  # names of files may be no text


@contextmanager
def silent_libraries() -> Iterator[None]:
    """Drop what libraries write to standard error: libpng and libjpeg have no other switch that
    OpenCV passes on.
    """
    global _inside
    if _standard_error is None:
        yield
        return
    with _lock:
        if _inside == 0:
            _point_to(os.devnull)
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                os.dup2(_standard_error, 2)


def _point_to(path: str) -> None:
    file = os.open(path, os.O_WRONLY)
    os.dup2(file, 2)
    os.close(file)
