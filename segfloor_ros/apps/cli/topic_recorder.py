"""What is on the topics of a live graph, written to a bag as it comes."""

from __future__ import annotations

import contextlib
import importlib.util
import re
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from segfloor_ros.apps.recordings.bag_file import CAMERA_INFO, COMPRESSED, IMAGE
from segfloor_ros.apps.recordings.bag_writer import IMU, ODOMETRY, TF, NewBag
from segfloor_ros.core.processes import Interrupt
from segfloor_ros.nodes.messages.making import message_class
from segfloor_ros.nodes.messages.topics import PATIENCE_S, prepare_middleware

RECORDED = (IMAGE, COMPRESSED, CAMERA_INFO, IMU, ODOMETRY, TF)
"""Types that a drive is mapped from."""

PICTURES = (IMAGE, COMPRESSED)
LOOK_S = 0.5
"""So often for new topics, and at the space that is left."""

FRAMES_APART = 1.5
"""Images whose stamps are farther apart than this many usual steps lack one between them."""


@dataclass
class TopicRecord:
    """What came on a topic. dropped: images that its stamps lack."""

    kind: str
    messages: int = 0
    size: int = 0
    first_s: float = 0.0
    last_s: float = 0.0
    dropped: int = 0
    _steps_ns: deque[int] = field(default_factory=partial(deque, maxlen=50))
    _last_ns: int | None = None

    @property
    def rate_hz(self) -> float:
        """Messages per second, of their arrival."""
        return (self.messages - 1) / max(self.last_s - self.first_s, 1e-9)

    def take(self, data: bytes, now_s: float) -> None:
        """Count a message in CDR that came at a time."""
        self.messages, self.size = self.messages + 1, self.size + len(data)
        self.first_s, self.last_s = self.first_s or now_s, now_s
        if self.kind in PICTURES:
            self._count_gap(stamp_of(data))

    def _count_gap(self, stamp_ns: int) -> None:
        step_ns = 0 if self._last_ns is None else stamp_ns - self._last_ns
        self._last_ns = stamp_ns
        if step_ns <= 0:
            return
        usual_ns = float(np.median(self._steps_ns)) if self._steps_ns else step_ns
        if step_ns > FRAMES_APART * usual_ns:
            self.dropped += round(step_ns / usual_ns) - 1
        else:
            self._steps_ns.append(step_ns)


def stamp_of(data: bytes) -> int:
    """Return the stamp (ns) of a message in CDR that begins with a header."""
    order = '<' if data[1] & 1 else '>'
    sec, nanosec = struct.unpack_from(f'{order}iI', data, 4)
    return int(sec * 1_000_000_000 + nanosec)


class Recorder(Node):
    """Writes the messages of every wanted topic to a bag. wanted: a pattern that the whole name
    matches; None: topics of types that a drive is mapped from.
    """

    def __init__(self, context: Context, bag: NewBag, wanted: str | None) -> None:
        super().__init__('segfloor_record', context=context)
        self.records: dict[str, TopicRecord] = {}
        self.unknown: set[str] = set()
        self._bag = bag
        self._wanted = re.compile(wanted) if wanted is not None else None
        self.create_timer(LOOK_S, self._look)
        self._look()

    def _look(self) -> None:
        """Subscribe to what is new."""
        for name, kinds in self.get_topic_names_and_types():
            kind = kinds[0]
            is_wanted = self._wanted.fullmatch(name) if self._wanted else kind in RECORDED
            if not is_wanted or name in self.records or name in self.unknown:
                continue
            if not self._bag.knows(kind) or not is_installed(kind):
                self.unknown.add(name)
                self.get_logger().warning(f'{name}: messages of {kind} are not recorded')
                continue
            offers = [info.qos_profile for info in self.get_publishers_info_by_topic(name)]
            if not offers:
                continue
            self.records[name] = TopicRecord(kind)
            take = partial(self._take, name)
            self.create_subscription(message_class(kind), name, take, profile_of(offers), raw=True)

    def _take(self, name: str, data: bytes) -> None:
        record, now_ns = self.records[name], time.time_ns()
        record.take(data, now_ns / 1e9)
        self._bag.write(name, record.kind, now_ns, data)


def is_installed(kind: str) -> bool:
    """Whether this machine has a message type; pip wheels lack some."""
    return importlib.util.find_spec(kind.partition('/')[0]) is not None


def profile_of(offers: list[QoSProfile]) -> QoSProfile:
    """Return a quality of service that connects to all publishers of a topic."""
    reliable = all(o.reliability == ReliabilityPolicy.RELIABLE for o in offers)
    local = all(o.durability == DurabilityPolicy.TRANSIENT_LOCAL for o in offers)
    return QoSProfile(
        depth=100,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if local else DurabilityPolicy.VOLATILE,
    )


def record_topics(
    bag: NewBag,
    wanted: str | None,
    seconds: float,
    interrupt: Interrupt,
    on_look: Callable[[dict[str, TopicRecord]], None],
) -> tuple[dict[str, TopicRecord], bool]:
    """Record until the interrupt comes or `seconds` (0: no end) are over. Returns what came, and
    whether the disk became full.
    """
    begun_s = time.monotonic()
    with _graph() as context:
        recorder = Recorder(context, bag, wanted)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(recorder)
        looked_s, is_full = begun_s, False
        while not interrupt.is_set() and not is_full:
            executor.spin_once(timeout_sec=LOOK_S)
            now_s = time.monotonic()
            if now_s - looked_s > LOOK_S:
                looked_s = now_s
                on_look(recorder.records)
                is_full = bag.is_disk_full(now_s - begun_s)
            if seconds and now_s - begun_s > seconds:
                break
        _drain(executor, recorder.records)
        executor.shutdown()
        recorder.destroy_node()
    return recorder.records, is_full


def _drain(executor: SingleThreadedExecutor, records: dict[str, TopicRecord]) -> None:
    """Take what has come before the end."""
    end_s, idle = time.monotonic() + PATIENCE_S, 0
    while idle < len(records) + 1 and time.monotonic() < end_s:
        before = sum(record.messages for record in records.values())
        executor.spin_once(timeout_sec=0.0)
        idle = 0 if sum(record.messages for record in records.values()) > before else idle + 1


@contextlib.contextmanager
def _graph() -> Iterator[Any]:
    prepare_middleware()
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        yield context
    finally:
        context.try_shutdown()
