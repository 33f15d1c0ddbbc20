"""Paths beside the published ones of one-camera systems: the drives of a Husky through a town and
of a TurtleBot 3 through a house, with and without what moves, for `tools.benchmark_published`.

The published lengths are the root of (sum of |dx|)^2 + (sum of |dy|)^2 (annex B), of monocular
paths that were scaled to the truth; ours are sums of steps in metres as measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from segfloor_ros.apps.cli.terminal import Announce
from segfloor_ros.apps.evaluation.trajectory import match_files, score_trajectory
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.simulation import RecordingOptions, render_once
from segfloor_ros.apps.suite.job import run_segfloor
from segfloor_ros.core.files.whole import read_json

TIMEOUT_S = 3600.0
SOURCE = 'UFSM thesis (2023, in Portuguese), chapter 4'
FIRST, SECOND = '§4.2, table 1, p. 45', '§4.4, table 2, p. 47 to 49'
WITHOUT = 'segfloor_ros, what moves left out'
MODES = {WITHOUT: (), 'segfloor_ros, what moves used': ('--set', 'stereo_slam.detect_moving=false')}


@dataclass(frozen=True)
class PathRow:
    """A system on a drive. frame_s: median time of a frame. source: '' for what is of here."""

    drive: str
    system: str
    source: str = ''
    length_m: float | None = None
    true_length_m: float | None = None
    tracked_percent: float | None = None
    error_m: float | None = None
    frame_s: float | None = None


def _published(
    drive: str, source: str, true_m: float, orb_m: float, dyna_m: float
) -> tuple[PathRow, ...]:
    both = (('ORB-SLAM3', orb_m), ('DynaSLAM', dyna_m))
    return tuple(PathRow(drive, system, source, m, true_m) for system, m in both)


DRIVES = {
    'town': _published('Husky 01, S', SECOND, 53.54, 56.81, 55.67),
    'town_l': _published('Husky 02, L', SECOND, 50.86, 71.31, 59.05),
    'house': _published('TurtleBot 01, S', SECOND, 20.04, 23.64, 20.75),
    'house_l': _published('TurtleBot 02, L', SECOND, 20.46, 21.18, 20.53),
}
"""Published rows by the scene that follows the drive."""

RECORDINGS = (
    *_published('KITTI 00', FIRST, 3662.13, 3083.56, 3290.67),
    *_published('KITTI 03', FIRST, 697.39, 523.48, 543.41),
    *_published('KITTI 05', FIRST, 112.95, 85.23, 90.97),
    *_published('fr3 walking_xyz', FIRST, 4.88, 2.77, 2.98),
    *_published('fr3 long_office', FIRST, 8.33, 7.97, 7.74),
)
"""Of public data; suites/path_lengths.yaml measures ours beside them."""

FRAME_TIMES = (
    PathRow('all', 'ORB-SLAM3', '§4.5, table 3, p. 49', frame_s=0.0195),
    PathRow('all', 'DynaSLAM', '§4.5, table 3, p. 49', frame_s=0.348),
)

HEADS = ('drive', 'system', 'length', 'true', 'tracked', 'path error', 'time per frame', 'source')


def run_drive(name: str, folder: Path, announce: Announce) -> list[PathRow]:
    """Render a drive into `folder` unless it is there, map it with and without what moves, and
    return the rows.
    """
    recording = folder / 'recording'
    render_once(
        open_scene(name),
        recording,
        RecordingOptions(floor_every=0),
        on_start=lambda count: announce(f'rendering {name}', count),
    )
    rows = []
    for number, (system, words) in enumerate(MODES.items()):
        announce(f'{name}: {system}', 0)
        out = folder / f'run{number}'
        command = ['run', str(recording), '--out', str(out), '--no-map', *words]
        run_segfloor(command, folder / f'run{number}.txt', TIMEOUT_S)
        score = score_trajectory(match_files(out, recording / 'poses.txt'))
        stages = read_json(out / 'summary.json', 'a summary')['stages']
        rows.append(
            PathRow(
                name,
                system,
                '',
                score.estimate_length_m,
                score.path_length_m,
                100 * score.tracked,
                score.ate_rmse_m,
                stages['tracking']['p50_ms'] / 1000,
            )
        )
    return rows


def words_of(row: PathRow) -> tuple[str, ...]:
    """Return a row in words, one cell for each of `HEADS`."""
    return (
        row.drive,
        row.system,
        *(
            '' if value is None else form.format(value)
            for value, form in (
                (row.length_m, '{:.2f} m'),
                (row.true_length_m, '{:.2f} m'),
                (row.tracked_percent, '{:.0f} %'),
                (row.error_m, '{:.3f} m'),
                (row.frame_s, '{:.4g} s'),
            )
        ),
        row.source or 'here',
    )


def all_rows(measured: Sequence[PathRow]) -> list[PathRow]:
    """Return what is measured here, drive by drive above what is published of it, and the rest."""
    rows: list[PathRow] = []
    for name, published in DRIVES.items():
        rows += [*(row for row in measured if row.drive == name), *published]
    return [*rows, *RECORDINGS, *FRAME_TIMES]


PAGE_HEADS = ('drive', 'true, m', 'ORB-SLAM3', 'DynaSLAM', 'true here', *MODES)


def paths_table(measured: Sequence[PathRow]) -> str:
    """Return all rows as a table of Markdown, a line for each drive: published lengths, and ours
    with the error of the path.
    """
    lines = [PAGE_HEADS, ('---',) * len(PAGE_HEADS)]
    for scene, published in (*DRIVES.items(), *((row.drive, (row,)) for row in RECORDINGS[::2])):
        rows = [row for row in (*published, *RECORDINGS) if row.drive == published[0].drive]
        orb, dyna = ({row.system: row for row in rows}[name] for name in ('ORB-SLAM3', 'DynaSLAM'))
        ours = {row.system: row for row in measured if row.drive == scene}
        true_m = next((row.true_length_m for row in ours.values()), None)
        lines.append(
            (
                orb.drive,
                *(f'{value:.2f}' for value in (orb.true_length_m, orb.length_m, dyna.length_m)),
                '' if true_m is None else f'{true_m:.2f}',
                *(_ours(ours.get(system)) for system in MODES),
            )
        )
    times = [f'{row.frame_s:.4g} s' for row in FRAME_TIMES]
    frames = [[row.frame_s or 0.0 for row in measured if row.system == name] for name in MODES]
    own = ['' if not some else f'{median(some):.3f} s' for some in frames]
    lines.append(('median time of a frame', '', *times, '', *own))
    return ''.join('| ' + ' | '.join(line) + ' |\n' for line in lines)


def _ours(row: PathRow | None) -> str:
    if row is None:
        return ''
    tracked = '' if row.tracked_percent == 100 else f', {row.tracked_percent:.0f} % tracked'
    return f'{row.length_m:.2f}, {row.error_m:.3f} off{tracked}'
