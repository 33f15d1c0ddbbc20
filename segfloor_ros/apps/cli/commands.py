"""The commands that map and make recordings: run, replay, demo, params, simulate, explore."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from importlib import resources, util
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from segfloor_ros.apps.cli import terminal
from segfloor_ros.apps.cli.evaluate import map_table
from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.cli.terminal import ExploreOptions, number_option
from segfloor_ros.apps.cli.view import open_view
from segfloor_ros.apps.evaluation.map_score import compare, overlay_png, score_map
from segfloor_ros.apps.evaluation.maps import load_truth
from segfloor_ros.apps.lockstep import LockstepRun, SaveMasks
from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.results_folder import OutputFolder
from segfloor_ros.core.errors import MapError, SettingsError, about
from segfloor_ros.core.files.whole import read_json
from segfloor_ros.core.files.writing import add_files, check_target
from segfloor_ros.core.processes import Interrupt, first_interrupt_noted
from segfloor_ros.nodes.network_files import open_network
from segfloor_ros.nodes.settings.camera import StereoCameraNodeSettings
from segfloor_ros.nodes.yaml_files import read_yaml

DRIVE = Path(str(resources.files('segfloor_ros.apps.simulation') / 'demo'))
"""A drive through the shipped scene corridor1 with its truth, made by `segfloor simulate corridor1
--supersampling 2 --floor-every 0 --set camera.width=480 --set camera.height=360
--set camera.noise_sigma=1.0` and `segfloor convert` with JPEG images.
"""


@terminal.with_options
def run(
    options: terminal.DriveOptions,
    save_debug: Annotated[
        bool,
        typer.Option(
            '--save-debug',
            help='Save pictures of the floor of each keyframe: mask, v-disparity with profile.',
        ),
    ] = False,
) -> None:
    """Map a recording: every frame, no ROS graph, the same result byte for byte.

    \b
    segfloor run drive.mcap --out result --report
    segfloor run drive.mcap --out result --view
    segfloor run sequences/06 --params kitti --frames 200 --out map06
    """
    maps = options.maps
    sees = None if options.network is None else open_network(options.network)
    configuration, source = options.open()
    with (
        OutputFolder(options.out, options.inputs) as folder,
        open_view(options.view, options.inputs) as view,
    ):
        with (
            _interruptible() as interrupt,
            terminal.progress_bar('mapping', source.frame_count) as progress,
        ):
            drive = LockstepRun(
                source,
                configuration,
                folder,
                options.save_masks,
                save_debug,
                maps,
                interrupt,
                options.no_map,
                view,
                sees,
            )
            result = drive.execute(progress)
            folder.write(result)
            try:
                drive.save_map()
            except Exception as error:  # whatever it is, the results are there
                folder.problems.append(str(error) or type(error).__name__)
        if view is not None:
            view.on_result(result)
        terminal.print_summary(options.input, result.summary)
        remarks, status = [drive.note] if drive.note else [], interrupt.status
        if drive.no_map and not options.no_map:
            folder.problems.append(drive.no_map)
        if drive.broken_off is not None:
            remarks.append(f'{drive.broken_off}; the map is of what came before')
            status = status or 2
        figures = result.summary if options.as_json else None
        terminal.finish_run(
            options.input, options.out, folder, options.report, remarks, status, figures
        )


@contextmanager
def _interruptible() -> Iterator[Interrupt]:
    """The interrupt that ends a drive early: where there is no map yet, the command ends."""
    with first_interrupt_noted() as interrupt:
        try:
            yield interrupt
        except MapError:
            terminal.end_if_interrupted(interrupt)
            raise


@terminal.with_options
def replay(
    options: terminal.DriveOptions,
    rate: Annotated[
        float,
        typer.Option(
            help='Speed against real time, less where the nodes cannot follow; 0: full speed.'
        ),
    ] = 1.0,
) -> None:
    """Map a recording with the five ROS 2 nodes over DDS.

    \b
    segfloor replay drive.mcap --out result
    segfloor replay drive.mcap --rate 0 --view --out result
    """
    with terminal.needing_ros('replay'):
        from segfloor_ros.apps.cli.replay_session import ReplaySession
    if options.save_masks is SaveMasks.all:
        raise SettingsError(
            '--save-masks all: the nodes segment keyframes only; take keyframes, or segfloor run'
        )
    StereoCameraNodeSettings(rate=rate)  # refuses an impossible rate
    if options.network is not None:
        open_network(options.network)  # one that cannot be read ends at once
    maps = options.maps
    # The camera node reads it; it is opened here so that bad input ends at once.
    configuration, source = options.open()
    if source.takes_depth:
        camera = dataclasses.replace(configuration.stereo_camera, depth=True)
        configuration = dataclasses.replace(configuration, stereo_camera=camera)
    loaded = maps.read(source.camera)
    with (
        OutputFolder(options.out, options.inputs) as folder,
        open_view(options.view, options.inputs) as view,
    ):
        with (
            _interruptible() as interrupt,
            terminal.progress_bar('replaying', source.frame_count) as progress,
        ):
            keep = partial(folder.add_picture, 'floor_masks')
            session = ReplaySession(
                configuration,
                options.params,
                rate,
                keep if options.save_masks is SaveMasks.keyframes else None,
                progress,
                interrupt,
                maps,
                loaded,
                options.no_map,
                view,
                options.network,
            )
            result, found = session.execute()
            folder.write(result)
        if view is not None:
            view.on_result(result)
        terminal.print_summary(options.input, result.summary)
        console.print(
            f'nodes connected in {found.discovery_s:.1f} s, stopped in {found.shutdown_s:.1f} s; '
            f'keyframes that failed: {found.failed_keyframes}'
        )
        status = interrupt.status or found.status
        figures = result.summary if options.as_json else None
        terminal.finish_run(
            options.input, options.out, folder, options.report, found.notices, status, figures
        )


def demo(
    out: Annotated[Path, typer.Option('--out', help='Folder for the results.')] = Path(
        'segfloor_demo'
    ),
    rate: Annotated[
        float, typer.Option(help='Speed against real time; 0: as fast as the nodes take it.')
    ] = 0.0,
    lockstep: Annotated[
        bool, typer.Option('--lockstep', help='Without ROS: one process in place of five nodes.')
    ] = False,
    real: Annotated[
        bool,
        typer.Option(
            '--real', help='Map a car on a road instead: 51 public pairs of KITTI, 30 MB to fetch.'
        ),
    ] = False,
    data: Annotated[
        Path | None,
        typer.Option(help='Folder of what --real fetches.', show_default='segfloor_kitti'),
    ] = None,
    as_json: terminal.Json = False,
) -> None:
    """Map a recorded drive through a corridor with the five nodes and score the map.

    \b
    segfloor demo
    segfloor demo --lockstep --out demo
    segfloor demo --real --out road
    """
    if data is not None and not real:
        raise SettingsError('--data: only --real fetches something; add it, or leave --data out')
    StereoCameraNodeSettings(rate=rate)  # refuses an impossible rate
    data = data or Path('segfloor_kitti')
    with terminal.json_alone(as_json):
        scores = _real_demo(out, rate, lockstep, data) if real else _demo(out, rate, lockstep)
    if as_json:
        terminal.print_json(scores)


def _demo(out: Path, rate: float, lockstep: bool) -> dict[str, Any]:
    drive, what = str(DRIVE / 'drive.mcap'), 'a simulated drive through a corridor'
    _map_demo(what, lockstep, rate, input=drive, out=out)
    return _print_scores(out)


def _map_demo(what: str, lockstep: bool, rate: float, **options: Any) -> None:
    if lockstep or util.find_spec('rclpy') is None:
        console.print(f'mapping {what}, in one process without ROS')
        run(**options)
    else:
        console.print(f'replaying {what} through the five nodes')
        replay(**options, rate=rate)


def _real_demo(out: Path, rate: float, lockstep: bool, data: Path) -> dict[str, Any]:
    # Imported here: fsspec is an extra.
    from segfloor_ros.apps.suite import public_drive

    with OutputFolder(out, [data / public_drive.FOLDER]):
        console.print(public_drive.ABOUT)  # nothing is fetched for an --out that is refused
    count = sum(map(len, public_drive.files_by_url().values()))
    with terminal.progress_bar('fetching', count) as progress:
        drive = public_drive.fetched(data, progress)
    options = {'frames': public_drive.PAIRS, 'params': terminal.shipped_params()['kitti']}
    what = 'a car on a road in Karlsruhe'
    _map_demo(what, lockstep, rate, input=str(drive), out=out, report=True, **options)
    return read_json(out / 'summary.json', 'a summary')


def _print_scores(out: Path) -> dict[str, Any]:
    """Print and return how good map and path are; the last line is the path of the report."""
    # Imported here: evo and matplotlib take a second that no other command should wait for.
    from segfloor_ros.apps.evaluation.report import write_report

    truth = load_truth(DRIVE)
    grid = load_map(out / 'map.yaml')
    score = score_map(grid, truth)
    scores: dict[str, Any] = {'map': dataclasses.asdict(score), 'path': None}
    console.print(map_table(score))
    try:
        from segfloor_ros.apps.evaluation.trajectory import match_files, score_trajectory
    except ModuleNotFoundError:  # evo is an extra
        console.print("path: its error is measured after pip install 'segfloor_ros[evaluate]'")
    else:
        path = score_trajectory(match_files(out, DRIVE))
        scores['path'] = dataclasses.asdict(path)
        console.print(
            f'path: {path.path_length_m:.1f} m, {100 * path.tracked:.1f} % of the frames tracked, '
            f'error {100 * path.ate_rmse_m:.1f} cm (RMSE after alignment)'
        )
    add_files(out, {'overlay.png': overlay_png(compare(grid, truth))})
    console.print(f'map on the truth: {out / "overlay.png"}', soft_wrap=True)
    console.print(str(write_report(out, DRIVE)), soft_wrap=True)
    return scores


def params() -> None:
    """List the parameter files that `--params NAME` finds.

    \b
    segfloor params
    segfloor run sequences/06 --params kitti --out map06
    """
    shipped = terminal.shipped_params()
    folder = next((f' in {path.parent}' for path in shipped.values()), '')
    console.print(_described(f'file{folder}', {n: p.read_text() for n, p in shipped.items()}))


def _described(name: str, texts: Mapping[str, str]) -> Table:
    """Return a table of names, each with the first sentence of its text."""
    table = Table(name, 'is for')
    for key, text in texts.items():
        sentence = re.split(r'[.:](?=\s)', text, maxsplit=1)[0]
        table.add_row(key, ' '.join(sentence.replace('#', ' ').split()))
    return table


def _list_scenes(is_asked: bool) -> None:
    if not is_asked:
        return
    from segfloor_ros.apps.simulation.scene_file import shipped

    scenes = {name: read_yaml(path, 'a scene') for name, path in shipped().items()}
    texts = {name: str(scene['description']) for name, scene in scenes.items()}
    console.print(_described('scene', texts))
    raise typer.Exit


def simulate(
    scene: terminal.Scene,
    out: terminal.Out,
    camera: Annotated[
        str | None,
        typer.Option(help='See through one of a kind: webcam, oak, realsense, zed, kinect.'),
    ] = None,
    set_values: terminal.SceneValues = None,
    floor_every: Annotated[
        int, number_option('Write a true floor mask every N frames; 0: none.', 0)
    ] = 10,
    disparity: Annotated[
        bool, typer.Option('--disparity', help='With each mask the true disparity (1/256 px).')
    ] = False,
    labels: Annotated[
        bool,
        typer.Option(
            '--labels',
            help='With each mask the class of each pixel, and which person or car it is.',
        ),
    ] = False,
    supersampling: Annotated[int, number_option('Render N times finer than the image.', 1, 4)] = 1,
    list_scenes: Annotated[
        bool,
        typer.Option(
            '--list', help='List the shipped scenes.', callback=_list_scenes, is_eager=True
        ),
    ] = False,
    as_json: terminal.Json = False,
) -> None:
    """Render a drive with exact truth: images, calibration, poses, map and floor masks.

    \b
    segfloor simulate --list
    segfloor simulate corridor1 --out corridor1
    segfloor simulate hall --camera realsense --set seed=7 --out hall
    segfloor simulate floor_plan.yaml --out office
    """
    # Imported here: the simulator takes time that other commands should not wait for.
    from segfloor_ros.apps.simulation.scene_file import open_scene
    from segfloor_ros.apps.simulation.simulation import (
        RECORDED,
        RecordingOptions,
        Simulation,
        record,
    )

    kind = [f'camera.kind={camera}'] if camera is not None else []
    described = open_scene(scene, [*kind, *(set_values or ())])
    check_target(out, RECORDED)  # before the scene is built, which takes a second
    wanted = RecordingOptions(floor_every, disparity, labels)
    with (
        about(scene),
        Simulation(described, supersampling, labels=labels) as simulation,
        terminal.progress_bar('rendering', simulation.frame_count) as progress,
    ):
        record(simulation, out, wanted, progress)
        pairs, drive = simulation.frame_count, simulation.drive
    seconds = float(drive.times_s[-1])
    if as_json:
        facts = {'pairs': pairs, 'path_m': drive.length_m, 'duration_s': seconds, 'out': str(out)}
        return terminal.print_json(facts)
    console.print(f'{pairs} pairs, {drive.length_m:.1f} m, {seconds:.0f} s: {out}')


@terminal.with_options
def explore(options: ExploreOptions) -> None:
    """Let a simulated robot explore a scene by the map that the nodes make, then drive to goals.

    \b
    segfloor explore complex_room --out explored
    segfloor explore office.yaml --out explored --robot husky --goals 20 --seed 3
    segfloor explore complex_room --out again --start-in explored --goal goal_2
    """
    # Imported here: simulator and pictures take time that other commands should not wait for.
    with terminal.needing_ros('explore'):
        from segfloor_ros.apps.cli.explore_session import explore_scene
    explore_scene(options)
