"""The tables of `segfloor benchmark`."""

from __future__ import annotations

from rich.table import Table

from segfloor_ros.benchmark.figures import Workload
from segfloor_ros.cli.output import figure_table


def stage_table(workloads: list[Workload]) -> Table:
    """Return the time of every stage as a table."""
    table = figure_table('stage', 'calls', 'median ms', 'p95 ms', 'max ms', 'median / reference')
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
