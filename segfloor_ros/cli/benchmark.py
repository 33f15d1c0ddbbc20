"""`segfloor benchmark`: what the stages cost here, or the five node processes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Optional

import typer

from segfloor_ros.benchmark.stages import BenchmarkPlan, as_document, parse_sizes, run_benchmark
from segfloor_ros.camera.sources import open_source
from segfloor_ros.cli.benchmark_tables import stage_table, workload_table
from segfloor_ros.cli.options import ParamsOption, SetOption
from segfloor_ros.cli.output import announcing, console
from segfloor_ros.configuration import Configuration, resolve
from segfloor_ros.errors import InputError, SettingsError

DEFAULT = BenchmarkPlan()


def benchmark(
    sizes: Annotated[
        str, typer.Option(help='Keyframes for labelling and grid, one run for each number.')
    ] = ','.join(map(str, DEFAULT.sizes)),
    frames: Annotated[
        int, typer.Option(min=2, help='Generated image pairs for all stages.')
    ] = DEFAULT.frames,
    seed: Annotated[int, typer.Option(help='Of the generated data.')] = DEFAULT.seed,
    threads: Annotated[
        int, typer.Option(min=1, help='Threads of OpenCV; one compares machines best.')
    ] = DEFAULT.threads,
    nodes: Annotated[
        Optional[str],  # noqa: UP045  typer evaluates it, also on Python 3.10
        typer.Option(
            metavar='RECORDING',
            help='Play this recording through the five node processes instead: latency from image '
            'to map, CPU, memory and losses.',
        ),
    ] = None,
    rate: Annotated[
        float, typer.Option(min=0.01, help='Speed of --nodes against real time.')
    ] = 1.0,
    json_file: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option('--json', help='Write all figures of the stages to this file.'),
    ] = None,
    params: ParamsOption = None,
    assignments: SetOption = None,
) -> None:
    """Time, memory and throughput of the stages, also as multiples of a fixed OpenCV workload."""
    if nodes is not None:
        print_node_figures(resolve(params, assignments or (), stereo_camera={'input': nodes}), rate)
        return
    configuration = resolve(params, assignments or ())
    _make_folder_of(json_file)
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
    with announcing() as announce:
        progress = announce('playing', frames or 0)
        figures = measure_nodes(configuration, rate, lossless, lambda done, state: progress(done))
    console.print(figures_table(figures))


def _make_folder_of(path: Path | None) -> None:
    """Find out before minutes of work whether the figures can be written."""
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open('a'):
            pass
    except OSError as error:
        reason = error.strerror
        raise InputError(f'{path}: cannot be written ({reason}); choose another --json') from None


def write_json(path: Path | None, document: dict[str, Any]) -> None:
    """Write figures to a file and say where."""
    if path is None:
        return
    path.write_text(json.dumps(document, indent=2) + '\n')
    console.print(f'figures: {path}', highlight=False, soft_wrap=True)
