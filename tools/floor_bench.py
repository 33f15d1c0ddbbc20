"""The floor mask on all drives whose floor is known, in under a minute.

    python -m tools.floor_bench --json before.json
    python -m tools.floor_bench --compare before.json --sheet SHEETS

The first run renders the scenes, runs SLAM over each drive and keeps what floor segmentation gets;
later ones only segment. `--fresh` makes it anew, after a change of SLAM or of what comes before.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Optional

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table

import segfloor_ros
from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import PlainConsole, console
from segfloor_ros.apps.cli.terminal import Set, announcing, figure_table
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import FLOOR
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.whole import read_json
from segfloor_ros.core.floor.mask.likelihood import Likelihood
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.nodes.configuration import resolve
from tools.floor_inputs import (
    OBSTACLE,
    TRUE_FLOOR,
    UNKNOWN,
    BenchDrive,
    FloorDrive,
    Truth,
    bench_drives,
    floor_drive,
)
from tools.low_things import HEIGHTS_CM
from tools.plain_pnp import DATA, arrow
from tools.recorded_frames import CACHE

Mask = NDArray[np.uint8]

BENCH_CACHE = CACHE / 'floor_bench'
PARTS = ('whole', 'near')
COUNTS = ('true_floor', 'false_floor', 'missed_floor', 'obstacle_as_floor', 'obstacle')
"""What is counted in each part of the image, in this order."""

WIDTH, SHEET_FRAMES, PICTURE_PX, TILES = 150, 6, 640, 4
OBSTACLE_WEIGHT = 4.0
"""Of a pixel of an obstacle called floor, against one of floor that is missed: a robot collides."""

RED, BLUE, GREEN, ORANGE = (40, 40, 255), (255, 90, 30), (60, 200, 60), (0, 150, 255)
"""BGR: obstacle called floor, missed floor, floor that is right, other false floor."""


@dataclasses.dataclass(frozen=True)
class FrameRow:
    """One scored frame. counts: pixels by part, as in `COUNTS`. by_height: pixels of low things
    called floor, and all of them, by their height in cm. ms: CPU time of the segmentation.
    """

    index: int
    counts: dict[str, list[int]]
    by_height: dict[str, list[int]]
    ms: float

    @property
    def badness(self) -> float:
        """How bad the mask is, as a share of what is known."""
        true, false, missed, on_obstacle, obstacle = self.counts['whole']
        known = true + missed + obstacle
        return (false + missed + OBSTACLE_WEIGHT * on_obstacle) / known if known else 0.0


@dataclasses.dataclass(frozen=True)
class BenchRow:
    """The scored frames of a drive."""

    name: str
    group: str
    frames: list[FrameRow]

    def share(self, part: str, figure: str) -> float:
        """Return `precision`, `recall` or `obstacles` of a part over all frames, in percent; NaN
        where there is nothing to ask.
        """
        sums = np.sum([frame.counts[part] for frame in self.frames], axis=0)
        true, false, missed, on_obstacle, obstacle = (int(value) for value in sums)
        wholes = {
            'precision': (true, true + false),
            'recall': (true, true + missed),
            'obstacles': (on_obstacle, obstacle),
        }
        hit, whole = wholes[figure]
        return 100 * hit / whole if whole else math.nan

    @property
    def ms(self) -> float:
        """Median time of a frame."""
        return float(np.median([frame.ms for frame in self.frames]))


FIGURES = [(part, figure) for part in PARTS for figure in ('precision', 'recall', 'obstacles')]


def floor_bench(
    only: Annotated[str, typer.Option(help='Names of drives, with commas. [default: all]')] = '',
    json_file: Annotated[
        Optional[Path],  # noqa: UP045  typer evaluates it, also on Python 3.10
        typer.Option('--json', help='File for the figures.'),
    ] = None,
    compare: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help='Figures of an earlier --json: they stand before the arrows.'),
    ] = None,
    sheet: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help='Folder for pictures of the worst frames.'),
    ] = None,
    assignments: Set = None,
    data: Annotated[Path, typer.Option(help='Folder of the recordings.')] = DATA,
    cache: Annotated[Path, typer.Option(help='Folder for what is made once.')] = BENCH_CACHE,
    fresh: Annotated[bool, typer.Option('--fresh', help='Make the inputs anew.')] = False,
) -> None:
    """Score the floor masks of all drives and print a row for each."""
    before = rows_by_name(compare) if compare else {}
    drives = _chosen(bench_drives(data.resolve()), only)
    configuration, rows = resolve(None, assignments or ()), []
    cv2.setNumThreads(1)
    took_s, worst = 0.0, []
    with announcing() as announce:
        for bench in drives:
            inputs = floor_drive(bench, cache.expanduser(), fresh, announce)
            start_s = time.process_time()
            masks, row = segment(bench, inputs, configuration)
            took_s += time.process_time() - start_s
            rows.append(row)
            if sheet:
                worst.append(write_sheet(sheet, inputs, masks, row))
    if sheet:
        cv2.imwrite(str(sheet / 'worst.png'), tiles(worst))
    if json_file:
        found = {'rows': [dataclasses.asdict(row) for row in rows]}
        json_file.write_text(json.dumps(found) + '\n')
    wide = PlainConsole(width=max(console.width, WIDTH))
    wide.print(table_of(rows, before))
    wide.print(height_table(rows, before))
    where = Path(segfloor_ros.__file__).parent
    console.print(f'{took_s:.0f} s CPU for the masks, with {where}', highlight=False)


def _chosen(drives: Sequence[BenchDrive], only: str) -> list[BenchDrive]:
    names = [name.strip() for name in only.split(',') if name.strip()]
    known = [one.name for one in drives]
    for name in names:
        if name not in known:
            raise InputError(f'--only {name}: known are {", ".join(known)}')
    return [one for one in drives if not names or one.name in names]


def segment(
    bench: BenchDrive,
    drive: FloorDrive,
    configuration: Configuration,
    likelihood: Likelihood | None = None,
) -> tuple[dict[int, Mask], BenchRow]:
    """Segment all frames of a drive in their order; returns the masks of the scored ones, by index,
    and their figures.
    """
    stage = FloorSegmentation(drive.camera, configuration.floor_segmentation)
    stage.likelihood = likelihood or stage.likelihood
    masks, rows = {}, []
    start_s = time.thread_time()
    for frame, mask in drive.masks(stage):
        ms = 1e3 * (time.thread_time() - start_s)
        if frame.truth is not None:
            masks[frame.index] = mask
            counts, by_height = count(mask, frame.truth)
            rows.append(FrameRow(frame.index, counts, by_height, round(ms, 2)))
        start_s = time.thread_time()
    return masks, BenchRow(bench.name, bench.group, rows)


def count(mask: Mask, truth: Truth) -> tuple[dict[str, list[int]], dict[str, list[int]]]:
    """Return the numbers of pixels of a mask (H, W), as in `FrameRow`."""
    called, is_floor, stands = mask == FLOOR, truth.label == TRUE_FLOOR, truth.label == OBSTACLE
    known = truth.label != UNKNOWN
    kinds = (
        called & is_floor,
        called & known & ~is_floor,
        is_floor & ~called,
        called & stands,
        stands,
    )
    near = truth.near > 0
    counts = {
        'whole': [int(np.count_nonzero(kind)) for kind in kinds],
        'near': [int(np.count_nonzero(kind & near)) for kind in kinds],
    }
    heights = np.bincount(truth.height_cm.ravel(), minlength=256)
    wrong = np.bincount(truth.height_cm[called], minlength=256)
    low = {str(cm): [int(wrong[cm]), int(heights[cm])] for cm in range(1, 256) if heights[cm]}
    return counts, low


def table_of(rows: Sequence[BenchRow], before: dict[str, BenchRow]) -> Table:
    """Return a line for each drive and the mean of each group; figures of before stand before
    arrows.
    """
    heads = ('precision', 'recall', 'obstacles', 'near p.', 'near r.', 'near o.', 'ms')
    table = figure_table('drive', 'frames', *heads)
    for group in dict.fromkeys(row.group for row in rows):
        some = [row for row in rows if row.group == group]
        for row in some:
            then = before.get(row.name)
            old = _cells([then]) if then else [''] * len(heads)
            table.add_row(row.name, str(len(row.frames)), *map(arrow, old, _cells([row])))
        _add_mean(table, f'mean, {group}', some, before)
    _add_mean(table, 'mean', rows, before)
    table.caption = (
        'in %; obstacles: pixels of what stands that are called floor; near: within 2 m of a '
        'rendered camera, or in the lower half of a recorded image; ms: median CPU time of a frame'
    )
    return table


def _add_mean(
    table: Table, name: str, rows: Sequence[BenchRow], before: dict[str, BenchRow]
) -> None:
    then = [before[row.name] for row in rows if row.name in before]
    now = _cells(rows)
    old = _cells(then) if len(then) == len(rows) else [''] * len(now)
    frames = str(sum(len(row.frames) for row in rows))
    table.add_row(name, frames, *map(arrow, old, now), end_section=True)


def _cells(rows: Sequence[BenchRow]) -> list[str]:
    """Return the means of the figures of drives, as text."""
    cells = []
    for part, figure in FIGURES:
        values = np.array([row.share(part, figure) for row in rows])
        known = values[np.isfinite(values)]
        digits = 2 if figure == 'obstacles' else 1
        cells.append(f'{known.mean():.{digits}f}' if len(known) else '–')
    return [*cells, f'{np.mean([row.ms for row in rows]):.0f}']


def height_table(rows: Sequence[BenchRow], before: dict[str, BenchRow]) -> Table:
    """Return, for each scene of low things, how much of them is called floor, by their height."""
    table = figure_table('low things as floor, %', *(f'{cm} cm' for cm in HEIGHTS_CM))
    low = [row for row in rows if any(frame.by_height for frame in row.frames)]
    for row in low:
        old = _low([before[row.name]]) if row.name in before else [''] * len(HEIGHTS_CM)
        table.add_row(row.name, *map(arrow, old, _low([row])))
    then = [before[row.name] for row in low if row.name in before]
    old = _low(then) if low and len(then) == len(low) else [''] * len(HEIGHTS_CM)
    table.add_section()
    table.add_row('all', *map(arrow, old, _low(low)))
    return table


def _low(rows: Sequence[BenchRow]) -> list[str]:
    cells = []
    for cm in HEIGHTS_CM:
        found = [f.by_height[str(cm)] for row in rows for f in row.frames if str(cm) in f.by_height]
        wrong, whole = np.sum(found, axis=0) if found else (0, 0)
        cells.append(f'{100 * wrong / whole:.1f}' if whole else '–')
    return cells


def rows_by_name(file: Path) -> dict[str, BenchRow]:
    """Return the rows of a file of --json by the name of their drive. Raises InputError."""
    values: Any = read_json(file, 'figures of the bench')
    try:
        rows = [
            BenchRow(row['name'], row['group'], [FrameRow(**frame) for frame in row['frames']])
            for row in values['rows']
        ]
    except (KeyError, TypeError) as error:
        raise InputError(f'{file}: no figures of tools.floor_bench ({error})') from None
    return {row.name: row for row in rows}


def write_sheet(folder: Path, drive: FloorDrive, masks: dict[int, Mask], row: BenchRow) -> Mask:
    """Write the worst frames of a drive as one picture, the worst first; returns that one."""
    frames = {frame.index: frame for frame in drive.frames}
    worst = sorted(row.frames, key=lambda frame: -frame.badness)[:SHEET_FRAMES]
    pictures = []
    for one in worst:
        frame = frames[one.index]
        assert frame.truth is not None
        picture = error_picture(frame.left, masks[one.index], frame.truth)
        alone = BenchRow(row.name, row.group, [one])
        figures = (alone.share('whole', name) for name in ('precision', 'recall', 'obstacles'))
        text = f'{row.name} {one.index}: ' + ' / '.join(f'{value:.1f}' for value in figures)
        picture[:30] //= 3
        cv2.putText(picture, text, (8, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 1)
        pictures.append(picture)
    pictures += [np.zeros_like(pictures[0])] * (len(pictures) % 2)
    folder.mkdir(parents=True, exist_ok=True)
    pairs = (np.hstack(pictures[i : i + 2]) for i in range(0, len(pictures), 2))
    cv2.imwrite(str(folder / f'{row.name}.png'), np.vstack(list(pairs)))
    return pictures[0]


def tiles(pictures: Sequence[Mask]) -> Mask:
    """Return pictures (h, w, 3) of one width, half as large, side by side in rows."""
    small = [
        cv2.resize(one, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for one in pictures
    ]
    height, width = max(one.shape[0] for one in small), small[0].shape[1]
    rows = -(-len(small) // TILES)
    whole = np.zeros((rows * height, TILES * width, 3), np.uint8)
    for i, one in enumerate(small):
        v, u = i // TILES * height, i % TILES * width
        whole[v : v + one.shape[0], u : u + width] = one
    return whole


def error_picture(left: Mask, mask: Mask, truth: Truth) -> Mask:
    """Return an image (H, W) with a mask's errors in colour, (h, w, 3) BGR: red where an obstacle
    is called floor, orange other false floor, blue missed floor, green right floor.
    """
    called, is_floor = mask == FLOOR, truth.label == TRUE_FLOOR
    false = called & (truth.label != UNKNOWN) & ~is_floor
    stands = truth.label == OBSTACLE
    bright = cv2.convertScaleAbs(left, alpha=200 / max(1.0, float(np.percentile(left, 98))))
    picture = np.repeat(bright[..., None], 3, axis=2)
    areas = (
        (called & is_floor, GREEN, 0.25),
        (is_floor & ~called, BLUE, 0.55),
        (false & ~stands, ORANGE, 0.7),
        (false & stands, RED, 0.7),
    )
    for where, colour, opacity in areas:
        blended = (1 - opacity) * picture[where] + opacity * np.array(colour)
        picture[where] = blended.astype(np.uint8)
    size = PICTURE_PX, round(PICTURE_PX * left.shape[0] / left.shape[1])
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


if __name__ == '__main__':
    run_command(floor_bench)
