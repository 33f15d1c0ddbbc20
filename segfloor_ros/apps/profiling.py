"""What a run costs in memory, and against a reference workload."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from segfloor_ros.core.memory import rss_mb
from segfloor_ros.core.timing import MAX_SAMPLES


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
