"""How long each step takes: stages, and the steps within them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any, ClassVar, TypeVar

import numpy as np

from segfloor_ros.core.geometry import Array

Timed = TypeVar('Timed', bound=Callable[..., Any])


class Profile:
    """What the calling thread computes in each step, and in the steps within it, while `recording`.

    steps: of each path of names, outermost first, the calls and their seconds. Stages are steps,
    and so are functions that are `timed`.
    """

    _current: ClassVar[Profile | None] = None

    def __init__(self) -> None:
        self.steps: dict[tuple[str, ...], tuple[int, float]] = {}
        self._path: tuple[str, ...] = ()

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Record what is done inside the `with` block, on this thread alone."""
        Profile._current = self
        try:
            yield
        finally:
            Profile._current = None

    @staticmethod
    @contextmanager
    def step(name: str) -> Iterator[None]:
        """Add the `with` block to the profile that is being recorded, if there is one."""
        profile = Profile._current
        if profile is None:
            yield
            return
        before = profile._path
        path = profile._path = (*before, name)
        profile.steps.setdefault(path, (0, 0.0))  # so that a step comes before those within it
        start_s = time.thread_time()
        try:
            yield
        finally:
            calls, seconds = profile.steps[path]
            profile.steps[path] = calls + 1, seconds + time.thread_time() - start_s
            profile._path = before


def timed(function: Timed) -> Timed:
    """Make a function a step of the profile, by its name."""
    name = function.__name__.strip('_').replace('_', ' ')

    @wraps(function)
    def with_time(*arguments: Any, **named: Any) -> Any:
        if Profile._current is None:
            return function(*arguments, **named)
        with Profile.step(name):
            return function(*arguments, **named)

    return with_time  # type: ignore[return-value]


class StageTimes:
    """Collects durations by name; one instance is shared by the stages of a run. clock: in
    seconds; `time.thread_time` counts what the calling thread computes, whatever else goes on.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._durations_s: dict[str, list[float]] = {}

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Add the time spent inside the `with` block under `name`."""
        start = self._clock()
        try:
            with Profile.step(name):
                yield
        finally:
            self.add(name, self._clock() - start)

    def add(self, name: str, duration_s: float) -> None:
        """Add one duration in seconds."""
        self._durations_s.setdefault(name, []).append(duration_s)

    def clear(self) -> None:
        """Forget what was measured so far."""
        self._durations_s.clear()

    @property
    def durations_s(self) -> dict[str, list[float]]:
        """All durations in seconds by name, in the order they were added."""
        return {name: list(durations) for name, durations in self._durations_s.items()}

    def summary(self) -> dict[str, dict[str, float]]:
        """Return count, mean, median, 95th percentile and maximum in milliseconds by name."""
        table = {}
        for name, durations in self._durations_s.items():
            spread = spread_of(1e3 * np.array(durations), 3)
            table[name] = {'count': len(durations)} | {f'{k}_ms': v for k, v in spread.items()}
        return table


class NoTimes(StageTimes):
    """For stages whose times nobody asks for."""

    def add(self, name: str, duration_s: float) -> None:
        """Forget it."""


MAX_SAMPLES = 200


def spread_of(values: Array, digits: int) -> dict[str, float]:
    """Return mean, median, 95th percentile and maximum of values (N,), rounded."""
    middle, high = np.percentile(values, (50, 95))
    found = {'mean': values.mean(), 'p50': middle, 'p95': high, 'max': values.max()}
    return {name: round(float(value), digits) for name, value in found.items()}
