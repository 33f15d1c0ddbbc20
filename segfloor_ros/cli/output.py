"""What the commands print: progress, tables and errors."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as ProgressBar
from rich.table import Table

from segfloor_ros.errors import printable
from segfloor_ros.measurements import RecordedSensor
from segfloor_ros.results_folder import RunSummary, summary_rows

console = Console(markup=False)
error_console = Console(stderr=True, soft_wrap=True, markup=False)

Progress = Callable[..., None]
"""Told how many steps are done and, as `note`, the state in words."""

Announce = Callable[[str, int], Progress]
"""Told the name of a task and its number of steps; returns whom to tell how many are done."""


@contextmanager
def announcing() -> Iterator[Announce]:
    """Show a progress bar whose task is replaced by the next announced one."""
    columns = (
        TextColumn('{task.description}', markup=False),
        BarColumn(),
        TaskProgressColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn('{task.fields[note]}', markup=False),
    )
    with ProgressBar(*columns, console=error_console, transient=not sys.stderr.isatty()) as bar:
        task = bar.add_task('starting', total=None, note='')

        def announce(description: str, total: int) -> Progress:
            bar.reset(task, description=description, total=total or None, note='')
            return lambda done, note='': bar.update(task, completed=done, note=note)

        yield announce


@contextmanager
def progress_bar(description: str, total: int | None) -> Iterator[Progress]:
    """Show a progress bar with one task."""
    with announcing() as announce:
        yield announce(description, total or 0)


def figure_table(names: str, *numbers: str) -> Table:
    """Return an empty table whose first column holds names and whose others hold numbers."""
    table = Table(names, *numbers, padding=0)
    for column in table.columns:
        column.no_wrap = True
    for column in table.columns[1:]:
        column.justify = 'right'
    return table


def value_table(name: str, rows: Iterable[tuple[str, str]], title: str | None = None) -> Table:
    """Return a table of names and their values with units."""
    table = Table(name, 'value', title=title, title_justify='left')
    for row in rows:
        table.add_row(*row)
    return table


def print_sensors(sensors: Sequence[RecordedSensor]) -> None:
    """Print what a recording holds besides stereo images, where there is such."""
    if not sensors:
        return
    table = Table('sensor', 'found in', 'messages', 'used')
    for sensor in sensors:
        used = 'yes' if sensor.used else 'no'
        table.add_row(sensor.name, sensor.where, str(sensor.messages), used)
    console.print(table)


def print_summary(title: str, summary: RunSummary) -> None:
    """Print the figures of a run and the time of each stage as tables with units."""
    console.print(value_table('result', summary_rows(summary), title))
    stages = figure_table('stage', 'calls', 'median ms', 'p95 ms', 'max ms')
    for name, stage in summary.stages.items():
        values = (stage['p50_ms'], stage['p95_ms'], stage['max_ms'])
        stages.add_row(name, str(stage['count']), *(f'{value:.1f}' for value in values))
    console.print(stages)


def print_error(message: str) -> None:
    """Print one line on standard error."""
    error_console.print(f'segfloor: {printable(message)}', highlight=False)


def finish_run(input_name: str, out: Path, report: bool) -> None:
    """Write the report if asked for, with the truth where the recording has one, and say where the
    results are.
    """
    console.print(f'map: {out / "map.yaml"}', highlight=False, soft_wrap=True)
    if report:
        # Imported here: Matplotlib takes a second that other commands should not wait for.
        from segfloor_ros.evaluation.report import write_report

        recording = Path(input_name)
        truth = recording if (recording / 'map.yaml').is_file() else None
        console.print(f'report: {write_report(out, truth)}', highlight=False, soft_wrap=True)
