"""`segfloor benchmark-nodes`: latency, CPU and memory of the five node processes."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.progress import TaskID
from rich.table import Table

from segfloor_ros.camera.sources import open_source
from segfloor_ros.cli.options import InputArgument, ParamsOption, SetOption
from segfloor_ros.cli.output import console, progress_bar
from segfloor_ros.configuration import resolve
from segfloor_ros.errors import SettingsError
from segfloor_ros.evaluation.endless_drive import write_endless_drive

if TYPE_CHECKING:
    from segfloor_ros.cli.replay_figures import NodeFigures


def benchmark_nodes(
    input: InputArgument,
    rate: Annotated[float, typer.Option(min=0.01, help='Speed against real time.')] = 1.0,
    soak_minutes: Annotated[
        float,
        typer.Option(
            min=0.0,
            help='Drive the recording to and fro for so long, in recording time, and lose no '
            'frame; 0: once, in step with the clock.',
        ),
    ] = 0.0,
    idle_seconds: Annotated[
        float,
        typer.Option(
            min=0.0,
            help='Measure for so long each what the nodes cost without images, with a camera that '
            'stands, and while nobody listens to what they make; 0: drive.',
        ),
    ] = 0.0,
    params: ParamsOption = None,
    assignments: SetOption = None,
) -> None:
    """Measure the nodes on a recording: image to map, CPU and memory of each, what is lost."""
    try:
        from segfloor_ros.cli.replay_figures import measure_nodes
        from segfloor_ros.cli.replay_idle import longest_s, measure_idle
    except ImportError as error:
        raise SettingsError(f'benchmark-nodes needs ROS 2 ({error})') from None
    configuration = resolve(params, assignments or (), stereo_camera={'input': input})
    source = open_source(configuration.stereo_camera)
    with tempfile.TemporaryDirectory(prefix='segfloor-soak-') as folder:
        if idle_seconds:
            stands = write_endless_drive(
                source, Path(folder) / 'stands', longest_s(idle_seconds), stands=True
            )
            configuration = resolve(params, assignments or (), stereo_camera={'input': str(stands)})
            console.print(idle_table(measure_idle(configuration, idle_seconds)))
            return
        if soak_minutes:
            drive = write_endless_drive(source, Path(folder) / 'drive', 60 * soak_minutes)
            configuration = resolve(params, assignments or (), stereo_camera={'input': str(drive)})
            source = open_source(configuration.stereo_camera)
        with progress_bar('playing', source.frame_count) as progress:
            figures = measure_nodes(
                configuration,
                rate,
                bool(soak_minutes),
                lambda done, state: progress.update(TaskID(0), completed=done, note=state),
            )
    console.print(figures_table(figures))


def idle_table(shares: Mapping[str, Mapping[str, float]]) -> Table:
    """Return shares of a core by phase and node as a table in percent."""
    table = Table('node', *shares)
    for node in next(iter(shares.values())):
        table.add_row(node, *(f'{100 * by_node[node]:.1f} %' for by_node in shares.values()))
    return table


def figures_table(figures: NodeFigures) -> Table:
    """Return the figures as a table; of a course, its second and its last quarter."""
    table = Table('figure', 'value')
    for name, value in figure_rows(figures):
        table.add_row(name, value)
    return table


def figure_rows(figures: NodeFigures) -> list[tuple[str, str]]:
    """Return names and values of the figures, with units."""
    latency_ms = 1e3 * figures.latency_s
    rows = [
        ('frames sent, processed', f'{figures.frames_sent}, {figures.frames_processed}'),
        ('frames skipped to stay up to date', f'{figures.frames_skipped}'),
        ('keyframes, in the map', f'{figures.keyframes}, {figures.mapped}'),
        ('frames per second', f'{figures.frames_processed / figures.wall_s:.1f}'),
        ('interrupt to all ended', f'{figures.shutdown_s:.2f} s'),
    ]
    if len(latency_ms):
        middle, high = np.percentile(latency_ms, (50, 95))
        rows.append(('image to map, median and p95', f'{middle:.0f} ms, {high:.0f} ms'))
        early, late = (np.median(part) for part in _second_and_last_quarter(latency_ms))
        rows.append(('image to map, 2nd and last quarter', f'{early:.0f} ms, {late:.0f} ms'))
    for node, duration_s in figures.steps_s.items():
        if len(duration_s):
            middle, high = 1e3 * np.percentile(duration_s, (50, 95))
            rows.append((f'until {node} had done, median and p95', f'{middle:.0f}, {high:.0f} ms'))
    for column, (node, share) in enumerate(figures.cpu_share.items(), 1):
        rows.append((f'{node}: CPU', f'{100 * share:.0f} % of a core'))
        if len(figures.memory_mb):
            parts = _second_and_last_quarter(figures.memory_mb[:, column])
            early, late = (np.median(part) for part in parts)
            rows.append((f'{node}: memory, 2nd and last quarter', f'{early:.1f} MB, {late:.1f} MB'))
    return rows


def _second_and_last_quarter(course: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two parts of a course (N,) to compare; in the first quarter caches fill."""
    quarter = max(len(course) // 4, 1)
    return course[quarter : 2 * quarter] if len(course) > 1 else course, course[-quarter:]
