"""Where walls lie in maps of simulated drives: outline, and how deep free cells reach behind it.

    python -m tools.walls SCENE=DRIVE…      SCENE as given to `segfloor simulate --out DRIVE`

True poses, the scan alone: what is off is off by the floor. The truth's raster lies anywhere within
a cell of the map's, so the depth is measured at cells' centres, on the scene itself at 1 cm.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
import yaml
from numpy.typing import NDArray

from segfloor_ros.apps.evaluation.map_score import compare, score_cells
from segfloor_ros.apps.evaluation.maps import MapTruth, from_frame, load_truth
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.solids import floors, obstacles, true_map
from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import KeyframeFeatures, LabelledPoints, Mount
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.geometry import invert, planar
from segfloor_ros.core.grid.keyframe_evidence import gather_evidence
from segfloor_ros.core.grid.mapper import EvidenceFolder, EvidenceHistory
from segfloor_ros.core.grid.occupancy import FREE, OccupancyGrid, render
from segfloor_ros.nodes.configuration import resolve
from tools.ablation import print_row
from tools.mechanisms import FLOOR, GRID, NOTHING

FINE_M = 0.01
_IDS, _ROWS = np.zeros(0, np.int32), np.zeros((0, 3), np.float32)
NO_POINTS = LabelledPoints(_IDS, _ROWS, np.zeros(0, np.uint8), np.zeros(0, np.float32))
NO_FEATURES = KeyframeFeatures(_ROWS[:, :2], _IDS, _ROWS)


def map_by_truth(drive: Path, every: int, configuration: Configuration) -> OccupancyGrid:
    """Return the map of one in `every` frames of a drive, by its true poses and mount."""
    facts = yaml.safe_load((drive / 'scene.yaml').read_text())
    names = ('height_m', 'pitch_rad', 'roll_rad', 'forward_m')
    mount = Mount(*(facts[f'camera_{name}'] for name in names))
    settings = resolve(None, (), stereo_camera={'input': str(drive)}).stereo_camera
    source = open_source(settings)
    T_map_base = mount.T_base_left @ read_trajectory(drive / 'poses.txt')[1]
    T_map_base = T_map_base @ invert(mount.T_base_left)
    floor = FloorSegmentation(source.camera, configuration.floor_segmentation)
    history = EvidenceHistory(EvidenceFolder(configuration.occupancy_grid))
    for frame in source.frames():
        if frame.index % every == 0:
            T = T_map_base[frame.index]
            scan = floor.process(frame.left, frame.right, mount, T).scan
            grid = configuration.occupancy_grid
            evidence = gather_evidence(NO_POINTS, NO_FEATURES, T, scan, grid)
            history.extend([evidence], planar(T)[None])
    return render(history.raster(), history.poses[:, :2], configuration.occupancy_grid)


def fine_truth(scene: str, drive: Path) -> MapTruth:
    """Return the true map of a scene, in cells of 1 cm, and where the drive begins in it."""
    truth = load_truth(drive)
    made = dataclasses.replace(open_scene(scene), resolution_m=FINE_M)
    start = np.array(truth.start[:2])
    grid = true_map(made, obstacles(made), floors(made), start)
    return dataclasses.replace(truth, grid=grid)


def depth_m(grid: OccupancyGrid, truth: MapTruth) -> NDArray[np.float64]:
    """Return how far the centres of the free cells (N,) lie from the nearest true floor."""
    far_m = truth.grid.away_m(truth.grid.states == FREE)
    free = grid.centres_of(np.argwhere(grid.states == FREE))
    row, column = truth.grid.cells_of(from_frame(free, truth.start)).T
    height, width = far_m.shape
    found = far_m[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return found.astype(np.float64)


def main(
    drives: Annotated[list[str], typer.Argument(help='SCENE=DRIVE, as rendered.')],
    every: Annotated[int, typer.Option(help='Use one frame in so many.')] = 1,
    only: Annotated[list[str] | None, typer.Option(help='Leave these out, one by one.')] = None,
) -> None:
    """Print precision and recall of free cells and the share of the outline that is marked, in
    percent; the share of free cells whose centre is true floor; how deep the deepest lies, in m.
    """
    configuration = resolve()
    for one in drives:
        scene, _, folder = one.partition('=')
        drive = Path(folder)
        coarse, fine = load_truth(drive), fine_truth(scene, drive)
        for name in (NOTHING, *(only or ())):
            with {**GRID, **FLOOR}[name].left_out():
                grid = map_by_truth(drive, every, configuration)
            cells = score_cells(compare(grid, coarse))
            depth = depth_m(grid, fine)
            shares = (cells.free_precision, cells.free_recall, cells.occupied_recall)
            figures = [100 * share for share in (*shares, float((depth < FINE_M / 2).mean()))]
            print_row(drive.name, name, *figures, float(depth.max()))


if __name__ == '__main__':
    typer.run(main)
