"""The first steps of a program, before its modules are imported, with next to no imports."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def end_in_silence_on_signals(status: int | None = None) -> None:
    """End this process at once, without a traceback, on `SIGNALS` from now on: while modules are
    imported, and nothing is written yet. status: 128 and the signal's number by default.
    """

    def end(number: int, frame: FrameType | None) -> None:
        os._exit(128 + number if status is None else status)

    for number in SIGNALS:
        if not is_ignored_hangup(number):
            signal.signal(number, end)


def open_standard_streams() -> None:
    """Give a program that was started without standard input, output or error an empty one. The
    next file that it opens would take the number of the missing one, and what is printed.
    """
    for number, name in enumerate(('stdin', 'stdout', 'stderr')):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
        if getattr(sys, name) is None:
            mode = 'r' if number == 0 else 'w'
            setattr(sys, name, os.fdopen(number, mode, closefd=False))


def is_ignored_hangup(number: signal.Signals) -> bool:
    """Whether a signal is SIGHUP in a program that nohup started."""
    return number is signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN
