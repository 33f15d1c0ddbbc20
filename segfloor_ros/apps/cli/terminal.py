"""What several commands share: options, progress, tables and errors."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as ProgressBar
from rich.table import Table

import segfloor_ros
from segfloor_ros.apps.cli.printing import console, error_console, print_error
from segfloor_ros.apps.lockstep import MapOptions, SaveMasks
from segfloor_ros.apps.recordings import StereoSource, open_source
from segfloor_ros.apps.results_folder import (
    MAP,
    STAGE_COLUMNS,
    OutputFolder,
    RunSummary,
    stage_rows,
    summary_rows,
)
from segfloor_ros.core.camera.recording import RecordedSensor
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.errors import SettingsError
from segfloor_ros.core.processes import Interrupt
from segfloor_ros.core.settings import suggestion
from segfloor_ros.nodes.configuration import resolve

Progress = Callable[..., None]
"""Told how many steps are done and, as `note`, the state in words."""

Announce = Callable[[str, int], Progress]
"""Told the name of a task and its number of steps; returns whom to tell how many are done."""


@contextmanager
def announcing() -> Iterator[Announce]:
    """Show a progress bar whose task is replaced by the next announced one."""
    columns = (
        TextColumn('{task.description}', markup=False),
        BarColumn(),
        TaskProgressColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn('{task.fields[note]}', markup=False),
    )
    with ProgressBar(*columns, console=error_console, transient=not sys.stderr.isatty()) as bar:
        task = bar.add_task('starting', total=None, note='')

        def announce(description: str, total: int) -> Progress:
            bar.reset(task, description=description, total=total or None, note='')
            return lambda done, note='': bar.update(task, completed=done, note=note)

        yield announce


@contextmanager
def progress_bar(description: str, total: int | None) -> Iterator[Progress]:
    """Show a progress bar with one task."""
    with announcing() as announce:
        yield announce(description, total or 0)


def figure_table(names: str, *numbers: str) -> Table:
    """Return an empty table whose first column holds names and whose others hold numbers."""
    table = Table(names, *numbers, padding=0)
    for column in table.columns:
        column.no_wrap = True
    for column in table.columns[1:]:
        column.justify = 'right'
    return table


def value_table(name: str, rows: Iterable[tuple[str, str]], title: str | None = None) -> Table:
    """Return a table of names and their values with units."""
    table = Table(name, 'value', title=title, title_justify='left')
    for row in rows:
        table.add_row(*row)
    return table


def print_sensors(sensors: Sequence[RecordedSensor]) -> None:
    """Print what a recording holds besides stereo images, where there is such."""
    if not sensors:
        return
    table = Table('sensor', 'found in', 'messages', 'used')
    for sensor in sensors:
        used = 'yes' if sensor.used else 'no'
        table.add_row(sensor.name, sensor.where, str(sensor.messages), used)
    console.print(table)


def print_summary(title: str, summary: RunSummary) -> None:
    """Print the figures of a run and the time of each stage as tables with units."""
    console.print(value_table('result', summary_rows(summary), title))
    stages = figure_table(*STAGE_COLUMNS)
    for row in stage_rows(summary.stages):
        stages.add_row(*row)
    console.print(stages)


def print_json(document: Mapping[str, Any]) -> None:
    """Print figures as JSON."""
    typer.echo(json.dumps(document, indent=2))


@contextmanager
def json_alone(as_json: bool) -> Iterator[None]:
    """Print no tables and lines on standard output in the block, if figures come as JSON."""
    was_quiet, console.quiet = console.quiet, as_json or console.quiet
    try:
        yield
    finally:
        console.quiet = was_quiet


def end_if_interrupted(interrupt: Interrupt) -> None:
    """End the command where a signal came before there was a map."""
    if interrupt.status:
        print_error('interrupted before there was a map; nothing is written')
        raise typer.Exit(interrupt.status)


def finish_run(
    input_name: str,
    out: Path,
    folder: OutputFolder,
    report: bool,
    remarks: Iterable[str],
    status: int = 0,
    figures: RunSummary | None = None,
) -> None:
    """Write the report if asked for, with the truth where the recording has one, and print where
    the results are and remarks. status: to end with; 1 where it is 0 and something could not be
    written. figures: to print as JSON.
    """
    has_map = (folder.path / MAP).is_file()
    place = f'map: {folder.path / MAP}' if has_map else f'path: {folder.path / "trajectory.txt"}'
    console.print(place, soft_wrap=True)
    problems, page = list(folder.problems), None
    if report:
        # Imported here: Matplotlib takes a second that other commands should not wait for.
        from segfloor_ros.apps.evaluation.report import write_report

        recording = Path(input_name)
        truth = recording if (recording / 'map.yaml').is_file() else None
        try:
            page = str(write_report(folder.path, truth))
            console.print(f'report: {page}', soft_wrap=True)
        except Exception as error:  # whatever it is, the results are there
            problems.append(f'there is no report: {str(error) or type(error).__name__}')
    for line in (*problems, *remarks):
        print_error(line)
    if figures is not None:
        places = {'out': str(folder.path), 'report': page}
        print_json(dataclasses.asdict(figures) | places)
    if status and not problems:
        kept = f'; the whole result in {out} stays' if folder.path != out else ''
        print_error(f'cut short: what is mapped is in {folder.path}{kept}')
    if status or problems:
        raise typer.Exit(status or 1)


def number_option(help: str, low: float, high: float = math.inf, name: str = '') -> Any:
    """Return an option that takes a finite number within bounds, and says in one line of another
    one what it expects; `nan` would pass the bounds of typer.
    """

    def check(parameter: typer.CallbackParam, value: float | None) -> float | None:
        if value is not None and not (low <= value <= high and math.isfinite(value)):
            words = f'at least {low:g}' if high == math.inf else f'{low:g} to {high:g}'
            raise SettingsError(f'{parameter.opts[0]} {value}: expected {words}')
        return value

    return typer.Option(*filter(None, [name]), callback=check, help=help)


@contextmanager
def needing_ros(what: str) -> Iterator[None]:
    """Say in one line what cannot be imported without ROS 2. Raises SettingsError."""
    try:
        yield
    except ImportError as error:
        raise SettingsError(
            f'{what} needs ROS 2 ({error}); source a ROS 2 installation or install the extra: '
            "pip install 'segfloor_ros[ros]'"
        ) from None


Scene = Annotated[
    str,
    typer.Argument(
        help='Name of a shipped scene, a scene file, or a map_server map (YAML) to drive in.'
    ),
]
SceneValues = Annotated[
    list[str] | None,
    typer.Option('--set', help='One value of the scene, e.g. camera.height_m=0.4; repeatable.'),
]
Input = Annotated[
    str, typer.Argument(help='Recording: folder (KITTI, EuRoC, images), bag, video or device.')
]
Out = Annotated[Path, typer.Option('--out', help='Folder for the results.')]
Params = Annotated[
    Path | None,
    typer.Option(
        '--params',
        callback=lambda path: path and params_file(path),
        metavar='FILE|NAME',
        help='ROS parameter file (YAML) for all stages, or the name of a shipped one: '
        'see segfloor params.',
    ),
]
Set = Annotated[
    list[str] | None,
    typer.Option('--set', help='One parameter, e.g. occupancy_grid.resolution_m=0.02; repeatable.'),
]
Ignore = Annotated[
    str | None,
    typer.Option('--ignore', help='Sensors to leave out, with commas: wheel_odometry, imu.'),
]
Depth = Annotated[
    bool, typer.Option('--depth', help='Take depth images in place of the right ones.')
]
View = Annotated[
    str | None,
    typer.Option(
        '--view',
        metavar='[FILE.rrd]',
        help='Show what happens in a window of rerun, or write it to a file for that.',
    ),
]
Json = Annotated[bool, typer.Option('--json', help='Print figures as JSON, and no tables.')]


@dataclasses.dataclass(frozen=True)
class InputOptions:
    """A recording, or a part of it, with the parameters it is read with."""

    input: Input
    start: Annotated[int | None, typer.Option('--start', help='First frame that is read.')] = None
    frames: Annotated[int | None, typer.Option('--frames', help='How many frames are read.')] = None
    every: Annotated[int | None, typer.Option('--every', help='Read every n-th frame only.')] = None
    params: Params = None
    assignments: Set = None

    def configuration(self, **camera: Any) -> Configuration:
        """Return the configuration that the options stand for. camera: further settings of
        `stereo_camera`.
        """
        part = {'start': self.start, 'frames': self.frames, 'every': self.every}
        return configuration(self.params, self.assignments, self.input, **part, **camera)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DriveOptions(InputOptions):
    """What `run` and `replay` have in common."""

    out: Out
    ignore: Ignore = None
    depth: Depth = False
    masks: Annotated[
        Path | None,
        typer.Option(
            '--masks',
            help='Folder of masks of what moves: %06d.png by frame index, of the left image as '
            'recorded, 255 = moving.',
        ),
    ] = None
    network: Annotated[
        Path | None,
        typer.Option(
            '--network',
            metavar='FILE.onnx',
            help='Segmentation network: tells what moves and what is floor; a YAML file of the '
            'same name says how.',
        ),
    ] = None
    save_masks: Annotated[
        SaveMasks,
        typer.Option('--save-masks', help='Floor masks to save; all of them by run only.'),
    ] = SaveMasks.keyframes
    save_map: Annotated[
        Path | None, typer.Option('--save-map', help='File for the whole map, to continue later.')
    ] = None
    load_map: Annotated[Path | None, typer.Option('--load-map', help='Saved map to continue.')] = (
        None
    )
    localize: Annotated[
        bool,
        typer.Option(
            '--localize', help='Poses in the map of --load-map only; nothing is added to it.'
        ),
    ] = False
    no_map: Annotated[
        bool, typer.Option('--no-map', help='The path alone: no floor masks and no map are made.')
    ] = False
    report: Annotated[
        bool,
        typer.Option('--report', help='Write report.html: everything about the run on one page.'),
    ] = False
    view: View = None
    as_json: Json = False

    @property
    def inputs(self) -> tuple[Path | str | None, ...]:
        """All files and folders that are read."""
        return self.input, self.masks, self.load_map, self.network, self.params

    @property
    def maps(self) -> MapOptions:
        """The maps to go on with and to save. Raises SettingsError where they contradict."""
        return MapOptions(self.load_map, self.save_map, self.localize, self.inputs)

    def open(self) -> tuple[Configuration, StereoSource]:
        """Open the recording, and say what sensors it has."""
        sensors = {'masks': self.masks, 'ignore': self.ignore, 'depth': self.depth}
        configuration = self.configuration(**sensors)
        source = open_source(configuration.stereo_camera)
        print_sensors(source.sensors)
        return configuration, source


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that takes the fields of its first parameter, a dataclass, as options."""
    hints = get_type_hints(command, include_extras=True)
    first, *own = inspect.signature(command).parameters.values()
    group = hints.pop(first.name)
    fields = dataclasses.fields(group)
    hints |= get_type_hints(group, include_extras=True)

    @functools.wraps(command)
    def with_all(**values: Any) -> None:
        given = {field.name for field in fields} & values.keys()
        with json_alone(values.get('as_json', False)):
            command(group(**{name: values.pop(name) for name in given}), **values)

    keyword = inspect.Parameter.KEYWORD_ONLY
    all_of_them = [(f.name, f.default) for f in fields] + [(p.name, p.default) for p in own]
    parameters = [
        inspect.Parameter(
            name,
            keyword,
            default=inspect.Parameter.empty if default is dataclasses.MISSING else default,
            annotation=hints[name],
        )
        for name, default in all_of_them
    ]
    with_all.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    with_all.__annotations__ = hints
    return with_all


NAV2 = 'nav2'
"""The one of the shipped parameter files that is for the nodes of others."""


def shipped_params() -> dict[str, Path]:
    """Return the parameter files of this package that come with it, by name."""
    package = Path(segfloor_ros.__file__).parent
    # Of a checkout, and of an installation by pip or colcon, which is lib/python3/site-packages.
    places = [package.parent, *(p / 'share' / package.name for p in package.parents[3:4])]
    found = next((place / 'params' for place in places if (place / 'params').is_dir()), package)
    files = sorted(found.glob('*.yaml'))
    return {path.stem: path for path in files if path.stem != NAV2}


def params_file(path: Path) -> Path:
    """Return the parameter file of a path or of a shipped name. Raises SettingsError."""
    if path.exists() or path.suffix or len(path.parts) > 1:
        return path
    shipped = shipped_params()
    if path.name not in shipped:
        near = suggestion(path.name, list(shipped))
        raise SettingsError(
            f'--params {path}: no such file, and none of this name is shipped{near}'
        )
    return shipped[path.name]


def configuration(
    params: Path | None, assignments: list[str] | None, input: str, **camera: Any
) -> Configuration:
    """Return the configuration that the options of a command stand for. camera: settings of
    `stereo_camera`; those that are None or False were not given.
    """
    given = {
        name: str(value) if isinstance(value, Path) else value
        for name, value in camera.items()
        if value is not None and value is not False
    }
    return resolve(params, assignments or (), stereo_camera={'input': input, **given})


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExploreOptions:
    """What is explored, by which robot, and how far."""

    scene: Scene
    out: Out
    robot: Annotated[str, typer.Option(help='The robot: turtlebot3_burger or husky.')] = (
        'turtlebot3_burger'
    )
    goals: Annotated[int, number_option('Goals to draw at random and to drive to.', 0)] = 5
    seed: Annotated[int, number_option('Of the goals, the textures and the noise.', 0)] = 1
    goal: Annotated[
        list[str] | None,
        typer.Option(
            help='Drive to this place and explore nothing: a name in goals.yaml of --start-in, or '
            'X,Y in its map; repeatable.'
        ),
    ] = None
    start_in: Annotated[
        Path | None, typer.Option(help='Start in the map of this earlier exploration, be found.')
    ] = None
    minutes: Annotated[float, number_option("At most so long, in the robot's time.", 0.1)] = 30.0
    depth: Depth = False
    set_values: SceneValues = None
    params: Params = None
    as_json: Json = False
