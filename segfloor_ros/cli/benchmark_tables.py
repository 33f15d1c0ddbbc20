"""The tables of `segfloor benchmark`."""

from __future__ import annotations

from rich.table import Table

from segfloor_ros.evaluation.benchmark_figures import Workload
from segfloor_ros.evaluation.benchmark_published import SOURCE, PublishedFigures
from segfloor_ros.evaluation.benchmark_scenes import SceneResult
from segfloor_ros.evaluation.prm import RoadMapScore


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
        cell_cm = 100 * result.cell_m
        table.add_row(f'[bold]{result.scene}, {score.area_m2:.1f} m², {cell_cm:g} cm')
        table.add_row('  here, after opening', *_percent(score.opened), *costs)
        table.add_row('  here, raw', *_percent(score.raw))
        for figures in result.published.figures:
            table.add_row(f'  {figures.method} *', *_published_cells(figures))
        table.add_section()
    table.caption = (
        f'precision and recall of road maps; * {SOURCE}: times and memory are means '
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
