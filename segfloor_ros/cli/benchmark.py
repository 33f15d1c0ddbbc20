"""`segfloor benchmark`: what the stages cost here, or the five node processes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table
from rich.text import Text

from segfloor_ros.benchmark.stages import (
    BenchmarkPlan,
    Workload,
    as_document,
    parse_sizes,
    run_benchmark,
)
from segfloor_ros.camera.sources import open_source
from segfloor_ros.cli import options
from segfloor_ros.cli.options import within
from segfloor_ros.cli.output import announcing, console, figure_table, progress_bar
from segfloor_ros.configuration import Configuration, resolve
from segfloor_ros.errors import SettingsError
from segfloor_ros.files.results import check_writable, write_file

DEFAULT = BenchmarkPlan()


def benchmark(
    sizes: Annotated[
        str, typer.Option(help='Keyframes for labelling and grid, one run for each number.')
    ] = ','.join(map(str, DEFAULT.sizes)),
    frames: Annotated[
        int, typer.Option(callback=within(2), help='Generated image pairs for all stages.')
    ] = DEFAULT.frames,
    seed: Annotated[
        int, typer.Option(callback=within(0), help='Of the generated data.')
    ] = DEFAULT.seed,
    threads: Annotated[
        int, typer.Option(callback=within(1), help='Threads of OpenCV; one compares machines best.')
    ] = DEFAULT.threads,
    nodes: Annotated[
        str | None,
        typer.Option(
            metavar='RECORDING',
            help='Play this recording through the five node processes instead: latency from image '
            'to map, CPU, memory and losses.',
        ),
    ] = None,
    rate: Annotated[
        float, typer.Option(callback=within(0.01), help='Speed of --nodes against real time.')
    ] = 1.0,
    json_file: Annotated[
        Path | None,
        typer.Option('--json', help='Write all figures of the stages to this file.'),
    ] = None,
    params: options.Params = None,
    assignments: options.Set = None,
) -> None:
    """Time, memory and throughput of the stages, also as multiples of a fixed OpenCV workload."""
    if nodes is not None:
        print_node_figures(options.configuration(params, assignments, nodes), rate)
        return
    configuration = resolve(params, assignments or ())
    if json_file is not None:
        check_writable(json_file, '--json')
    plan = BenchmarkPlan(parse_sizes(sizes), frames, seed, threads)
    with announcing() as announce:
        workloads = run_benchmark(plan, configuration, announce)
    console.print(stage_table(workloads))
    console.print(workload_table(workloads))
    write_json(json_file, as_document(plan, workloads))


def print_node_figures(configuration: Configuration, rate: float, lossless: bool = False) -> None:
    """Play the recording of the configuration through the nodes and print what it cost. lossless:
    lose no frame, as opposed to keeping to the clock.
    """
    try:
        from segfloor_ros.cli.replay_measured import figures_table, measure_nodes
    except ImportError as error:
        raise SettingsError(f'to measure the nodes needs ROS 2 ({error})') from None
    frames = open_source(configuration.stereo_camera).frame_count
    with progress_bar('playing', frames) as progress:
        figures = measure_nodes(configuration, rate, lossless, progress)
    console.print(figures_table(figures))


def write_json(path: Path | None, document: dict[str, Any]) -> None:
    """Write figures to a file and say where."""
    if path is None:
        return
    write_file(path, (json.dumps(document, indent=2) + '\n').encode())
    console.print(f'figures: {path}', highlight=False, soft_wrap=True)


def stage_table(workloads: list[Workload]) -> Table:
    """Return the time of every stage as a table."""
    table = figure_table('stage', 'calls', 'median ms', 'p95 ms', 'max ms', 'median / reference')
    for workload in workloads:
        table.add_row(Text(workload.name, 'bold'))
        for name, stage in workload.stages.items():
            times = (f'{stage[key]:.2f}' for key in ('p50_ms', 'p95_ms', 'max_ms'))
            ratio = f'{stage["p50_ratio"]:.3f}'
            table.add_row(f'  {name}', str(stage['count']), *times, ratio)
        table.add_row('  reference', '', f'{workload.reference_ms:.2f}', '', '', '1.000')
        table.add_section()
    table.caption = 'reference: ORB and semi-global matching of a fixed 640x480 pair, timed beside'
    return table


def workload_table(workloads: list[Workload]) -> Table:
    """Return throughput, map updates and memory of every workload as a table."""
    table = figure_table(
        'workload', 'items/s', 's/update', 'p95 s', 'max s', 'peak MB', 'MB/update'
    )
    for workload in workloads:
        updates = (f'{workload.update_s.get(key, 0.0):.4f}' for key in ('mean', 'p95', 'max'))
        table.add_row(
            workload.name,
            f'{workload.items_per_s:.1f}',
            *updates,
            f'{workload.memory_mb["peak"]:.0f}',
            f'{workload.memory_mb["slope_per_update"]:.3f}',
        )
    table.caption = (
        'items: frames, or keyframes where there are no images; update: all that is done once per '
        'keyframe, the map included; one thread; memory grows by the slope of the second half'
    )
    return table
