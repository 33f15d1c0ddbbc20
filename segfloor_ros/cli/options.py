"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Optional

import typer

InputArgument = Annotated[
    str, typer.Argument(help='Recording: folder (KITTI, EuRoC, images), bag, video or device.')
]
OutOption = Annotated[Path, typer.Option('--out', help='Folder for the results.')]
ParamsOption = Annotated[
    Optional[Path],  # noqa: UP045  typer evaluates it, also on Python 3.10
    typer.Option('--params', help='ROS parameter file (YAML) for all stages.'),
]
SetOption = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option('--set', help='One parameter, e.g. occupancy_grid.resolution_m=0.02; repeatable.'),
]
MasksOption = Annotated[
    Optional[Path],  # noqa: UP045
    typer.Option(
        '--masks',
        help='Folder of masks of what moves: %06d.png by frame index, of the left image as '
        'recorded, 255 = moving.',
    ),
]
IgnoreOption = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option('--ignore', help='Sensors to leave out, with commas: wheel_odometry, imu.'),
]
DepthOption = Annotated[
    bool, typer.Option('--depth', help='Take depth images in place of the right ones.')
]
SaveMapOption = Annotated[
    Optional[Path],  # noqa: UP045
    typer.Option('--save-map', help='File to save the whole map to, to go on with later.'),
]
LoadMapOption = Annotated[
    Optional[Path],  # noqa: UP045
    typer.Option('--load-map', help='Saved map to go on mapping in.'),
]
LocalizeOption = Annotated[
    bool,
    typer.Option('--localize', help='Poses in the map of --load-map only; nothing is added to it.'),
]
ReportOption = Annotated[
    bool,
    typer.Option('--report', help='Write report.html: everything about the run on one page.'),
]


def recording_settings(
    input: str, masks: Path | None = None, ignore: str | None = None, depth: bool = False
) -> dict[str, Any]:
    """Return the settings of `stereo_camera` that options of a command stand for."""
    given = {'masks': masks and str(masks), 'ignore': ignore, 'depth': depth or None}
    return {'input': input} | {name: value for name, value in given.items() if value is not None}
