"""SLAM beside a plain method over the same frames: `python -m tools.plain_pnp [RECORDING...]`.

What ORB and PnP place from one frame to the next, SLAM should place, too. Each row is a recording
and a variant of it: a lower rate, quantised disparities, noise, small images.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Optional

import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table

import segfloor_ros
from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import PlainConsole, console
from segfloor_ros.apps.cli.terminal import Announce, announcing, figure_table
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.whole import read_json
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.nodes.configuration import resolve
from tools.plain_tracker import PlainSteps, plain_steps
from tools.recorded_frames import CACHE, VARIANTS, Recorded, distance_m, motions, true_poses, vary
from tools.tracked_frames import TrackedFrames, track_frames

DATA = Path(__file__).resolve().parents[2] / 'shared' / 'data'
WIDTH = 160
"""Columns that the table needs."""

RECORDINGS = (
    'freiburg3_cabinet', 'kitchen', 'kitti06', 'library', 'rover', 'backyard', 'corridor',
    'euroc_tiny', 'tumvi',
)  # fmt: skip

GOOD_M, GOOD_SHARE = 0.05, 0.05
"""A step of the plain method is good within the one plus the other of its length."""

WORSE = 3.0
"""A step of SLAM is wrong when it errs by this many times the error of a good plain step, and by
more than `GOOD_M`."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One recording in one variant. placed: steps that the plain method places, of frames - 1;
    good: those that the truth confirms, None without one. inliers, needed: of a step, medians.
    tracked: frames of SLAM in the map at the end; apart: in submaps that were left out; lost and
    weak: what it says itself. missed: frames of placed steps of which SLAM lacks a pose at either
    end; wrong: where it has both, and errs. Errors: of the steps, in m, where the truth is known.
    seconds: CPU time of SLAM.
    """

    recording: str
    variant: str
    frames: int
    placed: int
    needed: float
    inliers: float
    tracked: int
    lost: int
    apart: int
    weak: int
    missed: list[int]
    wrong: list[int]
    plain_median_m: float | None
    plain_max_m: float | None
    slam_median_m: float | None
    slam_max_m: float | None
    keyframes: int
    seconds: float
    good: int | None

    @property
    def name(self) -> str:
        """Recording and variant."""
        return f'{self.recording}, {self.variant}'


def plain_pnp(
    recordings: Annotated[
        Optional[list[str]],  # noqa: UP045  typer evaluates it, also on Python 3.10
        typer.Argument(help='Folders, or names in --data. [default: all in --data]'),
    ] = None,
    only: Annotated[
        str, typer.Option('--recordings', help='Names of recordings, with commas.')
    ] = '',
    variants: Annotated[
        str, typer.Option(help='With commas, some of: ' + ', '.join(VARIANTS) + '.')
    ] = 'rate 1',
    every_variant: Annotated[bool, typer.Option('--all', help='All variants.')] = False,
    every: Annotated[int, typer.Option(min=1, help='Take every n-th frame only.')] = 1,
    limit: Annotated[int, typer.Option(min=0, help='At most so many frames; 0: all.')] = 0,
    no_map: Annotated[
        bool, typer.Option('--no-map', help='SLAM without a mount, as segfloor run --no-map.')
    ] = False,
    assignments: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            '--set', help='One parameter, e.g. stereo_slam.num_features=2000; repeatable.'
        ),
    ] = None,
    data: Annotated[Path, typer.Option(help='Folder of the recordings.')] = DATA,
    cache: Annotated[Path, typer.Option(help='Folder for frames and plain results.')] = CACHE,
    fresh: Annotated[
        bool, typer.Option('--fresh', help='Make the files of the cache anew.')
    ] = False,
    json_file: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option('--json', help='File for the figures.'),
    ] = None,
    compare: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help='Figures of an earlier --json: they stand before the arrows.'),
    ] = None,
) -> None:
    """Print a row for each recording and variant."""
    names = [*(recordings or ()), *filter(None, only.split(','))] or RECORDINGS
    chosen = list(VARIANTS) if every_variant else [name.strip() for name in variants.split(',')]
    for unknown in set(chosen) - VARIANTS.keys():
        raise InputError(f'--variants {unknown}: known are {", ".join(VARIANTS)}')
    before = rows_by_name(compare) if compare else {}
    configuration, rows, start_s = resolve(None, assignments or ()), [], time.perf_counter()
    with announcing() as announce:
        for name in names:
            path = Path(name) if Path(name).is_dir() else data / name
            recorded = Recorded(path, cache, every, limit, fresh=fresh)
            for variant in chosen:
                row = measure(recorded, variant, configuration, not no_map, announce)
                if row is None:
                    continue
                rows.append(row)
                console.print(_line(row), highlight=False)
                if json_file:
                    write_rows(json_file, rows)
    PlainConsole(width=max(console.width, WIDTH)).print(table_of(rows, before))
    took_s = time.perf_counter() - start_s
    console.print(f'{took_s:.0f} s, with {Path(segfloor_ros.__file__).parent}', highlight=False)


def measure(
    recorded: Recorded,
    variant: str,
    configuration: Configuration,
    with_mount: bool,
    announce: Announce,
) -> Row | None:
    """Return the row of a variant of a recording; None where there is no such variant of it."""
    drive = vary(recorded, VARIANTS[variant])
    if drive is None:
        return None
    stamps = [frame.stamp_ns for frame in drive.frames]
    file = recorded.folder / f'plain-{recorded.part}-{variant}.npz'.replace(' ', '_').replace(
        '/', '_'
    )
    if file.is_file():
        plain = PlainSteps.read(file)
    else:
        announce(f'plain method: {recorded.name}, {variant}', 0)
        plain = plain_steps(drive.views(), drive.camera)
        plain.save(file)
    report = announce(f'{recorded.name}, {variant}', len(stamps))
    slam = track_frames(
        drive.camera, drive.frames, recorded.source.sensors, configuration, with_mount, report
    )
    true = true_poses(recorded, stamps)
    return compare_steps(recorded.name, variant, plain, slam, true)


def compare_steps(
    recording: str, variant: str, plain: PlainSteps, slam: TrackedFrames, true: Array | None
) -> Row:
    """Return what both place of N frames. true: (N, 4, 4) of the camera, None without a truth."""
    placed, has_pose = plain.placed, slam.is_tracked
    has_step = has_pose & np.roll(has_pose, 1)
    has_step[0] = False
    errors = [np.full(len(placed), np.nan)] * 2
    steps_m = errors[0]
    if true is not None:
        true_steps = motions(true)
        steps_m = distance_m(true_steps)
        found = invert(plain.T_now_before), motions(slam.T_map_left)
        errors = [distance_m(invert(true_steps) @ step) for step in found]
    plain_m, slam_m = errors
    wrong = placed & has_step & is_wrong(plain_m, slam_m, steps_m)
    return Row(
        recording,
        variant,
        len(placed),
        int(placed.sum()),
        float(np.median(plain.needed[1:])),
        float(np.median(plain.inliers[1:])),
        int(has_pose.sum()),
        slam.lost,
        len(placed) - slam.lost - int(has_pose.sum()),
        slam.weak,
        np.flatnonzero(placed & ~has_step).tolist(),
        np.flatnonzero(wrong).tolist(),
        *_median_and_max(plain_m[placed]),
        *_median_and_max(slam_m[has_step]),
        slam.keyframes,
        round(slam.seconds, 2),
        None if true is None else int((placed & is_good(plain_m, steps_m)).sum()),
    )


def is_good(plain_m: Array, steps_m: Array) -> NDArray[np.bool_]:
    """Return where (N,) the plain method errs little, see `is_wrong`."""
    return np.asarray(plain_m < GOOD_M + GOOD_SHARE * steps_m)


def is_wrong(plain_m: Array, slam_m: Array, steps_m: Array) -> NDArray[np.bool_]:
    """Return where (N,) SLAM errs and the plain method does not, by the errors of their steps and
    the true lengths of those, all (N,) in metres, NaN where they are not known.
    """
    return np.asarray(is_good(plain_m, steps_m) & (slam_m > WORSE * plain_m) & (slam_m > GOOD_M))


def rows_by_name(file: Path) -> dict[str, Row]:
    """Return the rows of a file of --json."""
    rows = [Row(**fields) for fields in read_json(file, 'figures of tools.plain_pnp')['rows']]
    return {row.name: row for row in rows}


def write_rows(file: Path, rows: Sequence[Row]) -> None:
    """Write rows to a file of --json."""
    file.write_text(json.dumps({'rows': [dataclasses.asdict(row) for row in rows]}, indent=1))


def table_of(rows: Sequence[Row], before: dict[str, Row]) -> Table:
    """Return a line for each row and the sums; figures of before stand before arrows."""
    heads = (
        'plain', 'good', 'inliers', 'SLAM', 'lost', 'apart', 'weak', 'missed', 'wrong', 'plain mm',
        'SLAM mm', 's',
    )  # fmt: skip
    table = figure_table('recording, variant', *heads)
    for row in rows:
        table.add_row(row.name, *_changed(_figures(row), before.get(row.name)))
    common = [before[row.name] for row in rows if row.name in before]
    then = _sums(common) if len(common) == len(rows) else [''] * len(heads)
    table.add_row(f'all {len(rows)}', *map(arrow, then, _sums(rows)), end_section=True)
    table.caption = (
        'plain: steps placed, of all; good: of those, by the truth; inliers: there and needed, '
        'medians; SLAM: frames in the map, of all; apart: frames in submaps that were left out; '
        'missed: frames of steps that are placed where SLAM has no pose before or after; wrong: '
        'where it errs; mm: errors of a step, median and largest; s: CPU time of SLAM'
    )
    return table


def _figures(row: Row) -> list[str]:
    return [
        f'{row.placed}/{row.frames - 1}',
        '–' if row.good is None else str(row.good),
        f'{row.inliers:.0f} {row.needed:.0f}',
        f'{row.tracked}/{row.frames}',
        str(row.lost),
        str(row.apart),
        str(row.weak),
        str(len(row.missed)),
        str(len(row.wrong)),
        _mm(row.plain_median_m, row.plain_max_m),
        _mm(row.slam_median_m, row.slam_max_m),
        f'{row.seconds:.1f}',
    ]


def _sums(rows: Sequence[Row]) -> list[str]:
    frames = sum(row.frames for row in rows)
    return [
        f'{sum(row.placed for row in rows)}/{frames - len(rows)}',
        '',
        '',
        f'{sum(row.tracked for row in rows)}/{frames}',
        *(str(sum(getattr(row, name) for row in rows)) for name in ('lost', 'apart', 'weak')),
        *(str(sum(len(getattr(row, name)) for row in rows)) for name in ('missed', 'wrong')),
        '',
        '',
        f'{sum(row.seconds for row in rows):.1f}',
    ]


def _changed(figures: list[str], before: Row | None) -> list[str]:
    then = _figures(before) if before else [''] * len(figures)
    return list(map(arrow, then, figures))


def arrow(then: str, now: str) -> str:
    """Return a figure, and before it what it was, where that is another one."""
    return now if then in ('', now) else f'{then} → {now}'


def _line(row: Row) -> str:
    missed, wrong = (f' {name} {frames}' if frames else '' for name, frames in
                     (('missed', row.missed), ('wrong', row.wrong)))  # fmt: skip
    return f'{row.name}: plain {row.placed}, SLAM {row.tracked} of {row.frames};{missed}{wrong}'


def _median_and_max(errors_m: Array) -> tuple[float | None, float | None]:
    known = errors_m[np.isfinite(errors_m)]
    if not len(known):
        return None, None
    return round(float(np.median(known)), 5), round(float(known.max()), 5)


def _mm(*values_m: Any) -> str:
    return ' '.join('–' if value is None else f'{1000 * value:.0f}' for value in values_m)


if __name__ == '__main__':
    run_command(plain_pnp)
