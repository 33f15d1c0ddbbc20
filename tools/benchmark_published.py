"""The scenes of the published evaluation, rendered, mapped and scored here, beside the published
figures: `python -m tools.benchmark_published`.

Each is mapped by default, and as published: by the same drive. `--peers FOLDER` also runs other
programs over it (`published_peers`), and maps it by `rtabgrid grid DIR --out MAP …`, RTAB-Map.
The drives of the second published work are compared by their paths (`published_paths`).

`--keep` writes docs/published.json, from which `python -m tools.figures write` makes the table of
docs/benchmarks.md.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import json
import os
import re
import subprocess
import tempfile
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Optional

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table

from segfloor_ros import __version__
from segfloor_ros.apps.cli import terminal as options
from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.cli.terminal import Announce, announcing, figure_table
from segfloor_ros.apps.evaluation.map_score import (
    RoadMapPlan,
    RoadMapScore,
    compare,
    overlay_png,
    score_map,
)
from segfloor_ros.apps.evaluation.maps import MapTruth, load_truth
from segfloor_ros.apps.evaluation.trajectory import match, match_files, score_trajectory
from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.simulation.scene import Scene
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.simulation import RecordingOptions, render_once
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import KeyframePath
from segfloor_ros.core.errors import MapError, SegfloorError
from segfloor_ros.core.files.whole import read_json
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, OccupancyGrid, OccupancyGridSettings
from segfloor_ros.nodes.configuration import resolve
from segfloor_ros.nodes.map_files import save_map
from segfloor_ros.nodes.yaml_files import read_yaml
from tools import published_paths
from tools.benchmark_stages import (
    JSON_VERSION,
    MeasuredStages,
    Progress,
    Workload,
    machine,
    run_in_process,
    stage_table,
    workload_table,
)
from tools.driving import drive, open_recording
from tools.published_figures import (
    HEADS,
    PUBLISHED,
    RATE_HZ,
    RAYS,
    SOURCE,
    Row,
    cells_of,
    parse_scenes,
)
from tools.published_paths import PathRow
from tools.published_peers import SlamRow, run_peers, run_program, slam_cells

SCENES = (*PUBLISHED, *published_paths.DRIVES)
KEPT = Path(__file__).resolve().parents[1] / 'docs' / 'published.json'
KINDS = (('rows', Row, 'scene'), ('paths', PathRow, 'drive'), ('slam', SlamRow, 'drive'))
"""What is kept there: the name and the type of rows, and what they are of."""

DEFAULT, AS_PUBLISHED = 'segfloor_ros', 'segfloor_ros, as published'
MODES: dict[str, tuple[str, ...]] = {
    DEFAULT: (),
    AS_PUBLISHED: (
        'occupancy_grid.as_published=true',
        'cloud_labelling.robot_height_m=10',
        'stereo_slam.keyframe_novelty=0.3',
        'stereo_slam.num_features=3000',
    ),
}
"""Assignments by name. As published: points alone, no height limit, a keyframe wherever the
published conditions ask for one, and as many features as fit the floor."""

RTABMAP_CELL_M = 0.05
SPECK_CELLS = 3
"""Side of the square by which maps are opened; what fits into it is a speck."""


@dataclasses.dataclass(frozen=True)
class SceneResult:
    """A scene mapped here: its row, what it cost, and the score of the map on the floor that the
    drive could see, as the map is and after an opening.
    """

    row: Row
    workload: Workload
    raw: RoadMapScore
    opened: RoadMapScore


def published_scene(name: str, changes: Sequence[str] = ()) -> Scene:
    """Return the scene as it is driven for these figures: at the published rate, as slowly as it
    takes for about as many keyframes.
    """
    published = PUBLISHED[name]
    given = [f'camera.rate_hz={RATE_HZ:g}', f'resolution_m={published.cell_m:g}']
    if published.waypoints:
        given.append(f'path.waypoints={[list(point) for point in published.waypoints]}')
        given.append(f'path.speed_m_s={published.speed_m_s:g}')
    return open_scene(name, [*given, *changes])


def run_scene(
    name: str,
    scene: Scene,
    folder: Path,
    configuration: Configuration,
    threads: int,
    announce: Announce,
    system: str = DEFAULT,
) -> SceneResult:
    """Render a scene into `folder` unless it is there, map it in a process of its own, score the
    map, and leave map and overlay in the folder, under the name of the system.

    The cells of truth and map are of the same size, so that their rasters do not blur the score:
    of the size set for the map where that is not the default, else as in the published maps.

    Raises RenderingError where nothing can be rendered and MapError when no map came of it.
    """
    published = PUBLISHED[name]
    cell_m = configuration.occupancy_grid.resolution_m
    if cell_m == OccupancyGridSettings.resolution_m:
        cell_m = published.cell_m
    configuration = with_cells(configuration, cell_m)
    scene = dataclasses.replace(scene, resolution_m=cell_m)
    recording = folder / 'recording'
    render_once(
        scene,
        recording,
        RecordingOptions(floor_every=0),
        on_start=lambda count: announce(f'rendering {name}', count),
    )
    frames = open_recording(recording, configuration).frame_count
    report = announce(f'mapping {name}', frames or 0)
    workload, grid, path, cpu_s = run_in_process(
        map_recording, name, recording, configuration, threads, on_progress=report
    )
    truth = load_truth(recording)
    stem = 'map' if system == DEFAULT else 'map_as_published'
    row, raw, opened = scored_row(grid, truth, name, system, folder / stem)
    row = dataclasses.replace(
        row,
        keyframes=len(path.stamp_ns),
        update_s=workload.update_s['mean'],
        update_max_s=workload.update_s['max'],
        update_mb=workload.memory_mb['slope_per_update'],
        path_error_m=keyframes_error_m(path, recording),
        cpu_s=cpu_s,
        peak_mb=workload.memory_mb['peak'],
    )
    return SceneResult(row, workload, raw, opened)


def with_cells(configuration: Configuration, cell_m: float) -> Configuration:
    """Return the configuration for a map with cells of this size."""
    grid = dataclasses.replace(configuration.occupancy_grid, resolution_m=cell_m)
    return dataclasses.replace(configuration, occupancy_grid=grid)


def scored_row(
    grid: OccupancyGrid, truth: MapTruth, name: str, system: str, stem: Path
) -> tuple[Row, RoadMapScore, RoadMapScore]:
    """Return the row of a map, and its scores on the floor that the drive could see, as it is and
    opened; write the map and its overlay. As published, specks within free floor are removed first.
    """
    save_map(grid, stem.with_suffix('.yaml'))
    grid = without_specks(grid)
    overlay = overlay_png(compare(grid, truth, truth.start))
    stem.with_name(f'{stem.name}_overlay.png').write_bytes(overlay)
    plan = RoadMapPlan(nodes=PUBLISHED[name].nodes)
    seen = score_map(grid, truth, truth.start, plan)
    everywhere = score_map(
        grid, dataclasses.replace(truth, base_poses=None), truth.start, plan
    ).opened
    row = Row(
        name,
        system,
        cell_m=grid.resolution_m,
        precision_percent=100 * seen.opened.precision.mean,
        recall_seen_percent=100 * seen.opened.recall.mean,
        recall_all_percent=100 * everywhere.recall.mean,
    )
    return row, seen.raw, seen.opened


def without_specks(grid: OccupancyGrid) -> OccupancyGrid:
    """Return a map whose isolated occupied cells, those within free ones that an erosion removes,
    are free (§7.4, p. 107).
    """
    cells = grid.cells.copy()
    others = (grid.states != FREE).astype(np.uint8)
    count, label, stats, _ = cv2.connectedComponentsWithStats(others, connectivity=8)
    size = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]
    speck = (size <= SPECK_CELLS).all(axis=1)
    speck &= np.bincount(label.ravel(), (grid.states == OCCUPIED).ravel(), count) > 0
    edge: NDArray[np.int32] = np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]])
    speck[edge] = False
    speck[0] = False
    cells[speck[label]] = FREE
    return dataclasses.replace(grid, cells=cells)


def map_recording(
    name: str, recording: Path, configuration: Configuration, threads: int, on_progress: Progress
) -> tuple[Workload, OccupancyGrid, KeyframePath, float]:
    """Run all stages over a recording; return what it cost, the map, the path of the keyframes and
    the CPU time in seconds.
    """
    cv2.setNumThreads(threads)
    source = open_recording(recording, configuration)
    stages = MeasuredStages(source.camera, configuration)
    with contextlib.closing(stages):
        deque(drive(stages, source.frames(), on_progress), maxlen=0)
    if stages.grid is None:
        raise MapError(f'{name}: no map came of {stages.frames} frames')
    usage = os.times()
    return stages.workload(name), stages.grid, stages.stages.path, usage.user + usage.system


def keyframes_error_m(path: KeyframePath, recording: Path) -> float:
    """Return the RMSE of the keyframes' bases after a rigid alignment with the true ones."""
    times_s, x, y, yaw = np.loadtxt(recording / 'base_poses.txt').T
    poses: Array = np.tile(np.eye(4), (len(times_s), 1, 1))
    poses[:, 0, 0], poses[:, 0, 1] = np.cos(yaw), -np.sin(yaw)
    poses[:, 1, 0], poses[:, 1, 1] = np.sin(yaw), np.cos(yaw)
    poses[:, 0, 3], poses[:, 1, 3] = x, y
    estimated = (path.stamp_ns / 1e9, path.T_map_base)
    return score_trajectory(match(estimated, (times_s, poses), len(times_s))).ate_rmse_m


def run_rtabmap(program: Path, name: str, folder: Path, announce: Announce) -> Row:
    """Return the row of RTAB-Map on a scene that is rendered: with its own path, one update of the
    map a second, ray tracing, rays as long as published. Raises SegfloorError where it fails.

    Without ray tracing its maps of the corridors have next to no floor, as its block matching finds
    a disparity in 3 % of the floor's pixels; that is not measured.
    """
    recording, truth = folder / 'recording', load_truth(folder / 'recording')
    facts = read_yaml(recording / 'scene.yaml', 'names and values')
    announce(f'RTAB-Map on {name}', 0)
    path, stem = folder / 'rtabmap.txt', folder / 'rtabmap'
    said, cpu_s, peak_mb = run_program([program, 'slam', recording, '--out', path])
    nodes = int(_figure(said, 'slam_nodes'))
    words: list[str | Path | float] = [program, 'grid', recording, '--out', stem, '--tum', path]
    words += ['--step', round(float(facts['rate_hz'])), '--height', facts['camera_height_m']]
    words += ['--pitch', float(np.degrees(facts['camera_pitch_rad']))]
    words += ['--param', f'Grid/CellSize={RTABMAP_CELL_M}', '--param', 'Grid/RayTracing=true']
    if PUBLISHED[name].range_m:
        words += ['--param', f'Grid/RangeMax={PUBLISHED[name].range_m:g}']
    said, _, _ = run_program(words)
    grid = load_map(stem.with_suffix('.yaml'))
    row, _, _ = scored_row(grid, truth, name, RAYS, folder / 'rtabmap_scored')
    return dataclasses.replace(
        row,
        keyframes=nodes,
        update_s=(_figure(said, 'median_ms') + _figure(said, 'assemble_median_ms')) / 1000,
        path_error_m=score_trajectory(match_files(path, recording / 'poses.txt')).ate_rmse_m,
        cpu_s=cpu_s,
        peak_mb=peak_mb,
    )


def _figure(said: str, name: str) -> float:
    found = re.search(rf'\b{name} ([-\d.]+)', said)
    if found is None:
        raise SegfloorError(f'RTAB-Map did not say {name}: {said[-300:]}')
    return float(found[1])


def as_document(
    results: Sequence[SceneResult],
    rows: Sequence[Row],
    paths: Sequence[PathRow] = (),
    slam: Sequence[SlamRow] = (),
) -> dict[str, Any]:
    """Return the figures of all scenes as plain numbers for a JSON file."""
    return {
        'version': JSON_VERSION,
        'segfloor_ros': __version__,
        'date': datetime.date.today().isoformat(),
        'machine': machine(),
        'published_source': SOURCE,
        'rows': [dataclasses.asdict(row) for row in rows],
        'published': [
            dataclasses.asdict(row) for scene in PUBLISHED.values() for row in scene.rows
        ],
        'paths': [dataclasses.asdict(row) for row in paths],
        'slam': [dataclasses.asdict(row) for row in slam],
        'workloads': [dataclasses.asdict(result.workload) for result in results],
    }


def keep(*rows: Row | PathRow | SlamRow, source: str) -> None:
    """Put rows into docs/published.json, in place of those of the same scenes and systems. source:
    when and from which state of the code they were measured.
    """
    kept = read_json(KEPT, 'figures') if KEPT.is_file() else {}
    document: dict[str, Any] = {}
    for kind, of, place in KINDS:
        new = [_rounded(row) | {'source': source} for row in rows if isinstance(row, of)]
        found = [*kept.get(kind, []), *new]
        document[kind] = [*{(one[place], one['system']): one for one in found}.values()]
    KEPT.write_text(json.dumps(document, indent=1) + '\n', encoding='utf-8')


def _rounded(row: Row | PathRow | SlamRow) -> dict[str, Any]:
    values: dict[str, Any] = dataclasses.asdict(row)
    return {k: round(v, 4) if isinstance(v, float) else v for k, v in values.items()}


def today_and_commit() -> str:
    """Return the date and the commit of the code, by which kept figures name their source."""
    command = ['git', '-C', str(KEPT.parent), 'rev-parse', '--short', 'HEAD']
    commit = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    return f'{datetime.date.today().isoformat()}, {commit or __version__}'


def published_table(rows: Sequence[Row]) -> Table:
    """Return the rows measured here above the published ones, scene by scene."""
    table = figure_table(*HEADS)
    for name in dict.fromkeys(row.scene for row in rows):
        table.add_row(f'[bold]{name}')
        own = [row for row in rows if row.scene == name]
        for row in (*own, *PUBLISHED[name].rows):
            table.add_row(f'  {row.system}', *cells_of(row))
        table.add_section()
    table.caption = (
        f'precision and recall of road maps after an opening, without specks; published: {SOURCE}; '
        'here: scenes rendered after its descriptions'
    )
    return table


def path_table(rows: Sequence[PathRow]) -> Table:
    """Return the paths measured here above the published ones."""
    table = figure_table(*published_paths.HEADS)
    for row in published_paths.all_rows(rows):
        table.add_row(*published_paths.words_of(row))
    table.caption = f'published: {published_paths.SOURCE}; see tools/published_paths.py'
    return table


def slam_rich(rows: Sequence[SlamRow]) -> Table:
    """Return the paths of other programs next to ours, drive by drive."""
    heads, *lines = slam_cells(rows)
    table = figure_table(*heads)
    for cells in lines:
        table.add_row(*cells)
    return table


def benchmark_published(
    scenes: Annotated[
        str, typer.Option(help='Which of the published scenes and drives.')
    ] = ','.join(SCENES),
    workdir: Annotated[
        Optional[Path],  # noqa: UP045  typer evaluates it, also on Python 3.10
        typer.Option(help='Keep renderings, maps and overlays here; what is there is used again.'),
    ] = None,
    peers: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help='Folder of runners of other programs, to run over the same scenes.'),
    ] = None,
    recordings: Annotated[
        Optional[list[Path]],  # noqa: UP045
        typer.Option('--recording', help='Compare paths with the others here too; repeatable.'),
    ] = None,
    is_kept: Annotated[
        bool, typer.Option('--keep', help='Write docs/published.json, for docs/benchmarks.md.')
    ] = False,
    threads: Annotated[
        int, typer.Option(min=1, help='Threads of OpenCV; one compares machines best.')
    ] = 1,
    as_json: options.Json = False,
    params: options.Params = None,
    assignments: options.Set = None,
) -> None:
    """Simulate, map and score the scenes of the published evaluation."""
    names, rows, paths, slam = parse_scenes(scenes, SCENES), [], [], []
    results: list[SceneResult] = []
    source = today_and_commit()
    with tempfile.TemporaryDirectory(prefix='segfloor-') as temporary, announcing() as announce:
        base = workdir or Path(temporary)
        for name in (name for name in names if name in published_paths.DRIVES):
            paths += published_paths.run_drive(name, base / name, announce)
        for name in (name for name in names if name in PUBLISHED):
            scene, folder = published_scene(name), base / name
            for system, own in MODES.items():
                given = [*own, *(assignments or ())]
                if system == AS_PUBLISHED and PUBLISHED[name].range_m:
                    given.insert(0, f'occupancy_grid.max_range_m={PUBLISHED[name].range_m:g}')
                configuration = resolve(params, given)
                result = run_scene(name, scene, folder, configuration, threads, announce, system)
                results.append(result)
                rows.append(result.row)
            if peers is not None and (peers / 'bin' / 'rtabgrid').is_file():
                rows.append(run_rtabmap(peers / 'bin' / 'rtabgrid', name, folder, announce))
            if peers is not None:
                slam += run_peers(name, folder / 'recording', peers, folder / 'paths', announce)
        for recording in recordings or ():
            if peers is not None:
                out = base / recording.name / 'paths'
                slam += run_peers(recording.name, recording, peers, out, announce)
        if is_kept:
            keep(*rows, *paths, *slam, source=source)
    if rows:
        console.print(stage_table([result.workload for result in results]))
        console.print(workload_table([result.workload for result in results]))
        console.print(published_table(rows))
    if paths:
        console.print(path_table(paths))
    if slam:
        console.print(slam_rich(slam))
    if workdir is not None:
        console.print(f'maps on the truth: {workdir}/*/*_overlay.png', highlight=False)
    if as_json:
        options.print_json(as_document(results, rows, paths, slam))


if __name__ == '__main__':
    run_command(benchmark_published)
