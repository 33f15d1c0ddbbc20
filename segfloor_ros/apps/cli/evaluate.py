"""`segfloor evaluate`: scores of maps, trajectories and floor masks against the truth; and what the
stages cost: `segfloor benchmark`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table
from rich.text import Text

from segfloor_ros.apps.benchmark import Step, profile_recording
from segfloor_ros.apps.cli import terminal
from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.cli.terminal import (
    Json,
    Params,
    Set,
    figure_table,
    needing_ros,
    number_option,
    print_json,
    progress_bar,
    value_table,
)
from segfloor_ros.apps.evaluation.floor import score_floor_folders
from segfloor_ros.apps.evaluation.map_score import (
    DEFAULT_RANGE_M,
    MapScore,
    RoadMapPlan,
    Spread,
    compare,
    overlay_png,
    score_map,
)
from segfloor_ros.apps.evaluation.maps import (
    MapTruth,
    find_alignment,
    from_frame,
    load_truth,
    read_base_poses,
)
from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.trajectory import FARTHEST, TUM_COLUMNS
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.errors import SettingsError
from segfloor_ros.core.files.whole import number, read_table
from segfloor_ros.core.files.writing import PNG, check_output, marked_png, write_output
from segfloor_ros.core.geometry import Pose2d
from segfloor_ros.core.grid.occupancy import OccupancyGrid

if TYPE_CHECKING:
    from segfloor_ros.apps.evaluation.trajectory import TrajectoryScore

app = typer.Typer(help='Score a map, a trajectory or floor masks against the truth.')


@app.command('map')
def evaluate_map(
    estimate: Annotated[Path, typer.Argument(metavar='EST', help='map.yaml or a run folder.')],
    truth: Annotated[Path, typer.Argument(metavar='TRUTH', help='map.yaml or a scene folder.')],
    trajectory: Annotated[
        Path | None,
        typer.Option(
            help='Where the robot was, so that recall counts only what it could see: '
            'base_poses.txt (t x y yaw in the frame of TRUTH) or TUM (in the frame of EST).'
        ),
    ] = None,
    align: Annotated[
        str,
        typer.Option(
            help='none: EST starts where the scene says, or in the frame of TRUTH; '
            'found: searched, translation and rotation; or X,Y,YAW of the frame of EST (m, rad).'
        ),
    ] = 'none',
    overlay: Annotated[Path | None, typer.Option(help='Write a picture (PNG).')] = None,
    nodes: Annotated[
        int, number_option('Nodes of a road map; 0: one per 1.5 m², 20 to 400.', 0, 10_000)
    ] = 0,
    min_distance: Annotated[float, number_option('Between nodes of a road map, in m.', 0.0)] = 0.25,
    repetitions: Annotated[int, number_option('Road maps to average.', 1)] = 30,
    seed: Annotated[int, number_option('Of the random nodes.', 0)] = 0,
    sight: Annotated[
        float, number_option('Range of the camera, in m.', 0.1, 1000.0)
    ] = DEFAULT_RANGE_M,
    fov: Annotated[
        float | None,
        number_option("Horizontal field of view, in degrees; else the scene's.", 1.0, 360.0),
    ] = None,
    as_json: Json = False,
) -> None:
    """Road-map precision and recall, raw and after opening, and precision and recall per cell.

    \b
    segfloor evaluate map result corridor1 --overlay overlay.png
    segfloor evaluate map result truth.yaml --align found --json
    """
    inputs = [estimate, truth, trajectory]
    if overlay is not None:
        check_output(overlay, PNG, inputs, '--overlay')
    grid = load_map(estimate / 'map.yaml' if estimate.is_dir() else estimate)
    known = load_truth(truth)
    pose = resolve_alignment(align, grid, known)
    known = _with_drive(known, trajectory, fov, pose)
    plan = RoadMapPlan(nodes=nodes, min_distance_m=min_distance, repetitions=repetitions, seed=seed)
    score = score_map(grid, known, pose, plan, sight)
    if overlay is not None:
        picture = marked_png(overlay_png(compare(grid, known, pose, sight)))
        write_output(overlay, PNG, picture, inputs)
    if as_json:
        return print_json(dataclasses.asdict(score))
    console.print(map_table(score))
    if overlay is not None:
        console.print(f'overlay: {overlay}', soft_wrap=True)


@app.command('trajectory')
def evaluate_trajectory(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar='EST... TRUTH',
            help='Estimates, each a TUM or KITTI file or a run folder, and at last the truth: a '
            'TUM or KITTI file or a recording folder.',
        ),
    ],
    frames: Annotated[
        int | None, number_option('Frames of the recording; else one per true pose.', 1)
    ] = None,
    plot: Annotated[Path | None, typer.Option(help='Write a picture (PNG).')] = None,
    as_json: Json = False,
) -> None:
    """ATE and RPE after rigid alignment, path lengths, and the share of frames that were tracked.

    \b
    segfloor evaluate trajectory result corridor1 --plot path.png
    segfloor evaluate trajectory with_masks without orb.txt corridor1 --plot paths.png
    """
    # Imported here: evo and matplotlib take a second that no other command should wait for.
    from segfloor_ros.apps.evaluation.trajectory import (
        check_plot,
        match_files,
        save_trajectory_plot,
        score_trajectory,
    )

    *estimates, truth = paths
    if not estimates:
        raise SettingsError(f'{truth}: give one estimate or more, and at last the truth')
    if plot is not None:
        check_plot(plot, paths)
    matched = {
        name: match_files(estimate, truth, frames)
        for name, estimate in zip(short_names(estimates), estimates, strict=True)
    }
    scores = {name: score_trajectory(one) for name, one in matched.items()}
    if plot is not None:
        save_trajectory_plot(matched, plot)
    if as_json:
        documents = {name: dataclasses.asdict(score) for name, score in scores.items()}
        return print_json(documents if len(scores) > 1 else next(iter(documents.values())))
    if len(scores) > 1:
        console.print(trajectories_table(scores))
    else:
        (score,) = scores.values()
        rows = [
            ('frames tracked', f'{100 * score.tracked:.1f} % of {score.frames}'),
            ('path length', f'{score.estimate_length_m:.2f} m, true {score.path_length_m:.2f} m'),
            ('ATE (RMSE, aligned)', f'{score.ate_rmse_m:.4f} m'),
            ('ATE (largest)', f'{score.ate_max_m:.4f} m'),
            ('RPE over 1 m', f'{score.rpe_translation_m:.4f} m, {score.rpe_rotation_rad:.5f} rad'),
            ('error at the end', f'{score.end_error_m:.4f} m'),
        ]
        console.print(value_table('measure', rows))
    if plot is not None:
        console.print(f'plot: {plot}', soft_wrap=True)


def short_names(paths: Sequence[Path]) -> list[str]:
    """Return a name for each path: the fewest of its last parts that no other one ends with."""
    parts = [path.resolve().with_suffix('').parts for path in paths]
    most = max(map(len, parts))
    for count in range(1, most):
        names = ['/'.join(some[-count:]) for some in parts]
        if len(set(names)) == len(names):
            return names
    return [f'{number}: {path}' for number, path in enumerate(paths, 1)]


def trajectories_table(scores: Mapping[str, TrajectoryScore]) -> Table:
    """Return the scores of several estimates of one drive side by side."""
    table = figure_table(
        'estimate', 'tracked %', 'length m', 'true m', 'ATE m', 'RPE m', 'RPE rad', 'end m'
    )
    for name, score in scores.items():
        table.add_row(
            name,
            f'{100 * score.tracked:.1f}',
            f'{score.estimate_length_m:.2f}',
            f'{score.path_length_m:.2f}',
            f'{score.ate_rmse_m:.4f}',
            f'{score.rpe_translation_m:.4f}',
            f'{score.rpe_rotation_rad:.5f}',
            f'{score.end_error_m:.4f}',
        )
    table.caption = 'lengths between the poses that estimate and truth have in common'
    return table


@app.command('floor')
def evaluate_floor(
    estimate: Annotated[
        Path, typer.Argument(metavar='EST_DIR', help='Folder of masks, or a run folder.')
    ],
    truth: Annotated[
        Path,
        typer.Argument(
            metavar='TRUTH', help='Folder of masks, a scene folder, or a file of outlines (.yaml).'
        ),
    ],
    as_json: Json = False,
) -> None:
    """Precision, recall, intersection over union and coverage of floor masks.

    \b
    segfloor evaluate floor result corridor1
    segfloor evaluate floor result outlines.yaml --json
    """
    score = score_floor_folders(estimate, truth)
    if as_json:
        return print_json(score.as_dict())
    shares = ('precision', 'recall', 'false_floor_share', 'iou', 'coverage')
    rows = [(name.replace('_', ' '), f'{100 * getattr(score, name):.2f} %') for name in shares]
    rows.append(('masks scored', str(score.masks)))
    rows.append(('true masks without an estimate', str(score.missing)))
    console.print(value_table('measure', rows))


@app.command('report')
def evaluate_report(
    run: Annotated[Path, typer.Argument(metavar='RUN', help='Results folder of a run.')],
    truth: Annotated[
        Path | None, typer.Option(help='Scene folder or map.yaml to score against.')
    ] = None,
) -> None:
    """Write report.html, one page with all pictures of a run, into its folder.

    \b
    segfloor evaluate report result --truth corridor1
    """
    from segfloor_ros.apps.evaluation.report import write_report

    console.print(f'report: {write_report(run, truth)}', soft_wrap=True)


def resolve_alignment(align: str, estimate: OccupancyGrid, truth: MapTruth) -> Pose2d:
    """Return where the estimate's frame lies in the truth's, as `--align` says."""
    if align == 'none':
        return truth.start
    if align == 'found':
        return find_alignment(estimate, truth.grid, truth.start_pose)
    try:
        x, y, yaw = (number(part.strip()) for part in align.split(','))
        if max(map(abs, (x, y, yaw))) > FARTHEST:
            raise ValueError('further than any map')
    except ValueError:
        raise SettingsError(
            f'--align {align}: expected none, found or X,Y,YAW in metres and radians'
        ) from None
    return x, y, yaw


def map_table(score: MapScore) -> Table:
    """Return the score of a map as a table for the terminal."""
    title = 'map, floor the drive could see' if score.observable_only else 'map, whole floor'
    table = figure_table('measure', 'precision %', 'recall %')
    table.title = f'{title}: {score.area_m2:.1f} m²'
    for name, road_map in (('raw', score.raw), ('after opening', score.opened)):
        table.add_row(
            f'road map, {name} (±: over repetitions)',
            _percent(road_map.precision),
            _percent(road_map.recall),
        )
    cells = score.cells
    table.add_row(
        'free cells', f'{100 * cells.free_precision:.2f}', f'{100 * cells.free_recall:.2f}'
    )
    table.add_row(
        'occupied cells',
        f'{100 * cells.occupied_precision:.2f}',
        f'{100 * cells.occupied_recall:.2f}',
    )
    x, y, yaw = score.alignment
    table.caption = (
        f'{score.nodes} nodes; frame of EST at x {x:.3f} m, y {y:.3f} m, yaw {yaw:.4f} rad'
    )
    return table


def _with_drive(
    truth: MapTruth, trajectory: Path | None, fov_deg: float | None, pose: Pose2d
) -> MapTruth:
    """Return the truth with the drive and field of view of the command line, where given."""
    if trajectory is not None:
        poses = read_base_poses(trajectory)
        if read_table(trajectory).shape[1] == len(TUM_COLUMNS):
            poses[:, :2] = from_frame(poses[:, :2], pose)
            poses[:, 2] += pose[2]
        truth = dataclasses.replace(truth, base_poses=poses)
    if fov_deg is not None:
        truth = dataclasses.replace(truth, fov_rad=math.radians(fov_deg))
    return truth


def _percent(spread: Spread) -> str:
    return f'{100 * spread.mean:.2f} ± {100 * spread.std:.2f}'


def benchmark(
    recording: Annotated[
        str | None, typer.Argument(help='Recording; else the drive of segfloor demo.')
    ] = None,
    frames: Annotated[int, number_option('Image pairs of the recording.', 2)] = 100,
    threads: Annotated[int, number_option('Threads of OpenCV; one compares machines best.', 1)] = 1,
    nodes: Annotated[
        str | None,
        typer.Option(
            metavar='RECORDING',
            help='Play this recording through the five node processes instead: latency from image '
            'to map, CPU, memory and losses.',
        ),
    ] = None,
    rate: Annotated[float, number_option('Speed of --nodes against real time.', 0.01)] = 1.0,
    as_json: Json = False,
    params: Params = None,
    assignments: Set = None,
) -> None:
    """Print the time of each step of a frame and of a keyframe, or the cost of the nodes.

    \b
    segfloor benchmark
    segfloor benchmark drive.mcap --json > figures.json
    segfloor benchmark --nodes drive.mcap
    """
    if nodes is not None:
        configuration = terminal.configuration(params, assignments, nodes)
        return print_node_figures(configuration, rate, as_json=as_json)
    if recording is None:
        from segfloor_ros.apps.cli.commands import DRIVE

        recording = str(DRIVE / 'drive.mcap')
    configuration = terminal.configuration(params, assignments, recording)
    source = open_source(configuration.stereo_camera)
    with progress_bar('measuring', frames) as progress:
        steps = profile_recording(source, frames, threads, configuration, progress)
    if as_json:
        return print_json({'steps': [dataclasses.asdict(step) for step in steps]})
    console.print(step_table(steps))


def print_node_figures(
    configuration: Configuration, rate: float, lossless: bool = False, as_json: bool = False
) -> None:
    """Play the recording of the configuration through the nodes and print what it cost. lossless:
    lose no frame, as opposed to keeping to the clock.
    """
    with needing_ros('to measure the nodes'):
        from segfloor_ros.apps.cli.replay_session import figure_rows, measure_nodes
    frames = open_source(configuration.stereo_camera).frame_count
    with progress_bar('playing', frames) as progress:
        figures = measure_nodes(configuration, rate, lossless, progress)
    rows = figure_rows(figures)
    if as_json:
        return print_json(dict(rows))
    console.print(value_table('figure', rows))


def step_table(steps: list[Step]) -> Table:
    """Return the share of each step as a table."""
    table = figure_table('step', 'calls', 'ms / call', 'share %')
    for step in steps:
        name = Text('  ' * (len(step.path) - 1) + step.path[-1], '' if step.path[1:] else 'bold')
        table.add_row(name, str(step.calls), f'{step.ms:.2f}', f'{100 * step.share:.1f}')
    table.caption = (
        'tracking: of each frame; moving: of each search for what moves; the others: of each '
        'keyframe; steps are part of the step above; computed on one thread'
    )
    return table
