"""Status messages on `/diagnostics`."""

from __future__ import annotations

import enum
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from segfloor_ros.messages.headers import make_header, to_ns

CONNECTIONS = 'connections'
"""Kind of the status that says how many subscribers each topic of a node has."""

REMARKS_APART = ' | '
"""Between what seems wrong with sensors, in the value `remarks` of SLAM's statuses."""

HEALTH = 'health'
"""Kind of the status that says once a second how a node fares."""

HEALTH_PERIOD_S = 1.0

NEED_LASTS_S = 5.0
"""A node that nobody has needed for so long takes no messages until somebody does."""

RECORDING = 'recording'
"""Kind of the status of the camera that says that its recording has ended."""


class Level(enum.Enum):
    """How serious a status is."""

    OK = DiagnosticStatus.OK
    WARN = DiagnosticStatus.WARN
    ERROR = DiagnosticStatus.ERROR
    STALE = DiagnosticStatus.STALE


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
