"""Status messages on `/diagnostics`.

How a node fares: rates and delays of its inputs, what was lost, and what is wrong in words.
"""

from __future__ import annotations

import enum
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from statistics import median

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from segfloor_ros.nodes.messages.topics import PATIENCE_S, make_header, to_ns

CONNECTIONS = 'connections'
"""Kind of the status that says how many subscribers each topic of a node has."""

REMARKS_APART = ' | '
"""Between what seems wrong with sensors, in the value `remarks` of SLAM's statuses."""

HEALTH = 'health'
"""Kind of the status that says once a second how a node fares."""

HEALTH_PERIOD_S, LASTS_S = 1.0, 3.0
"""How often what lasts is looked for, and after how long without it it is over: a problem, somebody
who needs a node, the images of a camera.
"""

RECORDING = 'recording'
"""Kind of the status of the camera that says that its recording has ended."""

RECENT = 10
"""So many of the last messages of a topic are looked at together."""


class Level(enum.Enum):
    """How serious a status is."""

    OK = DiagnosticStatus.OK
    WARN = DiagnosticStatus.WARN
    ERROR = DiagnosticStatus.ERROR
    STALE = DiagnosticStatus.STALE


ORDER = (Level.OK, Level.WARN, Level.ERROR)


@dataclass(frozen=True)
class Status:
    """One status: name of the reporting node with its namespace, words, and named values."""

    stamp_ns: int
    name: str
    level: Level
    message: str
    values: Mapping[str, str]

    @property
    def node(self) -> str:
        """The node's name without namespace and without what follows a colon."""
        return self.name.partition(':')[0].rsplit('/', 1)[-1]

    @property
    def kind(self) -> str:
        """What the status is about: the words after the colon of its name."""
        return self.name.partition(':')[2].strip()


def status_message(status: Status) -> DiagnosticArray:
    """Return one status as a message."""
    return DiagnosticArray(
        header=make_header(status.stamp_ns, ''),
        status=[
            DiagnosticStatus(
                level=status.level.value,
                name=status.name,
                message=status.message,
                hardware_id='segfloor_ros',
                values=[KeyValue(key=k, value=v) for k, v in status.values.items()],
            )
        ],
    )


def statuses(message: DiagnosticArray) -> Iterator[Status]:
    """Yield the statuses of a message."""
    for status in message.status:
        values = {pair.key: pair.value for pair in status.values}
        level = Level(status.level)
        yield Status(to_ns(message.header.stamp), status.name, level, status.message, values)


@dataclass
class InputMeter:
    """Counts the messages of one topic. delays_s: age of the recent ones on arrival.
    longest_wait_s: that one of them waited in the queue since the last summary.
    """

    count: int = 0
    counted_before: int = 0
    lost: int = 0
    longest_wait_s: float = 0.0
    delays_s: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))


@dataclass(frozen=True)
class Problem:
    """Something that is wrong, until a time if it is not found again."""

    level: Level
    text: str
    until_s: float


class Health:
    """Gathers what a node tells about itself. Not for several threads."""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._inputs: dict[str, InputMeter] = {}
        self.problems: dict[str, Problem] = {}
        """Those that are present, by what they are about."""
        self._counts = {'processed': 0, 'failed': 0, 'dropped': 0, 'skipped': 0}
        self._milliseconds: deque[float] = deque(maxlen=RECENT)
        self._state = ''
        self._measured_s = clock_s()

    def received(self, topic: str, delay_s: float | None, waited_s: float = 0.0) -> None:
        """Count a message; delay_s: age of its stamp, None where it has none; that of a recording
        tells nothing. waited_s: since it came, in the queue.
        """
        meter = self._inputs.setdefault(topic, InputMeter())
        meter.count += 1
        meter.longest_wait_s = max(meter.longest_wait_s, waited_s)
        if delay_s is not None and abs(delay_s) < PATIENCE_S:
            meter.delays_s.append(delay_s)

    def lost(self, topic: str, count: int) -> None:
        """Count messages that never came."""
        self._inputs.setdefault(topic, InputMeter()).lost += count

    def longest_wait(self) -> tuple[str, float]:
        """Return the topic whose messages waited longest since the last summary, and how long in
        s.
        """
        waits = {topic: meter.longest_wait_s for topic, meter in self._inputs.items()}
        topic = max(waits, key=lambda name: waits[name], default='')
        return topic, waits.get(topic, 0.0)

    def count(self, what: str) -> None:
        """Note that something `failed`, was `dropped`, because a part of it did not come, or was
        `skipped`, because newer things waited.
        """
        self._counts[what] += 1

    def processed(self, milliseconds: float, state: str) -> None:
        """Note that something was processed, and the words for how it is."""
        self._counts['processed'] += 1
        self._milliseconds.append(milliseconds)
        self._state = state

    def waits(self, state: str) -> None:
        """Note the words for what is waited for with something that is not processed yet."""
        self._state = state

    def found(self, about: str, level: Level, text: str, lasts_s: float) -> None:
        """Note a problem; it is over when it is not found again for a while."""
        self.problems[about] = Problem(level, text, self._clock_s() + lasts_s)

    def over(self, about: str) -> None:
        """Note that a problem is over."""
        self.problems.pop(about, None)

    def summary(self, state: str) -> tuple[Level, str, dict[str, str]]:
        """Return level, words and values for the time since the last summary. state: of the node,
        in words.
        """
        now_s = self._clock_s()
        self.problems = {k: p for k, p in self.problems.items() if p.until_s > now_s}
        problems = sorted(self.problems.values(), key=lambda p: -ORDER.index(p.level))
        level = problems[0].level if problems else Level.OK
        words = '; '.join(p.text for p in problems) or self._state or 'waiting for messages'
        values = {'state': state, **{name: str(count) for name, count in self._counts.items()}}
        if self._state:
            values['last'] = self._state
        if self._milliseconds:
            values['processing_ms'] = f'{median(self._milliseconds):.1f}'
        values.update(self._input_values(max(now_s - self._measured_s, HEALTH_PERIOD_S / 10)))
        self._measured_s = now_s
        return level, words, values

    def _input_values(self, duration_s: float) -> dict[str, str]:
        values = {}
        for topic, meter in self._inputs.items():
            rate_hz = (meter.count - meter.counted_before) / duration_s
            meter.counted_before = meter.count
            values[f'rate_hz {topic}'] = f'{rate_hz:.1f}'
            values[f'queue_s {topic}'] = f'{meter.longest_wait_s:.3f}'
            values[f'lost {topic}'] = str(meter.lost)
            meter.longest_wait_s = 0.0
            if meter.delays_s:
                values[f'delay_s {topic}'] = f'{median(meter.delays_s):.3f}'
        return values
