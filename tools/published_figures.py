"""The published evaluation in figures, by the names of the scenes shipped here that follow it."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.core.errors import SettingsError
from segfloor_ros.core.settings import suggestion

SOURCE = 'Segfloor dissertation (2022, in Portuguese), evaluation chapter'


@dataclass(frozen=True)
class PublishedFigures:
    """A row of the published table. Times and memory are its means over all scenes."""

    method: str
    precision_percent: float
    recall_percent: float
    update_s: float
    update_mb: float


@dataclass(frozen=True)
class PublishedScene:
    """A scene of the published evaluation. nodes: of a road map, 0 for one per 1.5 m² where nobody
    said. area_m2: of the original. cell_m: of the true map and, unless it is set, of ours; the
    published maps have cells of 1 and 5 cm.
    """

    nodes: int
    area_m2: float | None
    figures: tuple[PublishedFigures, ...]
    cell_m: float = 0.01


def _segfloor(precision_percent: float, recall_percent: float) -> PublishedFigures:
    return PublishedFigures('Segfloor', precision_percent, recall_percent, 0.19, 0.073)


def _rtabmap(kind: str, precision_percent: float, recall_percent: float) -> PublishedFigures:
    return PublishedFigures(f'RTAB-Map, {kind}', precision_percent, recall_percent, 0.47, 5.2)


PUBLISHED: dict[str, PublishedScene] = {
    'corridor1': PublishedScene(
        20,
        10.0,
        (
            _segfloor(99.48, 97.70),
            _rtabmap('ray tracing', 96.63, 94.94),
            _rtabmap('no ray tracing', 99.66, 59.06),
        ),
    ),
    'corridor2': PublishedScene(
        20,
        7.9,
        (
            _segfloor(99.64, 97.23),
            _rtabmap('ray tracing', 99.22, 96.21),
            _rtabmap('no ray tracing', 99.31, 71.73),
        ),
    ),
    'complex_room': PublishedScene(0, None, ()),
    'large_loop': PublishedScene(
        100, 682.7, (_segfloor(99.41, 98.52), _rtabmap('ray tracing', 98.44, 31.67)), 0.05
    ),
}
"""By name of the shipped scene that follows the original. Of the complex room no figures were
published.
"""


def parse_scenes(text: str) -> list[str]:
    """Return the names in `corridor1,corridor2`. Raises SettingsError for an unknown one."""
    names = [part.strip() for part in text.split(',')]
    for name in names:
        if name not in PUBLISHED:
            raise SettingsError(
                f'--scenes: no published scene {name}{suggestion(name, [*PUBLISHED])}'
            )
    return names
