"""The five node processes over hours of a recording, or with nothing to do:
`python -m tools.benchmark_nodes`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from segfloor_ros.apps.cli import terminal as options
from segfloor_ros.apps.cli.evaluate import print_node_figures
from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.nodes.configuration import resolve
from tools.endless_drive import write_endless_drive
from tools.idle_nodes import longest_s, measure_idle


def benchmark_nodes(
    input: options.Input,
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
    params: options.Params = None,
    assignments: options.Set = None,
) -> None:
    """Measure the nodes on a recording: image to map, CPU and memory of each, what is lost."""
    configuration = resolve(params, assignments or (), stereo_camera={'input': input})
    source = open_source(configuration.stereo_camera)
    with tempfile.TemporaryDirectory(prefix='segfloor-soak-') as folder:
        path = Path(folder) / 'drive'
        if idle_seconds:
            write_endless_drive(source, path, longest_s(idle_seconds), stands=True)
            configuration = resolve(params, assignments or (), stereo_camera={'input': str(path)})
            console.print(idle_table(measure_idle(configuration, idle_seconds)))
            return
        if soak_minutes:
            write_endless_drive(source, path, 60 * soak_minutes)
            configuration = resolve(params, assignments or (), stereo_camera={'input': str(path)})
        print_node_figures(configuration, rate, lossless=bool(soak_minutes))


def idle_table(shares: Mapping[str, Mapping[str, float]]) -> Table:
    """Return shares of a core by phase and node as a table in percent."""
    table = Table('node', *shares)
    for node in next(iter(shares.values())):
        table.add_row(node, *(f'{100 * by_node[node]:.1f} %' for by_node in shares.values()))
    return table


if __name__ == '__main__':
    run_command(benchmark_nodes)
