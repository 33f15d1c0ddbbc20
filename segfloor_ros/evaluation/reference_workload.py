"""A fixed piece of OpenCV work, timed beside the stages: times as multiples of it can be compared
between machines.
"""

from __future__ import annotations

import time

import cv2
import numpy as np

SEED = 20220101
SIZE = (480, 640)
SHIFT_PX = 24
FEATURES = 2000
DISPARITIES = 64
BLOCK_PX = 5
REPETITIONS = 5


class ReferenceWorkload:
    """ORB features and semi-global matching on a generated 640x480 pair; never change it."""

    def __init__(self) -> None:
        rng = np.random.default_rng(SEED)
        wide = cv2.GaussianBlur(rng.normal(size=(SIZE[0], SIZE[1] + SHIFT_PX)), (0, 0), 2.0)
        grey = np.clip(128 + 40 * wide / wide.std(), 0, 255).astype(np.uint8)
        # The scene is a plane: what the left image has at u the right one has at u - SHIFT_PX.
        self.left = np.ascontiguousarray(grey[:, : SIZE[1]])
        self.right = np.ascontiguousarray(grey[:, SHIFT_PX:])
        self._orb = cv2.ORB_create(FEATURES)
        self._matcher = cv2.StereoSGBM_create(
            0,
            DISPARITIES,
            BLOCK_PX,
            P1=8 * BLOCK_PX**2,
            P2=32 * BLOCK_PX**2,
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
        return len(keypoints), float(np.median(disparity[:, DISPARITIES:])) / 16

    def time(self) -> None:
        """Time the work a few times; called before and after what is compared with it."""
        if not self._times_ms:
            self.run()  # The first run pays for memory and for tables.
        for _ in range(REPETITIONS):
            start = time.perf_counter()
            self.run()
            self._times_ms.append(1e3 * (time.perf_counter() - start))

    @property
    def median_ms(self) -> float:
        """The median of the times so far in milliseconds."""
        return float(np.median(self._times_ms))
