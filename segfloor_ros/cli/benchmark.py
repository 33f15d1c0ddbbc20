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
from rich.table import Table

from segfloor_ros.cli.options import ParamsOption, SetOption
from segfloor_ros.cli.output import console, progress_bar
from segfloor_ros.configuration import Configuration, resolve
from segfloor_ros.errors import InputError
from segfloor_ros.evaluation import benchmark as generated
from segfloor_ros.evaluation import benchmark_published as published
from segfloor_ros.evaluation.benchmark import Announce, BenchmarkPlan, parse_sizes
from segfloor_ros.evaluation.benchmark_apart import Progress
from segfloor_ros.evaluation.benchmark_chain import Workload
from segfloor_ros.evaluation.benchmark_published import PublishedFigures, SceneResult
from segfloor_ros.evaluation.prm import RoadMapScore
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
        published.PUBLISHED
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
        results = _run_published(published.parse_scenes(scenes), workdir, configuration, threads)
        _write_json(json_file, published.as_document(results))
        return
    plan = BenchmarkPlan(parse_sizes(sizes), frames, seed, threads)
    with _announcing() as announce:
        workloads = generated.run_benchmark(plan, configuration, announce)
    console.print(stage_table(workloads))
    console.print(workload_table(workloads))
    _write_json(json_file, generated.as_document(plan, workloads))


def _run_published(
    names: list[str], workdir: Path | None, configuration: Configuration, threads: int
) -> list[SceneResult]:
    with tempfile.TemporaryDirectory(prefix='segfloor-') as temporary:
        folder = workdir or Path(temporary)
        with _announcing() as announce:
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


def stage_table(workloads: list[Workload]) -> Table:
    """Return the time of every stage as a table."""
    table = _table('stage', 'calls', 'median ms', 'p95 ms', 'max ms', 'median / reference')
    for workload in workloads:
        table.add_row(f'[bold]{workload.name}')
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
    table = _table('workload', 'items/s', 's/update', 'p95 s', 'max s', 'peak MB', 'MB/update')
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


def published_table(results: list[SceneResult]) -> Table:
    """Return the scores of this run and the published ones side by side."""
    table = _table('figures', 'precision %', 'recall %', 's/update', 'MB/update')
    for result in results:
        workload, score = result.workload, result.score
        costs = (
            f'{workload.update_s["mean"]:.3f}',
            f'{workload.memory_mb["slope_per_update"]:.3f}',
        )
        table.add_row(f'[bold]{result.scene}, {score.area_m2:.1f} m²')
        table.add_row('  here, after opening', *_percent(score.opened), *costs)
        table.add_row('  here, raw', *_percent(score.raw))
        for figures in result.published.figures:
            table.add_row(f'  {figures.method} *', *_published_cells(figures))
        table.add_section()
    table.caption = (
        f'precision and recall of road maps; * {published.SOURCE}: times and memory are means '
        'over all scenes; here: scenes rendered after its descriptions, floor the drive could see'
    )
    return table


def _published_cells(figures: PublishedFigures) -> tuple[str, ...]:
    return (
        f'{figures.precision_percent:.2f}',
        f'{figures.recall_percent:.2f}',
        f'{figures.update_s:.3f}',
        f'{figures.update_mb:.3f}',
    )


def _percent(score: RoadMapScore) -> tuple[str, str]:
    return f'{100 * score.precision.mean:.2f}', f'{100 * score.recall.mean:.2f}'


def _table(names: str, *numbers: str) -> Table:
    table = Table(names, *numbers)
    table.columns[0].no_wrap = True
    for column in table.columns[1:]:
        column.justify = 'right'
    return table


@contextmanager
def _announcing() -> Iterator[Announce]:
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
