"""The published evaluation in figures, by the names of the scenes shipped here that follow it, each
with its section and page (counted from the pages that bear a number).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from segfloor_ros.core.errors import SettingsError
from segfloor_ros.core.settings import suggestion

SOURCE = 'Segfloor dissertation (2022, in Portuguese), chapter 7'
SEGFLOOR, RAYS, NO_RAYS = 'Segfloor', 'RTAB-Map, ray tracing', 'RTAB-Map, no ray tracing'
TABLES = '§7.4, p. 108, 109'


@dataclass(frozen=True)
class Row:
    """A system on a scene, published or measured here; None where nothing was said or measured.

    source: section and page, '' for what is measured here. cell_m: of the map. Recall: over the
    floor that the drive could see, and over all true floor, as published. update: of the map, mean
    (of RTAB-Map here: median) and longest time, and growth of memory. peak_mb: resident memory.
    """

    scene: str
    system: str
    source: str = ''
    cell_m: float | None = None
    keyframes: int | None = None
    precision_percent: float | None = None
    recall_seen_percent: float | None = None
    recall_all_percent: float | None = None
    update_s: float | None = None
    update_max_s: float | None = None
    update_mb: float | None = None
    path_error_m: float | None = None
    cpu_s: float | None = None
    peak_mb: float | None = None


@dataclass(frozen=True)
class PublishedScene:
    """A scene of the published evaluation. nodes: of a road map, 0 for one per 1.5 m² where nobody
    said. area_m2: of the original. cell_m: of the true map and, unless it is set, of ours. range_m:
    longest ray, 0 where nobody said. waypoints, speed_m_s: of the drive here, which comes near all
    floor, as points show only what is near, with about as many keyframes; empty and 0: the scene's
    own.
    """

    nodes: int
    area_m2: float | None
    rows: tuple[Row, ...]
    cell_m: float = 0.01
    range_m: float = 0.0
    waypoints: tuple[tuple[float, float], ...] = ()
    speed_m_s: float = 0.0


RATE_HZ = 15.0
"""Of all published recordings (§6.2.1, p. 90; §6.2.2, p. 93)."""

PUBLISHED: dict[str, PublishedScene] = {
    'corridor1': PublishedScene(
        20,
        10.0,
        (
            Row('corridor1', SEGFLOOR, f'{TABLES}; §7.2, p. 101', 0.01, 354, 99.48, None, 97.70,
                update_max_s=0.39),
            Row('corridor1', RAYS, f'{TABLES}; §7.2, p. 102', 0.05, None, 96.63, None, 94.94,
                update_max_s=1.23),
            Row('corridor1', NO_RAYS, TABLES, 0.05, None, 99.66, None, 59.06),
        ),
        range_m=2.0,
        waypoints=(
            (-0.3, -0.3), (0.4, -0.35), (1.1, 0.0), (1.8, 0.25), (2.4, -0.2), (3.0, -0.5),
            (4.0, -0.2), (4.6, 0.15), (5.0, 0.05), (5.1, -0.3), (4.95, -0.5), (4.75, -0.1),
            (4.3, 0.45), (3.75, 0.2), (3.5, 0.9), (3.55, 1.3), (3.95, 1.6), (3.7, 2.1), (3.3, 2.2),
            (2.7, 2.0), (2.6, 1.5), (3.2, 1.4), (3.5, 0.9), (3.65, 0.2), (3.1, -0.4), (2.4, 0.1),
            (1.6, 0.45), (0.6, 0.45), (-0.1, 0.25), (-0.3, -0.1), (-0.25, -0.4),
        ),
        speed_m_s=0.3,
    ),
    'corridor2': PublishedScene(
        20,
        7.9,
        (
            Row('corridor2', SEGFLOOR, f'{TABLES}; §7.2, p. 101', 0.01, 220, 99.64, None, 97.23,
                update_max_s=0.38),
            Row('corridor2', RAYS, f'{TABLES}; §7.2, p. 102', 0.05, None, 99.22, None, 96.21,
                update_max_s=2.70),
            Row('corridor2', NO_RAYS, TABLES, 0.05, None, 99.31, None, 71.73),
        ),
        range_m=2.0,
        waypoints=(
            (-0.3, -0.4), (1.8, -0.45), (3.2, -0.5), (3.7, -0.4), (4.0, 0.2), (3.8, 0.55),
            (3.2, 0.5), (3.0, 0.1), (2.5, -0.3), (2.0, 0.35), (1.2, 0.4), (0.5, 0.3), (-0.2, 0.4),
            (-0.4, 0.1), (-0.35, -0.4),
        ),
        speed_m_s=0.3,
    ),
    'complex_room': PublishedScene(
        0,
        None,
        (
            Row('complex_room', SEGFLOOR, '§7.1.1, p. 98', 0.01, update_max_s=0.37),
            Row('complex_room', SEGFLOOR, '§7.1.1, p. 98', 0.05, update_max_s=0.39),
            Row('complex_room', RAYS, '§7.1.1, p. 99', 0.01, update_max_s=3.37),
            Row('complex_room', NO_RAYS, '§7.1.1, p. 99', 0.01, update_max_s=2.56),
            Row('complex_room', RAYS, '§7.1.1, p. 99', 0.05, update_max_s=1.81),
            Row('complex_room', NO_RAYS, '§7.1.1, p. 99', 0.05, update_max_s=2.10),
        ),
    ),
    'large_loop': PublishedScene(
        100,
        682.7,
        (
            Row('large_loop', SEGFLOOR, f'{TABLES}; §7.3.1, p. 104', None, 1007, 99.41, None, 98.52,
                0.19, update_mb=0.073),
            Row('large_loop', RAYS, f'{TABLES}; §7.3.1, p. 104', None, None, 98.44, None, 31.67,
                0.47, 0.96, 5.2),
        ),
        0.05,
        range_m=5.0,
    ),
}  # fmt: skip
"""By name of the shipped scene that follows the original. Of the complex room only times were
published, and of RTAB-Map's longest update in the corridors not with which rays. Times and memory
per update are of the synthetic scene alone; its longest Segfloor update cannot be read in the scan.
RTAB-Map's memory is said to grow 71.62 times as fast.
"""


def parse_scenes(text: str, known: Sequence[str]) -> list[str]:
    """Return the names in `corridor1,corridor2`; an empty text has none. Raises SettingsError for
    one that is not known.
    """
    names = [part.strip() for part in text.split(',') if part.strip()]
    for name in names:
        if name not in known:
            raise SettingsError(f'--scenes: no published scene {name}{suggestion(name, [*known])}')
    return names


HEADS = (
    'scene: system', 'cell, cm; keyframes', 'precision; recall, %', 'update, s; growth, MB',
    'path error, mm; CPU, s; memory, MB', 'source',
)  # fmt: skip


def cells_of(row: Row) -> tuple[str, ...]:
    """Return a row in words, one cell for each of `HEADS` but the first. Pairs are of the recall in
    view and over all floor, and of the mean and longest update.
    """
    return (
        _joined(_text(row.cell_m and 100 * row.cell_m, '{:g}'), _text(row.keyframes, '{:d}')),
        _joined(
            _text(row.precision_percent, '{:.1f}'),
            _pair(row.recall_seen_percent, row.recall_all_percent, '{:.1f}'),
        ),
        _joined(_pair(row.update_s, row.update_max_s, '{:.2f}'), _text(row.update_mb, '{:.2g}')),
        _joined(
            _text(row.path_error_m and 1000 * row.path_error_m, '{:.1f}'),
            _text(row.cpu_s, '{:.0f}'),
            _text(row.peak_mb, '{:.0f}'),
        ),
        row.source or 'here',
    )


def _joined(*parts: str) -> str:
    return '; '.join(part for part in parts if part)


def _text(value: float | None, form: str) -> str:
    return '' if value is None else form.format(value)


def _pair(first: float | None, second: float | None, form: str) -> str:
    if first is None and second is None:
        return ''
    return '/'.join(_text(value, form) or '–' for value in (first, second))


def page_table(rows: Sequence[Row]) -> str:
    """Return rows that are scored as a table of Markdown: scene by scene, what is measured here
    before what is published. The page names the source of precision and recall once (`TABLES`).
    """
    lines = [HEADS, ('---',) * len(HEADS)]
    for scene in PUBLISHED:
        own = [row for row in rows if row.scene == scene]
        own.sort(key=lambda row: (row.system.startswith('RTAB'), row.system))
        lines += [
            (
                f'{scene}: {row.system}',
                *cells_of(row)[:-1],
                row.source.replace(TABLES, '').strip('; '),
            )
            for row in (*own, *PUBLISHED[scene].rows)
            if row.precision_percent is not None
        ]
    return ''.join('| ' + ' | '.join(line) + ' |\n' for line in lines)
