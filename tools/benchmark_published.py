"""The scenes of the published evaluation, rendered, mapped and scored here, beside the published
figures: `python -m tools.benchmark_published`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
from collections import deque
from pathlib import Path
from typing import Annotated, Any, Optional

import cv2
import typer
from rich.table import Table

from segfloor_ros import __version__
from segfloor_ros.apps.cli import terminal as options
from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.cli.terminal import Announce, announcing, figure_table
from segfloor_ros.apps.evaluation.map_score import (
    MapScore,
    RoadMapPlan,
    RoadMapScore,
    compare,
    overlay_png,
    score_map,
)
from segfloor_ros.apps.evaluation.maps import load_truth
from segfloor_ros.apps.simulation.scene import Scene
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.simulation import render_once
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.errors import MapError
from segfloor_ros.core.grid.occupancy import OccupancyGrid, OccupancyGridSettings
from segfloor_ros.nodes.configuration import resolve
from segfloor_ros.nodes.map_files import save_map
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
    PUBLISHED,
    SOURCE,
    PublishedFigures,
    PublishedScene,
    parse_scenes,
)


@dataclasses.dataclass(frozen=True)
class SceneResult:
    """A scene mapped here: what it cost, how good the map is, what was published, and the side of
    a cell.
    """

    scene: str
    workload: Workload
    score: MapScore
    published: PublishedScene
    cell_m: float


def run_scene(
    name: str,
    scene: Scene,
    folder: Path,
    configuration: Configuration,
    threads: int,
    announce: Announce,
) -> SceneResult:
    """Render a scene into `folder` unless it is there, map it in a process of its own, score the
    map, and leave map.yaml and overlay.png in the folder.

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
    render_once(scene, recording, on_start=lambda count: announce(f'rendering {name}', count))
    frames = open_recording(recording, configuration).frame_count
    report = announce(f'mapping {name}', frames or 0)
    workload, grid = run_in_process(
        map_recording, name, recording, configuration, threads, on_progress=report
    )
    truth = load_truth(recording)
    pose = truth.start
    save_map(grid, folder / 'map.yaml')
    (folder / 'overlay.png').write_bytes(overlay_png(compare(grid, truth, pose)))
    score = score_map(grid, truth, pose, RoadMapPlan(nodes=published.nodes))
    return SceneResult(name, workload, score, published, cell_m)


def with_cells(configuration: Configuration, cell_m: float) -> Configuration:
    """Return the configuration for a map with cells of this size."""
    grid = dataclasses.replace(configuration.occupancy_grid, resolution_m=cell_m)
    return dataclasses.replace(configuration, occupancy_grid=grid)


def map_recording(
    name: str, recording: Path, configuration: Configuration, threads: int, on_progress: Progress
) -> tuple[Workload, OccupancyGrid]:
    """Run all stages over a recording and return what it cost and the map."""
    cv2.setNumThreads(threads)
    source = open_recording(recording, configuration)
    stages = MeasuredStages(source.camera, configuration)
    with contextlib.closing(stages):
        deque(drive(stages, source.frames(), on_progress), maxlen=0)
    if stages.grid is None:
        raise MapError(f'{name}: no map came of {stages.frames} frames')
    return stages.workload(name), stages.grid


def as_document(results: list[SceneResult]) -> dict[str, Any]:
    """Return the figures of all scenes as plain numbers for a JSON file."""
    return {
        'version': JSON_VERSION,
        'segfloor_ros': __version__,
        'machine': machine(),
        'published_source': SOURCE,
        'scenes': [dataclasses.asdict(result) for result in results],
    }


def published_table(results: list[SceneResult]) -> Table:
    """Return the scores of this run and the published ones side by side."""
    table = figure_table('figures', 'precision %', 'recall %', 's/update', 'MB/update')
    for result in results:
        workload, score = result.workload, result.score
        costs = (
            f'{workload.update_s["mean"]:.3f}',
            f'{workload.memory_mb["slope_per_update"]:.3f}',
        )
        cell_cm = 100 * result.cell_m
        table.add_row(f'[bold]{result.scene}, {score.area_m2:.1f} m², {cell_cm:g} cm')
        table.add_row('  here, after opening', *_percent(score.opened), *costs)
        table.add_row('  here, raw', *_percent(score.raw))
        for figures in result.published.figures:
            table.add_row(f'  {figures.method} *', *_published_cells(figures))
        table.add_section()
    table.caption = (
        f'precision and recall of road maps; * {SOURCE}: times and memory are means '
        'over all scenes; here: scenes rendered after its descriptions, floor the drive could see'
    )
    return table


def _published_cells(figures: PublishedFigures) -> tuple[str, ...]:
    return (
        f'{figures.precision_percent:.2f}',
        f'{figures.recall_percent:.2f}',
        f'{figures.update_s:.3f}',
        f'{figures.update_mb:.3f}',
    )


def _percent(score: RoadMapScore) -> tuple[str, str]:
    return f'{100 * score.precision.mean:.2f}', f'{100 * score.recall.mean:.2f}'


def benchmark_published(
    scenes: Annotated[str, typer.Option(help='Which of the published scenes.')] = ','.join(
        PUBLISHED
    ),
    workdir: Annotated[
        Optional[Path],  # noqa: UP045  typer evaluates it, also on Python 3.10
        typer.Option(help='Keep renderings, maps and overlays here; what is there is used again.'),
    ] = None,
    threads: Annotated[
        int, typer.Option(min=1, help='Threads of OpenCV; one compares machines best.')
    ] = 1,
    as_json: options.Json = False,
    params: options.Params = None,
    assignments: options.Set = None,
) -> None:
    """Simulate, map and score the scenes of the published evaluation."""
    configuration, names = resolve(params, assignments or ()), parse_scenes(scenes)
    with tempfile.TemporaryDirectory(prefix='segfloor-') as temporary, announcing() as announce:
        folder = workdir or Path(temporary)
        results = [
            run_scene(name, open_scene(name), folder / name, configuration, threads, announce)
            for name in names
        ]
    console.print(stage_table([result.workload for result in results]))
    console.print(workload_table([result.workload for result in results]))
    console.print(published_table(results))
    if workdir is not None:
        console.print(f'maps on the truth: {workdir}/*/overlay.png', highlight=False)
    if as_json:
        options.print_json(as_document(results))


if __name__ == '__main__':
    run_command(benchmark_published)
