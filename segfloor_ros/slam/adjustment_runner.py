"""Runs local bundle adjustments: at once, or beside tracking on a thread of their own."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

from segfloor_ros.slam.bundle_adjustment import BundleResult
from segfloor_ros.slam.mapping import Adjustment, LocalMapper


class AdjustmentRunner:
    """Holds at most one adjustment.

    Without `background` it is solved when it is submitted, so that the outcome does not depend on
    timing.
    """

    def __init__(self, mapper: LocalMapper, background: bool) -> None:
        self._mapper = mapper
        self._worker = ThreadPoolExecutor(1, 'adjustment') if background else None
        self._adjustment: Adjustment | None = None
        self._result: Future[BundleResult] = Future()

    @property
    def idle(self) -> bool:
        """Whether nothing is being solved now."""
        return self._adjustment is None or self._result.done()

    def submit(self, adjustment: Adjustment) -> None:
        """Begin an adjustment; the one before must have been collected."""
        self._adjustment = adjustment
        if self._worker is not None:
            self._result = self._worker.submit(self._mapper.solve, adjustment)
        else:
            self._result = Future()
            self._result.set_result(self._mapper.solve(adjustment))

    def collect(self, wait: bool) -> tuple[Adjustment, BundleResult] | None:
        """Return a finished adjustment, once, or None; with `wait` a running one is waited for."""
        adjustment = self._adjustment
        if adjustment is None or not (wait or self._result.done()):
            return None
        self._adjustment = None
        return adjustment, self._result.result()

    def close(self) -> None:
        """Wait for a running adjustment and end the thread."""
        if self._worker is not None:
            self._worker.shutdown()
