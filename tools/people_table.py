"""What people do to path and map: each drive with people beside the same drive without.

Recall counts twice: over the floor that the drive without people shows, and over what of it was in
sight with people there, since somebody last stood on it. Ghosts are occupied cells where nothing
stands, and which came into sight again 10 s or more before the end.

    python -m tools.people_scenes SCENES --seeds 3
    python -m tools.people_table SCENES DRIVES RESULTS        one row for each scene

What is not there yet is rendered into DRIVES and mapped into RESULTS, also for the next time.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from segfloor_ros.apps.evaluation.map_score import (
    DEFAULT_RANGE_M,
    RoadMapPlan,
    compare,
    score_map,
    score_road_maps,
)
from segfloor_ros.apps.evaluation.maps import MapTruth, Mask, load_truth, observable
from segfloor_ros.apps.evaluation.trajectory import match_files, score_trajectory
from segfloor_ros.apps.lockstep import LockstepRun
from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.results_folder import OutputFolder
from segfloor_ros.apps.simulation.scene import Scene
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.simulation import render_once
from segfloor_ros.apps.simulation.solids import place
from segfloor_ros.core.files.whole import read_table
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED
from segfloor_ros.nodes.configuration import resolve

SEEN_AGAIN_S = 10.0
ENOUGH_S = 1.0
"""Floor was in sight that was so for this long in all."""

STEP_S = 0.2
BODY_M = 0.5
"""From the middle of a person to the end of a stride, also where somebody stops in one."""

STANDS_M = 0.2
"""What is no farther from something that stands is its outline."""


@dataclass(frozen=True)
class Outcome:
    """One run. seen_recall: of the floor in sight with people there. ghosts: occupied cells."""

    frames: int
    tracked: int
    path_rmse_m: float
    precision: float
    recall: float
    seen_recall: float
    ghosts: int
    moving_ms: float

    def columns(self) -> str:
        """Return the cells of a row of a table."""
        return (
            f'{self.tracked}/{self.frames} | {self.path_rmse_m:.4f} | {100 * self.precision:.1f} '
            f'| {100 * self.recall:.1f} | {100 * self.seen_recall:.1f} | {self.ghosts} '
            f'| {self.moving_ms:.1f}'
        )


def run(drive: Path, results: Path, assignments: list[str]) -> None:
    """Run a drive through all stages."""
    configuration = resolve(None, assignments, stereo_camera={'input': str(drive)})
    source = open_source(configuration.stereo_camera)
    with OutputFolder(results) as folder:
        result = LockstepRun(source, configuration, folder).execute(lambda done, state: None)
        folder.write(result)


def measure(scene: Scene, drive: Path, results: Path) -> Outcome:
    """Score what came of a drive."""
    path = score_trajectory(match_files(results, drive))
    estimate, truth = load_map(results / 'map.yaml'), load_truth(drive)
    alignment = truth.start
    score, maps = score_map(estimate, truth, alignment), compare(estimate, truth, alignment)
    in_sight, long_ago = _seen_again(scene, truth, _stamped_poses(drive))
    of_seen = score_road_maps(
        maps.estimate == FREE,
        maps.truth == FREE,
        maps.wanted_floor & in_sight,
        maps.resolution_m,
        RoadMapPlan(),
    )
    ghosts = (maps.estimate == OCCUPIED) & long_ago & _away_from_what_stands(truth)
    summary = json.loads((results / 'summary.json').read_text())
    search = summary['stages'].get('moving', {'count': 0, 'mean_ms': 0.0})
    return Outcome(
        summary['frames'],
        summary['tracked_frames'],
        path.ate_rmse_m,
        score.raw.precision.mean,
        score.raw.recall.mean,
        of_seen.recall.mean,
        int(ghosts.sum()),
        search['count'] * search['mean_ms'] / summary['frames'],
    )


def _stamped_poses(drive: Path) -> Array:
    """Return stamp in seconds, x, y and yaw (N, 4) of the base, one for each step of time."""
    poses = read_table(drive / 'base_poses.txt')[:, :4]
    return poses[:: max(1, round(STEP_S / float(np.diff(poses[:, 0]).mean())))]


def _seen_again(scene: Scene, truth: MapTruth, poses: Array) -> tuple[Mask, Mask]:
    """Return the cells (rows, columns) that were in sight since somebody last stood there, and
    those that came into sight then some time before the end.
    """
    grid = truth.grid
    centres = grid.centres_of(grid.all_cells)
    seen_s, since_s = np.zeros(len(centres)), np.full(len(centres), np.inf)
    for time_s, *pose in poses:
        people = np.array([place(mover, float(time_s))[:2] for mover in scene.people])
        taken = np.zeros(len(centres), bool)
        for at in people:
            taken |= np.hypot(*(centres - at).T) < BODY_M
        seen_s[taken], since_s[taken] = 0.0, np.inf
        cells = np.where(taken.reshape(grid.cells.shape), np.int8(100), grid.cells)
        now = dataclasses.replace(grid, cells=cells)
        seen = observable(now, np.array([pose]), truth.fov_rad, DEFAULT_RANGE_M)[0].ravel()
        seen_s[seen] += STEP_S
        since_s[seen] = np.minimum(since_s[seen], time_s)
    shape = grid.cells.shape
    enough = seen_s >= ENOUGH_S
    long_ago = enough & (since_s <= poses[-1, 0] - SEEN_AGAIN_S)
    return enough.reshape(shape), long_ago.reshape(shape)


def _away_from_what_stands(truth: MapTruth) -> Mask:
    """Return the cells (rows, columns) that are not the outline of something."""
    return np.asarray(truth.grid.away_m(truth.grid.states == OCCUPIED) > STANDS_M)


def main(
    scenes: Path,
    drives: Path,
    results: Path,
    assignments: Annotated[
        list[str] | None, typer.Option('--set', help='One parameter; repeatable.')
    ] = None,
    only: Annotated[str, typer.Option(help='Pattern of the scenes.')] = '*',
    empty: Annotated[bool, typer.Option(help='Also the drives without people.')] = True,
) -> None:
    """Print a row for each scene, with people and without."""
    print(
        'scene | tracked | path, m | precision | recall | of the seen | ghosts | search, ms a frame'
    )
    for file in sorted(scenes.glob(f'{only}.yaml')):
        scene = open_scene(str(file))
        for name, one in (
            (file.stem, scene),
            (f'{file.stem}_empty', dataclasses.replace(scene, people=())),
        ):
            if one.people or empty:
                if not (drives / name / 'times.txt').is_file():
                    render_once(one, drives / name)
                if not (results / name / 'map.yaml').is_file():
                    run(drives / name, results / name, assignments or [])
                outcome = measure(one, drives / name, results / name)
                print(f'{name} | {outcome.columns()}', flush=True)


if __name__ == '__main__':
    typer.run(main)
