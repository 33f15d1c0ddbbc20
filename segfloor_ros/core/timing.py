"""How long each step takes, and how much memory a process has.

A fixed piece of OpenCV work, timed beside the stages: times as multiples of it can be compared
between machines.
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import cv2
import numpy as np

from segfloor_ros.core.geometry import Array

MAX_SAMPLES = 200

_PROC = Path('/proc')

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


def spread_of(values: Array, digits: int) -> dict[str, float]:
    """Return mean, median, 95th percentile and maximum of values (N,), rounded."""
    middle, high = np.percentile(values, (50, 95))
    found = {'mean': values.mean(), 'p50': middle, 'p95': high, 'max': values.max()}
    return {name: round(float(value), digits) for name, value in found.items()}


class NoTimes(StageTimes):
    """For stages whose times nobody asks for."""

    def add(self, name: str, duration_s: float) -> None:
        """Forget it."""


def rss_mb(process_id: int | None = None) -> float:
    """Return the resident memory of this process, or of another one, in MB (10^6 bytes).

    Where there is no /proc, it is the peak of this process so far, and 0 for others.
    """
    statm = _PROC / str(process_id or 'self') / 'statm'
    if statm.exists():
        return int(statm.read_text().split()[1]) * resource.getpagesize() / 1e6
    if process_id is not None:
        return 0.0
    unit = 1 if sys.platform == 'darwin' else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


class MemoryLog:
    """Memory at the start and at every map update: of this process, or what `measure` returns."""

    def __init__(self, measure: Callable[[], float] = rss_mb) -> None:
        self._measure = measure
        self.start_mb = measure()
        self._samples_mb: list[float] = []

    def sample(self) -> None:
        """Note the memory at a map update."""
        self._samples_mb.append(self._measure())

    def summary(self) -> dict[str, Any]:
        """Return start, peak and growth per map update (slope of a line over the second half,
        when caches are warm), and at most 200 samples evenly over the updates.
        """
        every = max(1, -(-len(self._samples_mb) // MAX_SAMPLES))
        half = self._samples_mb[len(self._samples_mb) // 2 :]
        slope = float(np.polyfit(np.arange(len(half)), half, 1)[0]) if len(half) > 2 else 0.0
        return {
            'start': round(self.start_mb, 2),
            'peak': round(max([self.start_mb, *self._samples_mb]), 2),
            'slope_per_update': round(slope, 4),
            'samples': [round(sample, 1) for sample in self._samples_mb[::every]],
            'updates_per_sample': every,
        }


class ReferenceWorkload:
    """ORB features and semi-global matching on a generated 640x480 pair; never change it."""

    seed = 20220101
    rows = 480
    columns = 640
    shift_px = 24
    features = 2000
    disparities = 64
    block_px = 5
    repetitions = 5

    def __init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        noise = rng.normal(size=(self.rows, self.columns + self.shift_px))
        wide = cv2.GaussianBlur(noise, (0, 0), 2.0)
        grey = np.clip(128 + 40 * wide / wide.std(), 0, 255).astype(np.uint8)
        # The scene is a plane: what the left image has at u the right one has at u - shift_px.
        self.left = np.ascontiguousarray(grey[:, : self.columns])
        self.right = np.ascontiguousarray(grey[:, self.shift_px :])
        self._orb = cv2.ORB_create(self.features)
        self._matcher = cv2.StereoSGBM_create(
            0,
            self.disparities,
            self.block_px,
            P1=8 * self.block_px**2,
            P2=32 * self.block_px**2,
            disp12MaxDiff=1,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )
        self._times_ms: list[float] = []

    def run(self) -> tuple[int, float]:
        """Do the work once; return how many features it finds and the median disparity in pixels.

        The answer is the same on every machine (up to the version of OpenCV), only the time is
        not.
        """
        keypoints, _ = self._orb.detectAndCompute(self.left, None)
        disparity = self._matcher.compute(self.left, self.right)
        return len(keypoints), float(np.median(disparity[:, self.disparities :])) / 16

    def time(self) -> None:
        """Time the work a few times; called before and after what is compared with it."""
        if not self._times_ms:
            self.run()  # The first run pays for memory and for tables.
        for _ in range(self.repetitions):
            start = time.perf_counter()
            self.run()
            self._times_ms.append(1e3 * (time.perf_counter() - start))

    @property
    def median_ms(self) -> float:
        """The median of the times so far in milliseconds."""
        return float(np.median(self._times_ms))
