"""This process and those it starts: how they end, in order."""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from types import FrameType
from typing import Any

from segfloor_ros.core.starting import SIGNALS, is_ignored_hangup

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)


def end_with_parent(parent_id: int, by: signal.Signals = signal.SIGTERM) -> None:
    """Have the kernel send a signal to this process when its parent ends, however it ends
    (prctl(2), Linux only). For `preexec_fn`, too.
    """
    if sys.platform != 'linux':
        return
    _LIBC.prctl(_PR_SET_PDEATHSIG, by)
    if os.getppid() != parent_id:
        os.kill(os.getpid(), by)


def _begin(work: Callable[..., None], *arguments: Any) -> None:
    """Do the work of a new process, which takes signals from now on."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    work(*arguments)


def start_apart(work: Callable[..., None], *arguments: Any) -> tuple[Connection, SpawnProcess]:
    """Start `work(pipe, *arguments)` in a new process; returns the other end of the pipe, and the
    process. Spawned: a fork would copy the locks of the threads of OpenCV and BLAS. Call it within
    `interrupts_deferred`, with the note that it runs.
    """
    context = multiprocessing.get_context('spawn')
    pipe, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_begin, args=(work, theirs, *arguments))
    # The new process inherits the mask: no signal breaks its imports.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    theirs.close()
    return pipe, process


def how_it_ended(status: int) -> str:
    """Return the exit status of a process in words, e.g. `signal SIGKILL`."""
    return f'status {status}' if status >= 0 else f'signal {signal.Signals(-status).name}'


class Interrupt(threading.Event):
    """Set when a signal has come."""

    number = 0

    @property
    def status(self) -> int:
        """The exit status that the signal stands for, 0 before one has come."""
        return 128 + self.number if self.number else 0


@contextlib.contextmanager
def terminated_like_interrupted() -> Iterator[None]:
    """Let SIGTERM and SIGHUP within the block end what is under way with all its clean-ups, status
    143 and 129.
    """

    def end(number: int, frame: FrameType | None) -> None:
        sys.exit(128 + number)

    with _handled_by(end, (signal.SIGTERM, signal.SIGHUP)):
        yield


@contextlib.contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Deliver `SIGNALS` at the end of the block, so that none falls between the start of a process
    and the note that it runs, or into a fork, where exceptions are ignored. A started program gets
    the default handlers again. Beside the main thread, which alone gets signals,
    nothing is done.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)

    with _handled_by(note):
        yield
    if received:
        signal.raise_signal(received[0])


@contextlib.contextmanager
def first_interrupt_noted() -> Iterator[Interrupt]:
    """Set an event at the first of `SIGNALS` within the block, so that the work can come to an
    orderly end; the next one takes its usual course.
    """
    event = Interrupt()

    def note(number: int, frame: FrameType | None) -> None:
        event.number = number
        event.set()
        restore()

    with _handled_by(note) as restore:
        yield event


@contextlib.contextmanager
def _handled_by(
    handle: Callable[[int, FrameType | None], None], signals: Sequence[signal.Signals] = SIGNALS
) -> Iterator[Callable[[], None]]:
    """Handle signals within the block otherwise; yields what restores the handlers before."""
    taken = [number for number in signals if not is_ignored_hangup(number)]
    before = {number: signal.signal(number, handle) for number in taken}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    try:
        yield restore
    finally:
        restore()
