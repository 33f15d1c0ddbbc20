"""The summary.json of a run, with the figures that scores and reports need."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from segfloor_ros.errors import InputError
from segfloor_ros.files.whole import read_json

FIGURES = (
    'frames', 'tracked_frames', 'keyframes', 'loops', 'map_updates', 'wall_s', 'frames_per_s',
)  # fmt: skip
MOUNT_FIGURES = ('camera_height_m', 'camera_pitch_rad', 'camera_roll_rad')
STAGE_FIGURES = ('count', 'p50_ms', 'p95_ms', 'max_ms')


def read_summary(path: Path) -> dict[str, Any]:
    """Return what a summary says; `camera_roll_rad` is 0 where it says none, and all three of the
    mount are None where it is not known. Raises InputError for a file that is no summary of a run.
    """
    summary = {'camera_roll_rad': 0.0, **read_json(path, 'the summary of a run')}
    try:
        memory, stages = summary['rss_mb'], summary['stages']
        figures = [summary[name] for name in FIGURES]
        mount = [summary[name] for name in MOUNT_FIGURES]
        figures += mount if any(value is not None for value in mount) else []
        figures += [stage[name] for stage in stages.values() for name in STAGE_FIGURES]
        figures += [memory['start'], memory['peak'], memory['slope_per_update']]
        figures += [*memory.get('samples', []), memory.get('updates_per_sample', 1)]
        figures.append(len(summary['lost_intervals']))
    except (KeyError, TypeError, AttributeError):
        raise InputError(f'{path}: not the summary of a run') from None
    for figure in figures:
        if type(figure) not in (int, float) or not math.isfinite(figure) or abs(figure) > 1e12:
            raise InputError(f'{path}: not the summary of a run: {str(figure)[:40]} is no figure')
    return summary
