"""A short drive through the textured room, written as a recording."""

from pathlib import Path

import cv2
import numpy as np
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.apps.recordings import open_source
from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.core.plugins.assembly import make_pipeline
from segfloor_ros.nodes.configuration import resolve

RATE_HZ = 10.0
KNOWN_MOUNT = [
    word
    for name in ('height_m', 'pitch_rad', 'roll_rad')
    for word in ('--set', f'stereo_slam.camera_{name}={getattr(MOUNT, name)}')
]
"""The mount of the camera as options of a command."""


def room_drive(
    frames: int, step_m: float = 0.06, arc_rad: float = 0.0
) -> tuple[list[StereoFrame], list[np.ndarray]]:
    """Return stereo frames of a straight drive with a slight turn, and T_world_base of each; or
    along a circle, by arc_rad per frame.
    """
    room = StereoRoom(seed=3)
    poses = [planar_pose(step_m * i, 0.0, 0.01 * i) for i in range(frames)]
    if arc_rad:
        turns, radius_m = arc_rad * np.arange(frames), step_m / arc_rad
        poses = [planar_pose(radius_m * np.sin(a), radius_m * (1 - np.cos(a)), a) for a in turns]
    return [room.frame(i, pose, RATE_HZ) for i, pose in enumerate(poses)], poses


def write_kitti(folder: Path, frames: list[StereoFrame]) -> Path:
    """Write frames as a KITTI odometry folder and return it."""
    for camera in (0, 1):
        (folder / f'image_{camera}').mkdir(parents=True)
    for frame in frames:
        cv2.imwrite(str(folder / 'image_0' / f'{frame.index:06d}.png'), frame.left)
        cv2.imwrite(str(folder / 'image_1' / f'{frame.index:06d}.png'), frame.right)
    P = np.hstack([CAMERA.K, np.zeros((3, 1))])
    rows = []
    for name, shift in (('P0', 0.0), ('P1', -CAMERA.disparity_times_depth)):
        P[0, 3] = shift
        rows.append(f'{name}: ' + ' '.join(f'{value:.12e}' for value in P.ravel()))
    (folder / 'calib.txt').write_text('\n'.join(rows) + '\n')
    times = ''.join(f'{frame.stamp_ns * 1e-9:.6f}\n' for frame in frames)
    (folder / 'times.txt').write_text(times)
    return folder


def lockstep_map(recording: Path) -> OccupancyGrid:
    """Return the map of a recording by the pipeline without ROS."""
    configuration = resolve(assignments=[f'stereo_camera.input={recording}'])
    source = open_source(configuration.stereo_camera)
    pipeline = make_pipeline(source.camera, configuration)
    for frame in source.frames():
        pipeline.process(frame)
    grid = pipeline.finish()
    assert grid is not None
    return grid
