"""What is wrong with a camera or its driver, by what comes of it over time."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterable
from statistics import median

import numpy as np

from segfloor_ros.core.contracts import InputFault, Mount
from segfloor_ros.nodes.messages.diagnostics import LASTS_S, RECENT, Level
from segfloor_ros.nodes.messages.topics import PATIENCE_S
from segfloor_ros.nodes.shared.stage_node import AnyStageNode

FIRST_INFO_S = 5.0
"""A driver that starts publishes its calibration by then."""

REMEMBERED = 10 * RECENT
"""Stamps of images, so that one side may be late; and pairs, over which a rate is a rate."""

PLAUSIBLE_ROLL_DEG, PLAUSIBLE_PITCH_DEG = 20.0, 60.0
"""Beyond these a mount that was measured is hard to believe."""


class CameraWatch:
    """Notices unsynchronised and missing images, missing calibrations, and an implausible
    floor, and says what is wrong in the images.
    """

    def __init__(self, node: AnyStageNode) -> None:
        self._node = node
        self._missing_s: dict[str, float] = {}

    def expect(self, left: str, right: str) -> None:
        """Watch these two topics from now on."""
        self._stamps: dict[str, deque[int]] = {t: deque(maxlen=REMEMBERED) for t in (left, right)}
        self._last_image_s: dict[str, float] = {}
        self._taken: deque[bool] = deque(maxlen=REMEMBERED)
        self._is_live = False

    def saw_image(self, topic: str, stamp_ns: int) -> None:
        """Note an image."""
        self._stamps[topic].append(stamp_ns)
        now_ns = self._node.get_clock().now().nanoseconds
        self._last_image_s[topic] = 1e-9 * now_ns
        self._is_live = abs(now_ns - stamp_ns) < 1e9 * PATIENCE_S

    def note_taken(self) -> None:
        """Note that a pair is tracked."""
        self._taken.append(True)

    def report_skipped(self, stamp_ns: int, is_ready: bool) -> None:
        """Report a pair that was left out because newer ones had overtaken it, and say so in the
        health where it is more than one in twenty. is_ready: tracking has begun.
        """
        reporter = self._node.reporter
        reporter.health.count('skipped')
        if not is_ready:
            words = 'skipped: calibration or mount of the camera are not known yet'
            reporter.report(stamp_ns, Level.WARN, words)
            return
        reporter.report(stamp_ns, Level.WARN, 'skipped: tracking is slower than the camera')
        self._taken.append(False)
        topic, stamps_ns = next(iter(self._stamps.items()))
        rate_hz = (len(stamps_ns) - 1) / max(1e-9 * (stamps_ns[-1] - stamps_ns[0]), 1e-3)
        share = round(float(np.mean(self._taken)), 1)
        if share < 1:
            reporter.diagnose(
                'skipped',
                f'{topic} comes faster than it is tracked: {round(share * rate_hz, 1):g} of '
                f'{round(rate_hz, 1):g} images a second; the others are skipped; lower the rate or '
                'the size of the images or num_features of stereo_slam, or play a recording with '
                'lossless set on stereo_camera',
                lasts_s=PATIENCE_S,
            )

    def find_problems(self, missing_infos: list[str]) -> None:
        """Diagnose what shows over time. missing_infos: calibrations that images wait for."""
        now_s = time.monotonic()
        self._missing_s = {topic: self._missing_s.get(topic, now_s) for topic in missing_infos}
        for topic in missing_infos:
            if now_s - self._missing_s[topic] < FIRST_INFO_S:
                continue
            self._node.reporter.diagnose(
                topic,
                f'no message on {topic}: images wait for their calibration; let the driver '
                'publish it, or remap the topic; `segfloor calibrate` makes one',
                Level.ERROR,
            )
        self._find_silence()
        self._find_unstamped()
        self._find_mono()
        self._find_different_stamps()

    def report_faults(self, faults: Iterable[InputFault]) -> None:
        """Diagnose what was found in the images."""
        for fault in faults:
            text = fault.line(' and '.join(self._stamps))
            self._node.reporter.diagnose(fault.fault, text, Level.ERROR, PATIENCE_S)

    def judge_measured(self, mount: Mount) -> None:
        """Say so where the mount that was measured from the floor is hard to believe."""
        pitch, roll = math.degrees(mount.pitch_rad), math.degrees(mount.roll_rad)
        if abs(roll) > PLAUSIBLE_ROLL_DEG or abs(pitch) > PLAUSIBLE_PITCH_DEG:
            self._node.reporter.diagnose(
                'tilt',
                f'{next(iter(self._stamps))}: the floor seems tilted by {pitch:.1f} deg along and '
                f'{roll:.1f} deg across the view, which is hardly so; does the camera see the '
                'floor? else give camera_height_m, camera_pitch_rad and camera_roll_rad',
                lasts_s=math.inf,
            )

    def _find_silence(self) -> None:
        now_s = 1e-9 * self._node.get_clock().now().nanoseconds
        for topic, last_s in self._last_image_s.items():
            # A recording may end or wait for the nodes; a camera may not. The time of one that has
            # ended stands still.
            if self._is_live and now_s - last_s > LASTS_S:
                self._node.reporter.diagnose(
                    f'silence of {topic}',
                    f'no image on {topic} for a while; is the camera connected and its driver '
                    'running?',
                    Level.ERROR,
                )

    def _find_unstamped(self) -> None:
        for topic, stamps in self._stamps.items():
            if len(stamps) >= RECENT and not any(stamps):
                self._node.reporter.diagnose(
                    f'stamps of {topic}',
                    f'all stamps on {topic} are zero: no pair can be tracked; let the driver '
                    'stamp its images',
                    Level.ERROR,
                )

    def _find_mono(self) -> None:
        """Decline one camera alone."""
        left, right = self._stamps
        if len(self._stamps[left]) < RECENT or self._stamps[right]:
            return
        if not self._node.get_publishers_info_by_topic(right):
            self._node.reporter.diagnose(
                'one camera',
                f'images come on {left}, but nobody publishes {right}: one camera alone does not '
                'tell how far away anything is; publish or remap right or depth images',
                Level.ERROR,
            )

    def _find_different_stamps(self) -> None:
        left, right = self._stamps.values()
        now_s = 1e-9 * self._node.get_clock().now().nanoseconds
        both_come = all(now_s - last_s < 1.0 for last_s in self._last_image_s.values())
        if not both_come or len(left) < RECENT or len(right) < RECENT:
            return
        # One side may arrive late, and be paired all the same.
        gap_ns = min(
            median(min(abs(stamp - other) for other in others) for stamp in list(stamps)[-RECENT:])
            for stamps, others in ((left, right), (right, left))
        )
        tolerance_s = self._node.settings.sync_tolerance_s
        if gap_ns > 1e9 * tolerance_s:
            self._node.reporter.diagnose(
                'stamps',
                f'the stamps of {" and ".join(self._stamps)} are {1e-6 * gap_ns:.1f} ms apart, '
                f'more than sync_tolerance_s = {tolerance_s:g} s: no pairs; trigger '
                'both cameras together, or allow more',
                Level.ERROR,
            )
