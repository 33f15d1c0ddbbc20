"""Ground truth of a map: a map file alone, or the folder of a simulated scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from segfloor_ros.errors import InputError
from segfloor_ros.files.tables import read_table
from segfloor_ros.files.yaml_files import read_yaml
from segfloor_ros.geometry import Array
from segfloor_ros.grid.map_file import OccupancyGrid, load_map
from segfloor_ros.trajectory import read_trajectory

Pose2d = tuple[float, float, float]
"""x and y in metres, yaw in radians."""

DEFAULT_FOV_RAD = np.pi / 2


@dataclass(frozen=True)
class MapTruth:
    """A true map. start_pose: where the frame `map` of an estimate lies in the truth's frame,
    None where nobody said. base_poses: (N, 3) x, y, yaw of the robot in the truth's frame, None
    where the drive is unknown. fov_rad: horizontal field of view of the camera.
    """

    grid: OccupancyGrid
    start_pose: Pose2d | None = None
    base_poses: Array | None = None
    fov_rad: float = float(DEFAULT_FOV_RAD)

    @property
    def start(self) -> Pose2d:
        """Where the drive starts; the truth's own origin where nobody said."""
        return self.start_pose or (0.0, 0.0, 0.0)


def load_truth(path: Path) -> MapTruth:
    """Read a true map from a map YAML, or with poses from a scene folder (map.yaml, scene.yaml,
    base_poses.txt). Raises InputError naming the file.
    """
    if not path.is_dir():
        return MapTruth(load_map(path))
    grid = load_map(path / 'map.yaml')
    scene_file = path / 'scene.yaml'
    if not scene_file.is_file():
        return MapTruth(grid)
    start_pose, fov_rad = _read_scene(scene_file)
    poses_file = path / 'base_poses.txt'
    poses = read_base_poses(poses_file) if poses_file.is_file() else None
    return MapTruth(grid, start_pose, poses, fov_rad)


def read_base_poses(path: Path) -> Array:
    """Return poses (N, 3) = x, y, yaw from rows `t x y yaw` or from a TUM file of the base."""
    table = read_table(path)
    if table.shape[1] == 4:
        return table[:, 1:]
    _, poses = read_trajectory(path)
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    return np.column_stack([poses[:, 0, 3], poses[:, 1, 3], yaw])


def _read_scene(path: Path) -> tuple[Pose2d, float]:
    scene = read_yaml(path, 'names and values')
    try:
        x, y, yaw = (float(value) for value in scene['start_pose_world'])
        fov_rad = float(np.radians(scene['fov_x_deg']))
    except (KeyError, TypeError, ValueError):
        raise InputError(f'{path}: expected start_pose_world (x, y, yaw) and fov_x_deg') from None
    return (x, y, yaw), fov_rad
