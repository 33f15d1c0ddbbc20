"""The files of a simulated drive: images, calibration, poses, true map and true masks."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml

from segfloor_ros import __version__
from segfloor_ros.camera.calibration.files import write_ros_calibration
from segfloor_ros.errors import InputError, os_errors
from segfloor_ros.files.results import RENDERED, folder_in_the_making, move_into_place
from segfloor_ros.geometry import Array, invert, quaternion_xyzw
from segfloor_ros.grid.map_file import save_map
from segfloor_ros.simulation.scene import Scene
from segfloor_ros.simulation.simulation import SimulatedFrame, Simulation

DISPARITY_SCALE = 256
"""Disparity files are 16-bit PNG in units of 1/256 px, as in KITTI's stereo benchmark."""

IMU_COLUMNS = (
    '#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],'
    'a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]'
)

PNG_SPEED = [cv2.IMWRITE_PNG_COMPRESSION, 3]

Progress = Callable[[int], None]


@dataclass(frozen=True)
class RecordingOptions:
    """What to write. floor_every: every how many frames a floor mask, 0 for none. disparity: a true
    disparity with each mask.
    """

    floor_every: int = 10
    disparity: bool = False


def record(
    simulation: Simulation,
    out: Path,
    options: RecordingOptions,
    on_frame: Callable[[int], None] = lambda done: None,
) -> None:
    """Write a drive to a new folder, complete or not at all.

    Rectified images go to image_0/ and image_1/ with calib.txt (KITTI odometry layout), others to
    left/ and right/ with ROS calibrations left.yaml and right.yaml; what wheels, IMU and depth
    camera tell goes beside them. Raises InputError when `out` holds something already.
    """
    if out.is_symlink() or (out.exists() and (not out.is_dir() or any(out.iterdir()))):
        raise InputError(f'{out}: exists already; choose another --out or remove it')
    with folder_in_the_making(out) as made, os_errors(f'{out}: cannot be written'):
        _record_into(made, simulation, options, on_frame)
        move_into_place(made, out)


def _record_into(
    folder: Path, simulation: Simulation, options: RecordingOptions, on_frame: Callable[[int], None]
) -> None:
    write_truth(folder, simulation)
    _write_calibration(folder, simulation)
    _write_sensors(folder, simulation)
    poses = []
    for frame in simulation.frames():
        _write_images(folder, frame, simulation.scene.camera.rectified)
        if options.floor_every and frame.index % options.floor_every == 0:
            _write_frame_truth(folder, simulation, frame.index, options)
        if simulation.scene.movers:
            moving = simulation.moving_mask(frame.index)
            _write_png(folder / 'moving' / f'{frame.index:06d}.png', moving)
        poses.append(frame.T_world_left)
        on_frame(frame.index + 1)
    _write_poses(folder / 'poses.txt', np.array(poses))


def write_truth(folder: Path, simulation: Simulation) -> None:
    """Write map, scene.yaml, base_poses.txt and times.txt."""
    scene, rig, drive = simulation.scene, simulation.scene.camera, simulation.drive
    save_map(simulation.true_map, folder / 'map.yaml')
    times = drive.times_s
    np.savetxt(folder / 'times.txt', times, fmt='%.6f')
    np.savetxt(folder / 'base_poses.txt', np.column_stack([times, drive.xy_yaw]), fmt='%.6f')
    facts = {
        'description': ' '.join(scene.description.split()),
        'seed': scene.seed,
        'frames': simulation.frame_count,
        'path_m': drive.length_m,
        'rate_hz': rig.rate_hz,
        'fov_x_deg': rig.fov_x_deg,
        'baseline_m': rig.baseline_m,
        'camera_height_m': rig.height_m,
        'camera_pitch_rad': float(np.radians(rig.pitch_deg)),
        'camera_roll_rad': float(np.radians(rig.roll_deg)),
        'camera_forward_m': rig.forward_m,
        'rectified': rig.rectified,
        'start_pose_world': [float(value) for value in drive.xy_yaw[0]],
    }
    (folder / 'scene.yaml').write_text(yaml.safe_dump(facts, sort_keys=False))


def _write_calibration(folder: Path, simulation: Simulation) -> None:
    left, right = simulation.imaging.raw
    if simulation.scene.camera.rectified:
        rows = [f'P{i}: ' + ' '.join(f'{v:.12g}' for v in side.P.ravel() + 0.0)
                for i, side in enumerate((left, right))]  # fmt: skip
        (folder / 'calib.txt').write_text('\n'.join(rows) + '\n')
        return
    for name, side in (('left', left), ('right', right)):
        write_ros_calibration(folder / f'{name}.yaml', side, name)


def _write_sensors(folder: Path, simulation: Simulation) -> None:
    """Write wheel_odometry.txt (TUM), imu.csv (the columns of EuRoC's data.csv) and, of an IMU that
    is not where the camera is, imu.yaml.
    """
    wheels, imu = simulation.wheels(), simulation.imu()
    if wheels is not None:
        turns = np.stack([quaternion_xyzw(T[:3, :3]) for T in wheels.T_odom_base])
        table = np.column_stack([wheels.times_s, wheels.T_odom_base[:, :3, 3], turns])
        np.savetxt(folder / 'wheel_odometry.txt', table, fmt='%.6f' + ' %.9f' * 7)
    if imu is not None:
        rows = (
            f'{round(t * 1e9)},' + ','.join(f'{v:.9g}' for v in (*gyro, *accel))
            for t, gyro, accel in zip(imu.times_s, imu.gyro_rad_s, imu.accel_m_s2, strict=True)
        )
        (folder / 'imu.csv').write_text('\n'.join([IMU_COLUMNS, *rows]) + '\n')
        if imu.T_left_imu[:3, 3].any():
            values = imu.T_left_imu.ravel().tolist()
            matrix = {'T_BS': {'rows': 4, 'cols': 4, 'data': values}}
            (folder / 'imu.yaml').write_text(yaml.safe_dump(matrix))


def _write_images(folder: Path, frame: SimulatedFrame, rectified: bool) -> None:
    names = ('image_0', 'image_1') if rectified else ('left', 'right')
    for name, image in zip(names, (frame.left, frame.right), strict=True):
        _write_png(folder / name / f'{frame.index:06d}.png', image)
    if frame.depth_mm is not None:
        _write_png(folder / 'depth' / f'{frame.index:06d}.png', frame.depth_mm)


def _write_frame_truth(
    folder: Path, simulation: Simulation, index: int, options: RecordingOptions
) -> None:
    truth = simulation.truth(index)
    _write_png(folder / 'floor' / f'{index:06d}.png', truth.floor)
    if options.disparity:
        scaled = np.clip(np.round(truth.disparity_px * DISPARITY_SCALE), 0, 65535)
        _write_png(folder / 'disparity' / f'{index:06d}.png', scaled.astype(np.uint16))


def _write_poses(path: Path, T_world_left: Array) -> None:
    """Write the left optical frame in the first left optical frame, KITTI rows."""
    relative = invert(T_world_left[0]) @ T_world_left
    np.savetxt(path, relative[:, :3].reshape(-1, 12), fmt='%.9g')


def _write_png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(cv2.imencode('.png', image, PNG_SPEED)[1].tobytes())


def render_once(
    scene: Scene,
    recording: Path,
    options: RecordingOptions = RecordingOptions(floor_every=0),
    on_start: Callable[[int], Progress] = lambda total: lambda done: None,
) -> None:
    """Render a drive into the folder `recording`, unless it holds this drive already.

    on_start: told the number of frames; returns whom to tell how many are done. Raises
    RenderingError where nothing can be rendered.
    """
    stamp = recording / RENDERED
    wanted = hashlib.sha256(repr((__version__, scene, options)).encode()).hexdigest() + '\n'
    if stamp.is_file() and stamp.read_text() == wanted:
        return
    with Simulation(scene) as simulation, folder_in_the_making(recording) as made:
        _record_into(made, simulation, options, on_start(simulation.frame_count))
        (made / RENDERED).write_text(wanted)
        move_into_place(made, recording)
