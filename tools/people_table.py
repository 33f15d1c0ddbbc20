"""What people do to path and map: each drive with people beside the same drive without.

    python -m tools.people_scenes SCENES --seeds 3
    python -m tools.people_table SCENES DRIVES        one row for each scene

Drives that are not there yet are rendered into DRIVES, also for the next time.
"""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer

from segfloor_ros.camera.sources import open_source
from segfloor_ros.configuration import resolve
from segfloor_ros.evaluation.map_score import compare, score_map
from segfloor_ros.evaluation.raster import OCCUPIED, cell_centres, states
from segfloor_ros.evaluation.trajectory import match_files, score_trajectory
from segfloor_ros.evaluation.trajectory_files import read_table
from segfloor_ros.evaluation.truth import load_truth, read_map
from segfloor_ros.lockstep import LockstepRun
from segfloor_ros.results_folder import OutputFolder
from segfloor_ros.simulation.any_scene import open_scene
from segfloor_ros.simulation.movers import place
from segfloor_ros.simulation.render_once import render_once
from segfloor_ros.simulation.scene import Scene

SEEN_AGAIN_S = 10.0
REACH_M = 0.5
"""From the middle of a person to the end of a stride or an arm."""

STANDS_M = 0.2
"""What is no farther from something that stands is its outline."""


@dataclass(frozen=True)
class Outcome:
    """One run. ghosts: occupied cells where nothing stands and nobody was in the last seconds."""

    frames: int
    tracked: int
    path_rmse_m: float
    precision: float
    recall: float
    ghosts: int
    moving_ms: float

    def columns(self) -> str:
        """Return the cells of a row of a table."""
        return (
            f'{self.tracked}/{self.frames} | {self.path_rmse_m:.4f} | {100 * self.precision:.1f} '
            f'| {100 * self.recall:.1f} | {self.ghosts} | {self.moving_ms:.1f}'
        )


def measure(scene: Scene, drive: Path, assignments: list[str]) -> Outcome:
    """Run a drive through all stages and score it."""
    configuration = resolve(None, assignments, stereo_camera={'input': str(drive)})
    source = open_source(configuration.stereo_camera)
    with tempfile.TemporaryDirectory() as name:
        results = Path(name) / 'results'
        with OutputFolder(results) as folder:
            result = LockstepRun(source, configuration, folder).execute(lambda done, state: None)
            folder.write(result)
        path = score_trajectory(match_files(results, drive))
        estimate, truth = read_map(results / 'map.yaml'), load_truth(drive)
        alignment = truth.start_pose or (0.0, 0.0, 0.0)
        score = score_map(estimate, truth, alignment)
        occupied = compare(estimate, truth, alignment).estimate == OCCUPIED
    summary = result.summary
    search = summary.stages.get('moving', {'count': 0, 'mean_ms': 0.0})
    return Outcome(
        summary.frames,
        summary.tracked_frames,
        path.ate_rmse_m,
        score.raw.precision.mean,
        score.raw.recall.mean,
        int((occupied & _could_be_ghosts(scene, drive)).sum()),
        search['count'] * search['mean_ms'] / summary.frames,
    )


def _could_be_ghosts(scene: Scene, drive: Path) -> np.ndarray:
    """Return the cells of the truth (rows, columns) where nothing stands and nobody was lately."""
    truth = load_truth(drive).grid
    free = (states(truth) != OCCUPIED).astype(np.uint8)
    away_m = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * truth.resolution_m
    clear = away_m > STANDS_M
    end_s = float(read_table(drive / 'base_poses.txt')[-1, 0])
    x, y = cell_centres(truth).reshape(*clear.shape, 2).transpose(2, 0, 1)
    for mover in scene.people:
        for time_s in np.arange(max(0.0, end_s - SEEN_AGAIN_S), end_s, 0.2):
            at_x, at_y, _ = place(mover, float(time_s))
            clear &= np.hypot(x - at_x, y - at_y) > REACH_M
    return clear


def main(
    scenes: Path,
    drives: Path,
    assignments: Annotated[
        list[str] | None, typer.Option('--set', help='One parameter; repeatable.')
    ] = None,
    only: Annotated[str, typer.Option(help='Pattern of the scenes.')] = '*',
    empty: Annotated[bool, typer.Option(help='Also the drives without people.')] = True,
) -> None:
    """Print a row for each scene, with people and without."""
    print('scene | tracked | path, m | precision | recall | ghosts | search, ms a frame')
    for file in sorted(scenes.glob(f'{only}.yaml')):
        scene = open_scene(str(file))
        for name, one in (
            (file.stem, scene),
            (f'{file.stem}_empty', dataclasses.replace(scene, people=())),
        ):
            if one.people or empty:
                if not (drives / name / 'times.txt').is_file():
                    render_once(one, drives / name)
                outcome = measure(one, drives / name, assignments or [])
                print(f'{name} | {outcome.columns()}', flush=True)


if __name__ == '__main__':
    typer.run(main)
