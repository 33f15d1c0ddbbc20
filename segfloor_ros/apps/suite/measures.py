"""What a suite can bound: the measures of a mapped recording, bounds on them, and verdicts."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from segfloor_ros.apps.evaluation.floor import score_floor_folders
from segfloor_ros.apps.evaluation.map_score import score_map
from segfloor_ros.apps.evaluation.maps import load_truth, resample
from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.results_folder import read_summary
from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.whole import number as finite_number
from segfloor_ros.core.files.whole import read_json
from segfloor_ros.core.files.writing import Kind, write_output
from segfloor_ros.core.geometry import Pose2d
from segfloor_ros.core.grid.occupancy import UNKNOWN, OccupancyGrid

HIGHER, LOWER, NEITHER = 'higher', 'lower', 'neither'

PATHS = ('.txt', '.csv')
"""Of files with a true path."""

Baseline = Mapping[str, Mapping[str, float]]
"""Measures by recording."""


@dataclass(frozen=True)
class Measure:
    """better: which way is better. slack: by how much it may be worse than the baseline unless the
    suite says otherwise; relative: as a share of the baseline; None: it is not compared.
    """

    unit: str
    better: str
    description: str
    slack: float | None = None
    relative: bool = False


MEASURES = {
    'tracked_percent': Measure('%', HIGHER, 'frames with a pose', 1.0),
    'lost_intervals': Measure('', LOWER, 'stretches of frames without a pose', 0.0),
    'path_error_m': Measure('m', LOWER, 'RMSE of the path after rigid alignment', 0.01),
    'end_error_m': Measure('m', LOWER, 'error of the last pose, seen from the first', 0.02),
    'length_m': Measure('m', NEITHER, 'length of the path, between the poses with a true one'),
    'true_length_m': Measure('m', NEITHER, 'length of the true path between the same poses'),
    'return_m': Measure('m', LOWER, 'from the last pose to the first'),
    'precision_percent': Measure('%', HIGHER, 'of road maps, map after opening', 0.5),
    'recall_percent': Measure('%', HIGHER, 'of road maps, map after opening', 1.0),
    'free_precision_percent': Measure('%', HIGHER, 'of the cells called free', 0.5),
    'free_recall_percent': Measure('%', HIGHER, 'of the cells that are free', 1.0),
    'floor_precision_percent': Measure('%', HIGHER, 'of the floor masks', 0.5),
    'floor_recall_percent': Measure('%', HIGHER, 'of the floor masks', 1.0),
    'agreement_percent': Measure('%', HIGHER, 'cells known here and in reference_map, alike', 1.0),
    'known_area_m2': Measure('m²', HIGHER, 'free and occupied cells', 0.02, relative=True),
    'keyframes': Measure('', NEITHER, 'keyframes'),
    'loops': Measure('', NEITHER, 'closed loops'),
    'camera_height_m': Measure('m', NEITHER, 'height of the camera above the floor'),
    'time_ratio': Measure('', LOWER, 'median of all stages per keyframe, in reference workloads'),
    'memory_peak_mb': Measure('MB', LOWER, 'resident memory at most', 0.2, relative=True),
    'memory_per_update_mb': Measure('MB', LOWER, 'more resident memory per map update'),
    'wall_s': Measure('s', LOWER, 'time of mapping'),
}


def measure_run(
    run: Path,
    truth: Path | None,
    reference_map: Path | None,
    start_pose: Pose2d | None = None,
    reference_ms: float = float('nan'),
) -> dict[str, float]:
    """Return the measures of a results folder by name, those that its files and the truth allow.

    truth: a folder with map.yaml (and scene.yaml, base_poses.txt), poses.txt or floor/, a map YAML,
    or a path (.txt, .csv). reference_map: a map of an earlier run from the same start. start_pose:
    where the map's frame lies in the truth's. reference_ms: median time of the reference workload.
    Raises InputError naming what cannot be read.
    """
    grid, measured = None, {}
    summary = run / 'summary.json'
    # A run without a map says so in its summary.
    if (run / 'map.yaml').is_file() or not summary.is_file():
        grid = load_map(run / 'map.yaml')
        measured['known_area_m2'] = grid.area_m2(grid.states != UNKNOWN)
    if summary.is_file():
        measured.update(_of_summary(read_summary(summary), reference_ms))
    if (run / 'trajectory.txt').is_file():
        measured['return_m'] = _return_m(run / 'trajectory.txt')
    if truth is not None:
        measured.update(_against_truth(run, grid, truth, start_pose))
    if reference_map is not None and grid is not None:
        measured['agreement_percent'] = 100 * agreement(grid, load_map(reference_map))
    return {name: round(value, 6) for name, value in measured.items() if np.isfinite(value)}


def known_measures(values: Any) -> dict[str, float]:
    """Return measures by name as a file has them. Raises AttributeError or ValueError."""
    return {name: finite_number(str(value)) for name, value in values.items()}


def start_pose_of(truth: Path | None) -> Pose2d | None:
    """Return where the frame of a map that starts with this drive lies in the truth's; None where
    nobody said. Raises InputError.
    """
    if truth is None or not _has_map(truth):
        return None
    return load_truth(truth).start_pose


def _has_map(truth: Path) -> bool:
    if not truth.exists():
        raise InputError(f'{truth}: there is no such truth')
    return (truth / 'map.yaml').is_file() if truth.is_dir() else truth.suffix not in PATHS


def agreement(grid: OccupancyGrid, reference: OccupancyGrid) -> float:
    """Return the share of the cells known in both maps, of one frame, that say the same. NaN where
    there is none.
    """
    here, there = resample(grid, reference), reference.states
    both = (here != UNKNOWN) & (there != UNKNOWN)
    return float((here == there)[both].mean()) if both.any() else float('nan')


def _of_summary(summary: dict[str, Any], reference_ms: float) -> dict[str, float]:
    stage_ms = sum(stage['p50_ms'] for stage in summary['stages'].values())
    memory = summary['rss_mb']
    return {
        'tracked_percent': 100 * summary['tracked_frames'] / max(1, summary['frames']),
        'lost_intervals': float(len(summary['lost_intervals'])),
        'keyframes': float(summary['keyframes']),
        'loops': float(summary['loops']),
        'camera_height_m': float(summary['camera_height_m'] or 'nan'),
        'time_ratio': stage_ms / reference_ms,
        'memory_peak_mb': float(memory['peak']),
        'memory_per_update_mb': float(memory['slope_per_update']),
        'wall_s': float(summary['wall_s']),
    }


def _return_m(trajectory: Path) -> float:
    poses = read_trajectory(trajectory)[1]
    return float(np.linalg.norm(poses[-1, :3, 3] - poses[0, :3, 3]))


def _against_truth(
    run: Path, grid: OccupancyGrid | None, truth: Path, start_pose: Pose2d | None
) -> dict[str, float]:
    measured: dict[str, float] = {}
    if _has_map(truth) and grid is not None:
        score = score_map(grid, load_truth(truth), start_pose or (0.0, 0.0, 0.0))
        measured['precision_percent'] = 100 * score.opened.precision.mean
        measured['recall_percent'] = 100 * score.opened.recall.mean
        measured['free_precision_percent'] = 100 * score.cells.free_precision
        measured['free_recall_percent'] = 100 * score.cells.free_recall
    path_file = truth / 'poses.txt' if truth.is_dir() else truth
    if (
        path_file.is_file()
        and path_file.suffix in PATHS
        and (run / 'camera_trajectory.txt').is_file()
    ):
        # Imported here: evo takes a second that no other command should wait for.
        from segfloor_ros.apps.evaluation.trajectory import match_files, score_trajectory

        path = score_trajectory(match_files(run, path_file))
        measured['path_error_m'] = path.ate_rmse_m
        measured['end_error_m'] = path.end_error_m
        measured['length_m'] = path.estimate_length_m
        measured['true_length_m'] = path.path_length_m
    if _share_masks(run / 'floor_masks', truth / 'floor'):
        floor = score_floor_folders(run, truth)
        measured['floor_precision_percent'] = 100 * floor.precision
        measured['floor_recall_percent'] = 100 * floor.recall
    return measured


def _share_masks(ours: Path, true: Path) -> bool:
    names = [{file.name for file in folder.glob('*.png')} for folder in (ours, true)]
    return bool(names[0] & names[1])


@dataclass(frozen=True)
class Bound:
    """A measure's least and greatest value allowed; origin: what asks for it, empty for the suite
    itself.
    """

    measure: str
    least: float = -math.inf
    greatest: float = math.inf
    origin: str = ''

    @property
    def wanted(self) -> str:
        """What is wanted, in words."""
        parts = []
        if self.least > -math.inf:
            parts.append(f'at least {number(self.least)}')
        if self.greatest < math.inf:
            parts.append(f'at most {number(self.greatest)}')
        unit = MEASURES[self.measure].unit
        return ' and '.join(parts) + (f' {unit}' if unit else '') + self.origin


@dataclass(frozen=True)
class Verdict:
    """A bound and what was measured; None: it could not be measured."""

    bound: Bound
    measured: float | None

    @property
    def holds(self) -> bool:
        """Whether the bound is kept."""
        if self.measured is None:
            return False
        limits = self.bound.least, self.bound.greatest
        is_at_limit = any(math.isclose(self.measured, limit) for limit in limits)
        return is_at_limit or limits[0] < self.measured < limits[1]

    def __str__(self) -> str:
        measure = MEASURES[self.bound.measure]
        if self.measured is None:
            found = 'was not measured: no truth for it'
        else:
            found = f'{number(self.measured)}{f" {measure.unit}" if measure.unit else ""}'
        return f'{self.bound.measure}: {found}, wanted {self.bound.wanted}'


@dataclass(frozen=True)
class Slack:
    """By how much a measure may be worse than the baseline; relative: as a share of it."""

    value: float
    relative: bool = False


def bounds_of_baseline(baseline: Mapping[str, float], slacks: Mapping[str, Slack]) -> list[Bound]:
    """Return what must hold for values to be no worse than a baseline by more than a slack: the
    suite's, else the measure's own.
    """
    bounds = []
    for name, measure in MEASURES.items():
        slack = slacks.get(name)
        if slack is None and measure.slack is not None:
            slack = Slack(measure.slack, measure.relative)
        if slack is None or name not in baseline:
            continue
        base = baseline[name]
        margin = abs(base) * slack.value if slack.relative else slack.value
        origin = f' (baseline {number(base)})'
        if measure.better == HIGHER:
            bounds.append(Bound(name, least=base - margin, origin=origin))
        elif measure.better == LOWER:
            bounds.append(Bound(name, greatest=base + margin, origin=origin))
        else:
            bounds.append(Bound(name, base - margin, base + margin, origin))
    return bounds


def number(value: float) -> str:
    """Return a value with four significant digits, and whole ones as they are."""
    return f'{value:.0f}' if value == round(value) else f'{value:.4g}'


@dataclass(frozen=True)
class Outcome:
    """What came of a job. problem: why there is no map, '' where there is one. archive: the results
    folder, packed. start_pose: where the map's frame lies in the truth's. worker: host and process.
    reused: from the cache.
    """

    name: str
    measured: dict[str, float]
    problem: str = ''
    archive: bytes = b''
    start_pose: Pose2d | None = None
    seconds: float = 0.0
    worker: str = ''
    reused: bool = False
    package: str = ''


@dataclass(frozen=True)
class Checked(Outcome):
    """What came of a recording, and what its measures say to its bounds."""

    verdicts: tuple[Verdict, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether there is a map and every bound is kept."""
        return not self.problem and all(verdict.holds for verdict in self.verdicts)

    @property
    def state(self) -> str:
        """How it went, in words."""
        return 'ok' if self.holds else 'no map' if self.problem else 'fails'

    @property
    def complaints(self) -> list[str]:
        """A line for each thing that is wrong."""
        if self.problem:
            return [f'{self.name}: {self.problem}']
        return [f'{self.name}: {verdict}' for verdict in self.verdicts if not verdict.holds]


@dataclass(frozen=True)
class SuiteResult:
    """All recordings of a suite, in its order."""

    name: str
    recordings: list[Checked]

    @property
    def holds(self) -> bool:
        """Whether everything is as it should be."""
        return all(checked.holds for checked in self.recordings)


def check(outcome: Outcome, bounds: Iterable[Bound]) -> Checked:
    """Hold an outcome against bounds."""
    # The archive is in the suite's folder by now.
    known = {**vars(outcome), 'archive': b''}
    verdicts = tuple(Verdict(bound, outcome.measured.get(bound.measure)) for bound in bounds)
    return Checked(**known, verdicts=verdicts)


def write_baseline(result: SuiteResult, path: Path) -> None:
    """Write the measures of all recordings that have a map. Raises InputError."""
    measures = {c.name: dict(c.measured) for c in result.recordings if not c.problem}
    document = {'recordings': measures}
    write_output(path, BASELINE, (json.dumps(document, indent=2) + '\n').encode())


def is_baseline(path: Path) -> bool:
    """Whether a file is one of `write_baseline`."""
    try:
        read_baseline(path)
    except InputError:
        return False
    return True


BASELINE = Kind('baseline', is_baseline)


def read_baseline(path: Path) -> Baseline:
    """Read what `write_baseline` wrote. Raises InputError."""
    try:
        recordings = read_json(path, 'a baseline')['recordings']
        return {name: known_measures(measures) for name, measures in recordings.items()}
    except (ValueError, KeyError, AttributeError):
        raise InputError(f'{path}: not a baseline; write one with --write-baseline') from None
