"""Interrupts (SIGINT, SIGTERM) at moments when they must not break something off."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Deliver SIGINT and SIGTERM at the end of the block, so that none falls between the start of a
    process and the note that it runs. A started program gets the default handlers again.
    """
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)

    handlers = {number: signal.signal(number, note) for number in SIGNALS}
    try:
        yield
    finally:
        _restore(handlers)
    if received:
        signal.raise_signal(received[0])


@contextlib.contextmanager
def first_interrupt_noted() -> Iterator[threading.Event]:
    """Set an event at the first SIGINT or SIGTERM within the block, so that the work can come to an
    orderly end; the next one takes its usual course.
    """
    event = threading.Event()

    def note(number: int, frame: FrameType | None) -> None:
        event.set()
        _restore(handlers)

    handlers = {number: signal.signal(number, note) for number in SIGNALS}
    try:
        yield event
    finally:
        _restore(handlers)


def _restore(handlers: dict[signal.Signals, signal._HANDLER]) -> None:
    for number, handler in handlers.items():
        signal.signal(number, handler)
