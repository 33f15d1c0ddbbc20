"""The scenes of the published evaluation, mapped and scored here, beside the published figures."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import cv2

from segfloor_ros import __version__
from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.camera.sources import open_source
from segfloor_ros.configuration import Configuration
from segfloor_ros.errors import MapError
from segfloor_ros.evaluation.benchmark import JSON_VERSION, Announce, machine
from segfloor_ros.evaluation.benchmark_apart import Progress, run_apart
from segfloor_ros.evaluation.benchmark_chain import ImageChain
from segfloor_ros.evaluation.benchmark_figures import Workload
from segfloor_ros.evaluation.benchmark_published import PUBLISHED, SOURCE, PublishedScene
from segfloor_ros.evaluation.benchmark_reference import ReferenceWorkload
from segfloor_ros.evaluation.benchmark_rendering import render_once
from segfloor_ros.evaluation.map_score import MapScore, compare, score_map
from segfloor_ros.evaluation.overlay import save_overlay
from segfloor_ros.evaluation.prm import RoadMapPlan
from segfloor_ros.evaluation.truth import load_truth
from segfloor_ros.grid.map_file import save_map
from segfloor_ros.grid.occupancy import OccupancyGrid
from segfloor_ros.grid.settings import OccupancyGridSettings
from segfloor_ros.simulation.scene import Scene


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
    render_once(name, scene, recording, folder / 'rendered_from.txt', announce)
    source = open_source(StereoCameraSettings(input=str(recording)))
    report = announce(f'mapping {name}', source.frame_count or 0)
    workload, grid = run_apart(
        map_recording, name, recording, configuration, threads, on_progress=report
    )
    truth = load_truth(recording)
    pose = truth.start_pose or (0.0, 0.0, 0.0)
    save_map(grid, folder / 'map.yaml')
    save_overlay(compare(grid, truth, pose), folder / 'overlay.png')
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
    reference = ReferenceWorkload()
    reference.time()
    settings = dataclasses.replace(configuration.stereo_camera, input=str(recording))
    source = open_source(settings)
    chain = ImageChain(source.camera, configuration)
    for frame in source.frames():
        chain.process(frame)
        on_progress(chain.frames)
    reference.time()
    if chain.grid is None:
        raise MapError(f'{name}: no map came of {chain.frames} frames')
    return chain.workload(name, chain.frames, chain.tracked, reference.median_ms), chain.grid


def as_document(results: list[SceneResult]) -> dict[str, Any]:
    """Return the figures of all scenes as plain numbers for a JSON file."""
    return {
        'version': JSON_VERSION,
        'segfloor_ros': __version__,
        'machine': machine(),
        'published_source': SOURCE,
        'scenes': [dataclasses.asdict(result) for result in results],
    }
