"""Runs what takes long, an adjustment or the closing of a loop, beside tracking or at once."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any


class AdjustmentRunner:
    """Holds at most one adjustment.

    Without `background` it is solved when it is submitted, so that the outcome does not depend on
    timing.
    """

    def __init__(self, background: bool) -> None:
        self._worker = ThreadPoolExecutor(1, 'adjustment') if background else None
        self._apply: Callable[[Any], None] | None = None
        self._result: Future[Any] = Future()
        self._dropped = 0

    @property
    def idle(self) -> bool:
        """Whether nothing is being solved now."""
        return self._apply is None or self._result.done()

    @property
    def holds_one(self) -> bool:
        """Whether there is an adjustment that was not collected yet."""
        return self._apply is not None

    def is_wanted(self) -> Callable[[], bool]:
        """Return what tells the next adjustment whether it was dropped."""
        number = self._dropped
        return lambda: self._dropped == number

    def drop(self) -> None:
        """Forget an adjustment; one that is running is asked to end."""
        self._dropped += 1
        self._apply = None

    def submit(self, solve: Callable[[], Any], apply: Callable[[Any], None]) -> None:
        """Begin an adjustment; the one before must have been collected. solve: works on a copy and
        shares nothing with the map. apply: brings what it returns into the map.
        """
        self._apply = apply
        if self._worker is not None:
            self._result = self._worker.submit(solve)
        else:
            self._result = Future()
            self._result.set_result(solve())

    def collect(self, wait: bool) -> Callable[[], None] | None:
        """Return what applies a finished adjustment, once, or None; with `wait` a running one is
        waited for.
        """
        apply = self._apply
        if apply is None or not (wait or self._result.done()):
            return None
        self._apply = None
        result = self._result.result()
        return lambda: apply(result)

    def close(self) -> None:
        """Wait for a running adjustment and end the thread."""
        if self._worker is not None:
            self._worker.shutdown()
