"""The error of the path and the cost of a frame, over several drives, or over hours of one:
`python -m tools.benchmark_slam`.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated, Optional

import numpy as np
import typer
from rich.table import Table

from segfloor_ros.apps.cli import terminal as options
from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.cli.terminal import Announce, announcing, figure_table
from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.plugins.assembly import make_pipeline
from segfloor_ros.nodes.configuration import resolve
from tools.driving import open_recording, recordings
from tools.endless_drive import write_endless_drive
from tools.slam_drives import DRIVES, DriveResult, measure_drive
from tools.soak import Soak, SoakPart


def benchmark_slam(
    drives: Annotated[
        Optional[list[str]],  # noqa: UP045  typer evaluates it, also on Python 3.10
        typer.Argument(
            help='Recordings with poses.txt, and scenes to simulate. [default: '
            + ' '.join(DRIVES)
            + ']'
        ),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help='Drives of each scene, seeds 1, 2, ...')] = 2,
    workdir: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help='Keep renderings here; what is there is used again.'),
    ] = None,
    soak_minutes: Annotated[
        float,
        typer.Option(
            min=0.0,
            help='Drive each recording to and fro for so long, in recording time, through all '
            'five stages; 0: once, SLAM alone.',
        ),
    ] = 0.0,
    rate: Annotated[
        float, typer.Option(min=0.0, help='Frames a second of a soak. [default: as recorded]')
    ] = 0.0,
    params: options.Params = None,
    assignments: options.Set = None,
) -> None:
    """Track drives whose path is known: error of the path, time per frame and keyframe."""
    configuration = resolve(params, assignments or ())
    results = []
    with tempfile.TemporaryDirectory(prefix='segfloor-') as temporary:
        folder = workdir or Path(temporary)
        with announcing() as announce:
            for drive in drives or DRIVES:
                for name, recording in recordings(drive, seeds, folder, announce):
                    if soak_minutes:
                        parts = _soak(name, recording, configuration, soak_minutes, rate, announce)
                        console.print(soak_table(name, parts))
                        continue
                    report = announce(f'tracking {name}', len(list(recording.glob('image_0/*'))))
                    results.append(measure_drive(name, recording, configuration, report))
    if results:
        console.print(drives_table(results))


def _soak(
    name: str,
    recording: Path,
    configuration: Configuration,
    minutes: float,
    rate_hz: float,
    announce: Announce,
) -> list[SoakPart]:
    source = open_recording(recording, configuration)
    truth = read_trajectory(recording / 'poses.txt')[1]
    with tempfile.TemporaryDirectory(prefix='segfloor-soak-') as folder:
        path = write_endless_drive(source, Path(folder) / 'drive', 60 * minutes, rate_hz=rate_hz)
        endless = open_recording(path, configuration)
        report = announce(f'soaking {name}', endless.frame_count or 0)
        pipeline = make_pipeline(endless.camera, configuration)
        return Soak(pipeline, endless, truth).run(report)


def soak_table(name: str, parts: list[SoakPart]) -> Table:
    """Return a row for each part of a soak."""
    columns = ('tracked', 'keyframes', 'in map', 'points', 'CPU ms', 'p95', 'error m', 'MB')
    table = figure_table('minutes', *columns)
    table.title = name
    for part in parts:
        middle, high = part.frame_ms
        table.add_row(
            f'{part.minutes:.0f}',
            f'{part.tracked}/{part.frames}',
            f'{part.keyframes}',
            f'{part.views}',
            f'{part.points}',
            f'{middle:.1f}',
            f'{high:.1f}',
            f'{part.error_m:.4f}',
            f'{part.rss_mb:.1f}',
        )
    return table


def drives_table(results: list[DriveResult]) -> Table:
    """Return a row for each drive, then the median and the worst error of the path."""
    names = ('tracked', 'path m', 'error m', 'tracking ms', 'p95', 'mapping ms')
    table = figure_table('drive', *names)
    for result in results:
        score, tracking = result.score, result.stages['tracking']
        table.add_row(
            result.name,
            f'{round(score.tracked * score.frames)}/{score.frames}',
            f'{score.path_length_m:.1f}',
            f'{score.ate_rmse_m:.4f}',
            f'{tracking["mean_ms"]:.1f}',
            f'{tracking["p95_ms"]:.1f}',
            f'{result.stages["mapping"]["mean_ms"]:.1f}',
        )
    errors_m = [result.score.ate_rmse_m for result in results]
    table.caption = (
        f'error: RMSE of the camera path after rigid alignment; of {len(errors_m)} drives median '
        f'{np.median(errors_m):.4f} m, worst {max(errors_m):.4f} m; times: means'
    )
    return table


if __name__ == '__main__':
    run_command(benchmark_slam)
