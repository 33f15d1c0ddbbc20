"""What the commands print: progress, tables and errors."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from segfloor_ros.recording import RunSummary, summary_rows

console = Console()
error_console = Console(stderr=True, soft_wrap=True)


@contextmanager
def progress_bar(description: str, total: int | None) -> Iterator[Progress]:
    """Show a progress bar with one task (id 0) on the terminal."""
    columns = (
        TextColumn('{task.description}'),
        BarColumn(),
        TaskProgressColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn('{task.fields[note]}'),
    )
    with Progress(*columns, console=error_console, transient=not sys.stderr.isatty()) as progress:
        progress.add_task(description, total=total, note='')
        yield progress


def print_summary(title: str, summary: RunSummary) -> None:
    """Print the figures of a run and the time of each stage as tables with units."""
    table = Table('result', 'value', title=title, title_justify='left')
    for row in summary_rows(summary):
        table.add_row(*row)
    console.print(table)
    stages = Table('stage', 'calls', 'median ms', 'p95 ms', 'max ms')
    for column in stages.columns[1:]:
        column.justify = 'right'
    for name, stage in summary.stages.items():
        values = (stage['p50_ms'], stage['p95_ms'], stage['max_ms'])
        stages.add_row(name, str(stage['count']), *(f'{value:.1f}' for value in values))
    console.print(stages)


def print_error(message: str) -> None:
    """Print one line on standard error."""
    error_console.print(f'segfloor: {message}', markup=False, highlight=False)


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
