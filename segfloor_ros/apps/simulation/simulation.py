"""The simulation of a drive: images of a stereo camera with everything true about them, rendered by
MuJoCo without a display; and its files: images, calibration, poses, true map and true masks.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import yaml
from numpy.typing import NDArray

from segfloor_ros import __version__
from segfloor_ros.apps.recordings.calibration_files import write_ros_calibration
from segfloor_ros.apps.simulation.camera import (
    Picture,
    depth_reading_mm,
    develop,
    ideal_image,
    moments_s,
    plan_imaging,
    rectified_camera,
)
from segfloor_ros.apps.simulation.motion import (
    Drive,
    ImuReadings,
    RigMotion,
    WheelReadings,
    imu_readings,
    plan_drive,
    smooth_motion,
    wheel_readings,
)
from segfloor_ros.apps.simulation.scene import Scene
from segfloor_ros.apps.simulation.solids import CLASSES, floors, obstacles, true_map
from segfloor_ros.apps.simulation.world import CAMERAS, View, WorldRenderer, build_world
from segfloor_ros.core.errors import InputError, os_errors
from segfloor_ros.core.files.images import png_bytes
from segfloor_ros.core.files.writing import check_target, folder_in_the_making, move_into_place
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.grid.occupancy import OCCUPIED, OccupancyGrid
from segfloor_ros.core.quaternions import quaternion_xyzw
from segfloor_ros.nodes.map_files import save_map

DISPARITY_SCALE = 256
"""Disparity files are 16-bit PNG in units of 1/256 px, as in KITTI's stereo benchmark."""

IMU_COLUMNS = (
    '#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],'
    'a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]'
)


Progress = Callable[[int], None]


@dataclass(frozen=True)
class SimulatedFrame:
    """One pair of images (H, W) uint8 as the cameras deliver them, where the rectified left
    optical frame was (4, 4), and the depth image (H, W) uint16 in mm, where there is a sensor.
    """

    index: int
    time_s: float
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    T_world_left: Array
    depth_mm: NDArray[np.uint16] | None = None


@dataclass(frozen=True)
class FrameTruth:
    """What is true of one frame's rectified left image: floor mask (H, W) uint8, 255 floor;
    depth_m and disparity_px (H, W) float32.
    """

    floor: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    disparity_px: NDArray[np.float32]


@dataclass(frozen=True)
class FrameLabels:
    """What is seen in one frame's rectified left image, (H, W) uint8: labels: numbers of `CLASSES`,
    255 where there is nothing; instances: of people and cars, from 1 on, elsewhere 0.
    """

    labels: NDArray[np.uint8]
    instances: NDArray[np.uint8]


class Motion(Protocol):
    """Where the rectified left optical frame and the movers of a scene are at a time."""

    def T_world_left(self, time_s: float) -> Array:
        """Return the pose (4, 4)."""

    def mover_times_s(self, time_s: float) -> Sequence[float]:
        """Return the time that each mover has come to: less where it had to wait."""


class Simulation:
    """Drives through a scene. Use as a context manager; raises RenderingError where nothing can
    be rendered and InputError for an impossible scene. supersampling: the pictures are
    rendered this many times finer than the camera's pixels. robot: moves in place of the drive.
    labels: `labels` will be asked for.
    """

    def __init__(
        self,
        scene: Scene,
        supersampling: int = 1,
        robot: Motion | None = None,
        labels: bool = False,
    ):
        self.scene, self._finer = scene, supersampling
        self.drive: Drive = plan_drive(scene.path, scene.camera.rate_hz)
        self.camera = rectified_camera(scene.camera)
        self.imaging = plan_imaging(scene)
        if scene.sensors.depth.max_m and not scene.camera.rectified:
            raise InputError('a depth sensor needs a camera without distortion and misalignment')
        solids, ground = obstacles(scene), floors(scene)
        self.motion = RigMotion(scene, self.drive, ground)
        self._moved: Motion = robot or self.motion
        self.true_map: OccupancyGrid = true_map(scene, solids, ground, self.drive.xy_yaw[0, :2])
        if robot is None:
            _check_clear(self.true_map, self.drive)
        width, height = self.imaging.width * supersampling, self.imaging.height * supersampling
        size = max(width, self.camera.width), max(height, self.camera.height)
        world = build_world(scene, *size, by_class=labels)
        self._renderer = WorldRenderer(scene, world)
        focal_px = self.imaging.focal_px * supersampling
        self._pictures = View(self._renderer, width, height, focal_px)
        self._truth = View(self._renderer, self.camera.width, self.camera.height, self.camera.fx)

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, *error: object) -> None:
        self._pictures.close()
        self._truth.close()

    @property
    def frame_count(self) -> int:
        """How many pairs the drive has."""
        return len(self.drive.times_s)

    def frames(self, every: int = 1) -> Iterator[SimulatedFrame]:
        """Yield the pairs in order, or only one of every so many."""
        for index in range(0, self.frame_count, every):
            yield self.frame(index)

    def frame(self, index: int) -> SimulatedFrame:
        """Render one pair."""
        return self.frame_at(index, float(self.drive.times_s[index]))

    def frame_at(self, index: int, time_s: float) -> SimulatedFrame:
        """Render a pair of a time; its noise depends on the number."""
        left, right = (
            develop(self._exposed(side, time_s), self.imaging, self.scene, side, index, time_s)
            for side in range(len(CAMERAS))
        )
        pose = self._moved.T_world_left(time_s)
        return SimulatedFrame(index, time_s, left, right, pose, self._depth_mm(index, time_s))

    def truth(self, index: int) -> FrameTruth:
        """Render what is true of one frame's rectified left image."""
        self._show(float(self.drive.times_s[index]))
        depth_m = self._truth.depth_m(CAMERAS[0])
        disparity_px = np.float32(self.camera.disparity_times_depth) / depth_m
        floor = self._truth.mask(CAMERAS[0], self._renderer.floor_ids)
        return FrameTruth(floor, depth_m, disparity_px)

    def labels(self, index: int) -> FrameLabels:
        """Render what is seen in one frame's rectified left image."""
        self._show(float(self.drive.times_s[index]))
        geoms = self._truth.geoms(CAMERAS[0])
        of_geom, instance_of_geom = self._renderer.labels
        return FrameLabels(of_geom[geoms], instance_of_geom[geoms])

    def wheels(self) -> WheelReadings | None:
        """Return what the wheels tell of the whole drive, where the scene has such."""
        if not self.scene.sensors.wheel_odometry.rate_hz:
            return None
        return wheel_readings(self.scene, smooth_motion(self.motion))

    def imu(self) -> ImuReadings | None:
        """Return what the IMU tells of the whole drive, where the scene has one."""
        if not self.scene.sensors.imu.rate_hz:
            return None
        return imu_readings(self.scene, smooth_motion(self.motion))

    def _show(self, time_s: float) -> None:
        """Let the cameras see what there is at a time."""
        moved = self._moved
        self._renderer.move(moved.T_world_left(time_s), moved.mover_times_s(time_s))

    def _depth_mm(self, index: int, time_s: float) -> NDArray[np.uint16] | None:
        if not self.scene.sensors.depth.max_m:
            return None
        taken_s = time_s - self.scene.sensors.depth.lag_s
        self._show(taken_s)
        true_m, grey = self._truth.depth_m(CAMERAS[0]), self._truth.grey(CAMERAS[0])
        return depth_reading_mm(self.scene, self.camera.fx, true_m, grey, index, time_s)

    def moving_mask(self, index: int) -> NDArray[np.uint8]:
        """Render what moves in one frame's left image: (H, W) uint8, 255 moving."""
        self._show(float(self.drive.times_s[index]))
        moving = self._renderer.moving_geoms(float(self.drive.times_s[index]))
        mask = self._pictures.mask(CAMERAS[0], moving)
        share = ideal_image(mask.astype(np.float32), self.imaging, 0)
        return np.where(share > 127, np.uint8(255), np.uint8(0))

    def _exposed(self, side: int, time_s: float) -> Picture:
        """Return the ideal picture of a camera, each row over its exposure around a time."""
        moments, weights = moments_s(self.scene, side)
        # The picture may be finer than the image, and larger, with the same middle, for the lens.
        rows = np.arange(self.imaging.height * self._finer) // self._finer
        margin, last = (self.imaging.height - len(weights)) // 2, len(weights) - 1
        weights = weights[(rows - margin).clip(0, last)]
        exposed = np.zeros((len(rows), 1), np.float32)
        for moment, weight in zip(time_s + moments, weights.T, strict=True):
            self._show(float(moment))
            exposed = exposed + weight[:, None] * self._pictures.grey(CAMERAS[side])
        return exposed


def _check_clear(grid: OccupancyGrid, drive: Drive) -> None:
    cells = grid.cells_of(drive.xy_yaw[:, :2])
    hits = np.nonzero(grid.cells[tuple(cells.T)] == OCCUPIED)[0]
    if len(hits):
        x, y, _ = drive.xy_yaw[hits[0]]
        raise InputError(f'the path runs into an obstacle at x {x:.2f}, y {y:.2f} m')


RENDERED = 'rendered_from.txt'
"""In a rendered drive of the cache: of what."""

RECORDED = (
    'image_0', 'image_1', 'left', 'right', 'left.yaml', 'right.yaml', 'calib.txt', 'times.txt',
    'poses.txt', 'base_poses.txt', 'scene.yaml', 'map.yaml', 'map.pgm', 'wheel_odometry.txt',
    'imu.csv', 'imu.yaml', 'depth', 'floor', 'disparity', 'labels', 'instances', 'moving', RENDERED,
)  # fmt: skip
"""All that a rendered drive may hold."""


@dataclass(frozen=True)
class RecordingOptions:
    """What to write. floor_every: every how many frames a floor mask, 0 for none. disparity: a true
    disparity with each mask. labels: with each mask, the class of each pixel, and the number of
    each person and car.
    """

    floor_every: int = 10
    disparity: bool = False
    labels: bool = False


def record(
    simulation: Simulation,
    out: Path,
    options: RecordingOptions,
    on_frame: Callable[[int], None] = lambda done: None,
) -> None:
    """Write a drive to a new folder, complete or not at all.

    Rectified images go to image_0/ and image_1/ with calib.txt (KITTI odometry layout), others to
    left/ and right/ with ROS calibrations left.yaml and right.yaml; what wheels, IMU and depth
    camera tell goes beside them. Raises InputError when `out` holds something else already.
    """
    check_target(out, RECORDED)
    with folder_in_the_making(out) as made, os_errors(f'{out}: cannot be written'):
        _record_into(made, simulation, options, on_frame)
        move_into_place(made, out)


def _record_into(
    folder: Path, simulation: Simulation, options: RecordingOptions, on_frame: Callable[[int], None]
) -> None:
    write_truth(folder, simulation)
    _write_calibration(folder, simulation)
    _write_sensors(folder, simulation)
    if options.labels:
        (folder / 'labels').mkdir()
        names = yaml.safe_dump(dict(enumerate(CLASSES)), sort_keys=False)
        (folder / 'labels' / 'classes.yaml').write_text(names)
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
    if options.labels:
        seen = simulation.labels(index)
        _write_png(folder / 'labels' / f'{index:06d}.png', seen.labels)
        _write_png(folder / 'instances' / f'{index:06d}.png', seen.instances)


def _write_poses(path: Path, T_world_left: Array) -> None:
    """Write the left optical frame in the first left optical frame, KITTI rows."""
    relative = invert(T_world_left[0]) @ T_world_left
    np.savetxt(path, relative[:, :3].reshape(-1, 12), fmt='%.9g')


def _write_png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(png_bytes(image))


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
    with (
        Simulation(scene, labels=options.labels) as simulation,
        folder_in_the_making(recording) as made,
    ):
        _record_into(made, simulation, options, on_start(simulation.frame_count))
        (made / RENDERED).write_text(wanted)
        move_into_place(made, recording)
