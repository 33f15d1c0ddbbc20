"""The figures of README and docs/benchmarks.md, from one run of everything they name.

`python -m tools.figures measure DATA WORK` renders the drives, maps all of them and the recordings
in DATA, and writes docs/figures.json; what is there already is used again. `python -m tools.figures
write` puts its figures, and those of docs/published.json (`tools.benchmark_published`), between the
marks of the two pages.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from scipy.optimize import minimize_scalar

from segfloor_ros import __version__
from segfloor_ros.apps.cli.main import run_app
from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.cli.terminal import announcing
from segfloor_ros.apps.evaluation.floor import score_floor_folders
from segfloor_ros.apps.evaluation.trajectory import match_files, score_trajectory
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.simulation import RecordingOptions, render_once
from segfloor_ros.apps.suite.job import run_segfloor
from segfloor_ros.apps.suite.measures import measure_run, start_pose_of
from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.files.whole import read_json
from segfloor_ros.core.geometry import Array
from tools.published_figures import Row, page_table
from tools.published_paths import PathRow, paths_table
from tools.published_peers import SlamRow, slam_table

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / 'docs' / 'figures.json'
PUBLISHED_FIGURES = ROOT / 'docs' / 'published.json'
PAGES = (ROOT / 'README.md', ROOT / 'docs' / 'benchmarks.md')
OUTLINES = ROOT / 'test' / 'core' / 'floor'
TIMEOUT_S = 3600.0
LONGEST_LAG_S = 10.0


@dataclass(frozen=True)
class Drive:
    """label: in README, where it stands there. scene: rendered, else a recording of that name.
    truth: file of the path in the recording. is_mapped: it has a level floor. end: true last
    position of the left camera in its first pose's frame.
    """

    about: str
    label: str = ''
    scene: str = ''
    truth: str = ''
    is_mapped: bool = True
    end: tuple[float, float, float] | None = None


DRIVES = {
    'corridor': Drive('rendered corridor, 640×480', 'rendered corridor, 640×480'),
    'corridor1': Drive('corridor with a half-open door', scene='corridor1'),
    'complex_room': Drive('room full of things with thin legs', scene='complex_room'),
    'people_crossing': Drive(
        'two people cross', 'people cross in front of the camera', 'people_crossing'
    ),
    'traffic': Drive('a lane with two moving cars, 620×188', scene='traffic'),
    'rolling': Drive('a camera that rolls and bounces', scene='rolling'),
    'blind_corridor': Drive(
        '5 m of blank walls, a fast turn, 3 s in the dark; wheels and IMU',
        '5 m of blank walls, 3 s in the dark; wheels and IMU',
        'blind_corridor',
    ),
    'kitti06': Drive(
        'KITTI odometry 06, frames 0–50, 1226×370', 'KITTI odometry 06, frames 0–50'
    ),
    'library': Drive(
        'library aisles, hand-pushed, 320×240 JPEG with blur',
        'library aisles, hand-pushed, 320×240 with blur',
        end=(0.08, -0.03, 0.94),
    ),
    'rover': Drive('a rover in a dark hall with sand, 1 image a second',
                   'a rover in sand, 1 image a second', truth='truth_xy.csv'),
    'kitchen': Drive(
        'a kitchen, hand-held Kinect, repeated images', 'a hand-held Kinect', truth='truth.txt'
    ),
    'backyard': Drive(
        'a walk through a garden and a wood, 320×240, unrectified', is_mapped=False
    ),
    'euroc_tiny': Drive('EuRoC V1_01, standing still, 752×480, unrectified', is_mapped=False),
    'tumvi': Drive(
        'TUM-VI, fisheye, 16 bits, nearly still', truth='truth.txt', is_mapped=False
    ),
}  # fmt: skip


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, help=__doc__)


@app.command()
def measure(
    data: Annotated[Path, typer.Argument(help='Folder with the recordings.')],
    work: Annotated[Path, typer.Argument(help='Folder for drives and results.')],
) -> None:
    """Map everything and write docs/figures.json."""
    work.mkdir(parents=True, exist_ok=True)
    drives: dict[str, dict[str, float]] = {}
    for name, drive in DRIVES.items():
        drives[name] = _measured(name, drive, data, work)
        console.print(f'{name}: {drives[name]}', highlight=False)
    found = {
        'version': __version__,
        'python': platform.python_version(),
        'drives': drives,
        'demo': _demo(work),
    }
    FIGURES.write_bytes((json.dumps(found, indent=1) + '\n').encode())


@app.command()
def write() -> None:
    """Put the figures of docs/figures.json between the marks of README and docs/benchmarks.md."""
    for page in PAGES:
        page.write_bytes(written(page.read_text(encoding='utf-8')).encode())


def written(page: str) -> str:
    """Return a page with the tables that its marks ask for."""
    figures = read_json(FIGURES, 'figures')
    tables = {
        'measured': _short_table,
        'drives': _long_table,
        'published': _published_table,
        'paths': _paths_table,
        'slam': _slam_table,
    }
    for mark, table in tables.items():
        start, end = f'<!-- {mark}: python -m tools.figures write -->\n', f'<!-- end of {mark} -->'
        if start in page:
            before, _, rest = page.partition(start)
            page = before + start + '\n' + table(figures) + '\n' + end + rest.partition(end)[2]
    return page


def _measured(name: str, drive: Drive, data: Path, work: Path) -> dict[str, float]:
    recording = work / f'{name}_drive' if drive.scene else data / name
    if drive.scene:
        with announcing() as announce:
            render_once(open_scene(drive.scene), recording, RecordingOptions(floor_every=0),
                        lambda total: announce(f'rendering {name}', total))  # fmt: skip
    out = work / name
    if not (out / 'summary.json').is_file():
        words = ['run', str(recording), '--out', str(out)]
        words += ['--save-masks', 'all'] if drive.is_mapped else ['--no-map']
        run_segfloor(words, work / f'{name}.txt', TIMEOUT_S)
    summary = read_json(out / 'summary.json', 'a summary')
    truth = recording if (recording / 'poses.txt').is_file() else None
    found = measure_run(out, truth, None, start_pose_of(truth))
    names = ['frames', 'moving_frames', 'camera_pitch_rad']
    found |= {name: summary[name] for name in names if summary[name] is not None}
    poses = read_trajectory(out / 'camera_trajectory.txt')[1]
    found['length_m'] = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
    if drive.end is not None:
        found['end_error_m'] = float(np.linalg.norm(poses[-1, :3, 3] - drive.end))
    if drive.truth.endswith('.csv'):
        found['path_error_m'] = planar_error_m(out / 'trajectory.txt', recording / drive.truth)
    elif drive.truth:
        matched = match_files(out / 'camera_trajectory.txt', recording / drive.truth)
        found['path_error_m'] = score_trajectory(matched).ate_rmse_m
    outlines = OUTLINES / f'{name}_floor_outlines.yaml'
    if outlines.is_file() and (out / 'floor_masks').is_dir():
        score = score_floor_folders(out, outlines)
        found |= {
            'floor_precision_percent': 100 * score.precision,
            'floor_recall_percent': 100 * score.recall,
            'false_floor_percent': 100 * score.false_floor_share,
        }
    return {key: round(float(value), 5) for key, value in found.items()}


def planar_error_m(trajectory: Path, truth: Path) -> float:
    """Return the RMSE of the positions after a rigid alignment in the plane, at the lag between the
    clocks that makes it least. truth: CSV of time, x, y from where the drive starts.
    """
    stamps_s, poses = read_trajectory(trajectory)
    seconds, xy = stamps_s - stamps_s[0], poses[:, :2, 3]
    table = np.loadtxt(truth, delimiter=',', skiprows=1)

    def error(lag_s: float) -> float:
        true_xy = np.stack(
            [np.interp(seconds + lag_s, table[:, 0], table[:, i]) for i in (1, 2)], 1
        )
        return _aligned_rmse(xy, true_xy)

    lags = np.linspace(-LONGEST_LAG_S, LONGEST_LAG_S, 81)
    best = lags[int(np.argmin([error(lag) for lag in lags]))]
    return float(minimize_scalar(error, bounds=(best - 0.25, best + 0.25), method='bounded').fun)


def _aligned_rmse(a: Array, b: Array) -> float:
    """Return the RMSE of points (N, 2) after a rotation and a translation (Umeyama, 1991)."""
    a, b = a - a.mean(0), b - b.mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    rotation = u @ np.diag([1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return float(np.sqrt(((a @ rotation - b) ** 2).sum(1).mean()))


def _demo(work: Path) -> dict[str, float]:
    from segfloor_ros.apps.cli.commands import DRIVE

    out = work / 'demo'
    if not (out / 'summary.json').is_file():
        run_segfloor(['demo', '--out', str(out)], work / 'demo.txt', TIMEOUT_S)
    found = measure_run(out, DRIVE, None, start_pose_of(DRIVE))
    return {name: round(float(value), 5) for name, value in found.items()}


def _short_table(figures: dict[str, Any]) -> str:
    rows = [(drive.label, figures['drives'][name]) for name, drive in DRIVES.items() if drive.label]
    rows.append(('the demo through the five nodes', figures['demo']))
    heads = ('recording', 'frames tracked', 'path error', 'free cells, precision / recall, %')
    return _table(heads, [(a, _tracked(f), _path(f), _pair(f, 'free')) for a, f in rows])


def _long_table(figures: dict[str, Any]) -> str:
    heads = ('recording', 'frames, metres, seconds', 'path error, m', 'road map, %',
             'free cells, %', 'floor masks; false floor, %')  # fmt: skip
    rows, bare = [], []
    for name, drive in DRIVES.items():
        found = figures['drives'][name]
        masks = _pair(found, 'floor')
        if 'false_floor_percent' in found:
            masks += f'; {found["false_floor_percent"]:.1f}'
        path = _path(found).removesuffix(' m')
        row = (f'{name}: {drive.about}', _frames(found), path, _pair(found, ''),
               _pair(found, 'free'), masks)  # fmt: skip
        if {*row[2:]} == {'–'}:
            bare.append(f'{row[0]} ({row[1]})')
        else:
            rows.append(row)
    return _table(heads, rows) + f'\nWithout a true path: {"; ".join(bare)}.\n'


def _published_table(figures: dict[str, Any]) -> str:
    """Return the figures of docs/published.json; the others are not needed."""
    return page_table([Row(**row) for row in read_json(PUBLISHED_FIGURES, 'figures')['rows']])


def _paths_table(figures: dict[str, Any]) -> str:
    """Return the paths of docs/published.json; the other figures are not needed."""
    return paths_table([PathRow(**row) for row in read_json(PUBLISHED_FIGURES, 'figures')['paths']])


def _slam_table(figures: dict[str, Any]) -> str:
    """Return the paths alone of docs/published.json; the other figures are not needed."""
    return slam_table([SlamRow(**row) for row in read_json(PUBLISHED_FIGURES, 'figures')['slam']])


def _frames(found: dict[str, float]) -> str:
    """Return what stands in the table of a drive, and what not all drives have."""
    words = [f'{found["frames"]:.0f}', f'{found["length_m"]:.1f}', f'{found["wall_s"]:.0f}']
    if found['tracked_percent'] < 100:
        words.append(f'{_tracked(found)} tracked')
    if found['moving_frames']:
        words.append(f'{found["moving_frames"]:.0f} moving')
    return ', '.join(words)


def _tracked(found: dict[str, float]) -> str:
    return f'{found["tracked_percent"]:.3g} %'


def _path(found: dict[str, float]) -> str:
    if 'path_error_m' in found:
        return f'{found["path_error_m"]:.4f} m' if found['path_error_m'] < 0.02 else (
            f'{found["path_error_m"]:.3f} m'
        )  # fmt: skip
    return f'ends {found["end_error_m"]:.2f} m off' if 'end_error_m' in found else '–'


def _pair(found: dict[str, float], kind: str) -> str:
    names = [f'{kind}_{part}_percent'.lstrip('_') for part in ('precision', 'recall')]
    if any(name not in found for name in names):
        return '–'
    return '/'.join(f'{found[name]:.1f}' for name in names)


def _table(heads: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [heads, ('---',) * len(heads), *rows]
    return ''.join('| ' + ' | '.join(line) + ' |\n' for line in lines)


if __name__ == '__main__':
    run_app(app)
