"""Arguments and options that several commands share."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from segfloor_ros.configuration import Configuration, resolve
from segfloor_ros.errors import SettingsError


def within(
    low: float, high: float = math.inf
) -> Callable[[typer.CallbackParam, float | None], float | None]:
    """Return what checks a finite number of an option, in one line; `nan` would pass the bounds of
    typer. It raises SettingsError.
    """

    def check(parameter: typer.CallbackParam, value: float | None) -> float | None:
        if value is not None and not (low <= value <= high and math.isfinite(value)):
            words = f'at least {low:g}' if high == math.inf else f'{low:g} to {high:g}'
            raise SettingsError(f'{parameter.opts[0]} {value}: expected {words}')
        return value

    return check


Input = Annotated[
    str, typer.Argument(help='Recording: folder (KITTI, EuRoC, images), bag, video or device.')
]
Out = Annotated[Path, typer.Option('--out', help='Folder for the results.')]
Params = Annotated[
    Path | None,
    typer.Option('--params', help='ROS parameter file (YAML) for all stages.'),
]
Set = Annotated[
    list[str] | None,
    typer.Option('--set', help='One parameter, e.g. occupancy_grid.resolution_m=0.02; repeatable.'),
]
Masks = Annotated[
    Path | None,
    typer.Option(
        '--masks',
        help='Folder of masks of what moves: %06d.png by frame index, of the left image as '
        'recorded, 255 = moving.',
    ),
]
Ignore = Annotated[
    str | None,
    typer.Option('--ignore', help='Sensors to leave out, with commas: wheel_odometry, imu.'),
]
Depth = Annotated[
    bool, typer.Option('--depth', help='Take depth images in place of the right ones.')
]
SaveMap = Annotated[
    Path | None,
    typer.Option('--save-map', help='File to save the whole map to, to go on with later.'),
]
LoadMap = Annotated[
    Path | None,
    typer.Option('--load-map', help='Saved map to go on mapping in.'),
]
Localize = Annotated[
    bool,
    typer.Option('--localize', help='Poses in the map of --load-map only; nothing is added to it.'),
]
Report = Annotated[
    bool,
    typer.Option('--report', help='Write report.html: everything about the run on one page.'),
]


NoMap = Annotated[
    bool, typer.Option('--no-map', help='The path alone: no floor is looked for, no map made.')
]


def configuration(
    params: Path | None,
    assignments: list[str] | None,
    input: str,
    masks: Path | None = None,
    ignore: str | None = None,
    depth: bool = False,
) -> Configuration:
    """Return the configuration that the options of a command stand for."""
    given = {'masks': masks and str(masks), 'ignore': ignore, 'depth': depth or None}
    camera = {name: value for name, value in given.items() if value is not None}
    return resolve(params, assignments or (), stereo_camera={'input': input, **camera})
