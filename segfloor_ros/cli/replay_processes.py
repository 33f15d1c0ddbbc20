"""The node processes of a replay: started, watched and stopped together, also when interrupted."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

from segfloor_ros.errors import MapError
from segfloor_ros.processes import end_with_parent, interrupts_deferred
from segfloor_ros.timing import rss_mb

INTERRUPT_S = 1.2

TERMINATE_S = 0.5

NOTICES = ('[WARN]', '[ERROR]', '[FATAL]', 'segfloor: ')


class ReplayError(MapError):
    """The replay broke off: a node died or the nodes do not find each other."""


class NodeProcesses:
    """One process per node. As a context manager it leaves none of them behind."""

    def __init__(
        self,
        nodes: Iterable[str],
        arguments: Sequence[str],
        environment: Mapping[str, str],
        log_folder: Path,
    ) -> None:
        self._environment = dict(environment)
        self._logs = {node: log_folder / f'{node}.log' for node in nodes}
        self._arguments = list(arguments)
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> NodeProcesses:
        try:
            with interrupts_deferred():
                self._start()
        except BaseException:
            # `__exit__` is not called for what happens in here.
            self.stop()
            raise
        return self

    def _start(self) -> None:
        for node, log in self._logs.items():
            command = [sys.executable, '-m', f'segfloor_ros.nodes.{node}', *self._arguments]
            with log.open('wb') as output:
                self._processes[node] = subprocess.Popen(
                    command,
                    env=self._environment,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    # An interrupt from the terminal ends the replay, which then stops its nodes.
                    start_new_session=True,
                    preexec_fn=partial(end_with_parent, os.getpid()),
                )

    def __exit__(self, *error: object) -> None:
        self.stop()

    def check(self) -> None:
        """Raise ReplayError naming the node whose process has ended."""
        for node, process in self._processes.items():
            status = process.poll()
            if status is not None:
                raise ReplayError(f'node {node} died ({_cause(status)}){self._last_words(node)}')

    @property
    def process_ids(self) -> dict[str, int]:
        """The process of every node."""
        return {node: process.pid for node, process in self._processes.items()}

    def rss_mb(self) -> float:
        """Return the resident memory of all processes together in MB."""
        return sum(rss_mb(process.pid) for process in self._processes.values())

    def stop(self) -> None:
        """Interrupt all processes; terminate, then kill those that stay."""
        for stop_signal, patience_s in (
            (signal.SIGINT, INTERRUPT_S),
            (signal.SIGTERM, TERMINATE_S),
            (signal.SIGKILL, TERMINATE_S),
        ):
            running = [p for p in self._processes.values() if p.poll() is None]
            for process in running:
                process.send_signal(stop_signal)
            deadline_s = time.monotonic() + patience_s
            for process in running:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(max(deadline_s - time.monotonic(), 0.0))

    def notices(self) -> list[str]:
        """Return the warnings and errors the nodes have logged, each line once."""
        lines = (
            f'{node}: {_without_clock(line)}'
            for node in self._logs
            for line in self._lines(node)
            if any(mark in line for mark in NOTICES)
        )
        return list(dict.fromkeys(lines))

    def _lines(self, node: str) -> list[str]:
        text = self._logs[node].read_text(errors='replace') if self._logs[node].exists() else ''
        return [line.strip() for line in text.splitlines() if line.strip()]

    def _last_words(self, node: str) -> str:
        lines = self._lines(node)
        return f': {_without_clock(lines[-1])}' if lines else ''


def _cause(status: int) -> str:
    if status < 0:
        return f'signal {signal.Signals(-status).name}'
    return f'status {status}'


def _without_clock(line: str) -> str:
    """Strip `[WARN] [1700000000.123456789] [node]: ` from a line of the ROS log."""
    for mark in NOTICES:
        if line.startswith(mark):
            return line.partition(']: ')[2] or line.removeprefix(mark)
    return line
