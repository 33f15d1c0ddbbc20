"""The standard error of a program: its own lines, and those of libraries, which may be dropped."""

from __future__ import annotations

import io
import os
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

_lock = threading.Lock()

_silent: set[object] = set()
"""The blocks of `silent_libraries` that are under way."""

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
    if _standard_error is None:
        yield
        return
    block = object()
    with _lock:
        if not _silent:
            with open(os.devnull, 'w') as nowhere:
                os.dup2(nowhere.fileno(), 2)
        _silent.add(block)
    try:
        yield
    finally:
        with _lock:
            _silent.remove(block)
            if not _silent:
                os.dup2(_standard_error, 2)
