"""`segfloor benchmark`: what the stages cost here, and the published evaluation once more."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Optional

import typer
from rich.progress import Progress as ProgressBar

from segfloor_ros.cli.benchmark_tables import published_table, stage_table, workload_table
from segfloor_ros.cli.options import ParamsOption, SetOption
from segfloor_ros.cli.output import console, progress_bar
from segfloor_ros.configuration import Configuration, resolve
from segfloor_ros.errors import InputError
from segfloor_ros.evaluation import benchmark as generated
from segfloor_ros.evaluation import benchmark_scenes as published
from segfloor_ros.evaluation.benchmark import Announce, BenchmarkPlan, parse_sizes
from segfloor_ros.evaluation.benchmark_apart import Progress
from segfloor_ros.evaluation.benchmark_published import PUBLISHED, parse_scenes
from segfloor_ros.evaluation.benchmark_scenes import SceneResult
from segfloor_ros.simulation.any_scene import open_scene

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
    json_file: Annotated[
        Optional[Path],  # noqa: UP045  typer evaluates it, also on Python 3.10
        typer.Option('--json', help='Write all figures to this file.'),
    ] = None,
    published_scenes: Annotated[
        bool, typer.Option('--published', help='Simulate, map and score the published scenes.')
    ] = False,
    scenes: Annotated[str, typer.Option(help='Which of the published scenes.')] = ','.join(
        PUBLISHED
    ),
    workdir: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help='Keep renderings, maps and overlays here; what is there is used again.'),
    ] = None,
    params: ParamsOption = None,
    assignments: SetOption = None,
) -> None:
    """Time, memory and throughput of the stages, also as multiples of a fixed OpenCV workload."""
    configuration = resolve(params, assignments or ())
    _make_folder_of(json_file)
    if published_scenes:
        results = _run_published(parse_scenes(scenes), workdir, configuration, threads)
        _write_json(json_file, published.as_document(results))
        return
    plan = BenchmarkPlan(parse_sizes(sizes), frames, seed, threads)
    with announcing() as announce:
        workloads = generated.run_benchmark(plan, configuration, announce)
    console.print(stage_table(workloads))
    console.print(workload_table(workloads))
    _write_json(json_file, generated.as_document(plan, workloads))


def _run_published(
    names: list[str], workdir: Path | None, configuration: Configuration, threads: int
) -> list[SceneResult]:
    with tempfile.TemporaryDirectory(prefix='segfloor-') as temporary:
        folder = workdir or Path(temporary)
        with announcing() as announce:
            results = [
                published.run_scene(
                    name, open_scene(name), folder / name, configuration, threads, announce
                )
                for name in names
            ]
    console.print(stage_table([result.workload for result in results]))
    console.print(workload_table([result.workload for result in results]))
    console.print(published_table(results))
    if workdir is not None:
        console.print(f'maps on the truth: {workdir}/*/overlay.png', highlight=False)
    return results


@contextmanager
def announcing() -> Iterator[Announce]:
    """Show a progress bar whose task is replaced by the next announced one."""
    with progress_bar('starting', None) as bar:
        yield lambda description, total: _next_task(bar, description, total)


def _next_task(bar: ProgressBar, description: str, total: int) -> Progress:
    task = bar.task_ids[-1]
    bar.reset(task, description=description, total=total or None, note='')
    return lambda done: bar.update(task, completed=done)


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


def _write_json(path: Path | None, document: dict[str, Any]) -> None:
    if path is None:
        return
    path.write_text(json.dumps(document, indent=2) + '\n')
    console.print(f'figures: {path}', highlight=False, soft_wrap=True)
