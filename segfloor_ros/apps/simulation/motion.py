"""Where base and camera are at any time of the drive, a smooth path through waypoints driven at a
believable speed, and what simulated wheels and an IMU measure of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from segfloor_ros.apps.simulation.scene import Route, Scene, Vibration, Wheels
from segfloor_ros.apps.simulation.solids import Prism, floor_height_m
from segfloor_ros.core.contracts import Mount
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import Array, make_transform

STEP_M = 0.0025
MIN_SPEED_M_S = 0.02
LONGEST_M, MOST_FRAMES = 1e5, 10**6
"""Of a drive: a day of a robot."""

GRAVITY_M_S2 = 9.81
SMOOTH_RATE_HZ = 1000.0
ODOMETRY_START = (2.0, -1.0, 0.7)
"""x, y, yaw that the odometry begins with: its frame is none that anyone else knows."""


@dataclass(frozen=True)
class Drive:
    """Where the base is: times (N,) in seconds and x, y, yaw (N, 3), metres and radians, yaw
    without jumps.
    """

    times_s: Array
    xy_yaw: Array

    @property
    def length_m(self) -> float:
        """Length of the path in metres."""
        return float(np.hypot(*np.diff(self.xy_yaw[:, :2], axis=0).T).sum())

    def at(self, times_s: Array) -> Array:
        """Return x, y, yaw (M, 3) at other times by linear interpolation."""
        columns = [np.interp(times_s, self.times_s, column) for column in self.xy_yaw.T]
        return np.stack(columns, axis=1)


def plan_drive(path: Route, rate_hz: float) -> Drive:
    """Return the drive sampled at the camera's rate, from standstill to standstill.

    Raises InputError for fewer than two different waypoints.
    """
    line = smooth_line(path)
    step = np.diff(line, axis=0)
    distance_m = np.concatenate([[0.0], np.cumsum(np.hypot(*step.T))])
    heading = np.arctan2(step[:, 1], step[:, 0])
    yaw = np.unwrap(np.append(heading, heading[-1]))
    times_s = _times(path, distance_m, yaw)
    if times_s[-1] * rate_hz > MOST_FRAMES:
        raise InputError(f'the drive takes {times_s[-1]:.3g} s, which are too many images')
    frame_times_s = np.arange(int(times_s[-1] * rate_hz) + 1) / rate_hz
    dense = Drive(times_s, np.column_stack([line, yaw]))
    return Drive(frame_times_s, dense.at(frame_times_s))


def smooth_line(path: Route) -> Array:
    """Return the way (N, 2) through the waypoints, a point per `STEP_M`, corners rounded by a
    Gaussian of deviation `smoothing_m`, so that its curvature is continuous.
    """
    corners = np.array(path.waypoints, np.float64).reshape(-1, 2)
    lengths = np.hypot(*np.diff(corners, axis=0).T)
    corners = corners[np.concatenate([[True], lengths > 0])] if len(corners) else corners
    if len(corners) < 2:
        raise InputError('a path needs at least two different waypoints')
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    if along[-1] > LONGEST_M:
        raise InputError(f'the path is {along[-1]:.3g} m long, at most {LONGEST_M:g} are driven')
    wanted = np.linspace(0.0, along[-1], max(2, round(along[-1] / STEP_M) + 1))
    line = np.stack([np.interp(wanted, along, column) for column in corners.T], axis=1)
    return _smooth(line, path.smoothing_m / STEP_M)


def _smooth(line: Array, deviation: float) -> Array:
    """Smooth a line, both ends kept in place by continuing it straight beyond them."""
    if deviation <= 0:
        return line
    extra = np.arange(1, int(4 * deviation) + 1)[:, None]
    before = line[0] - extra[::-1] * (line[1] - line[0])
    after = line[-1] + extra * (line[-1] - line[-2])
    smoothed = gaussian_filter1d(np.vstack([before, line, after]), deviation, axis=0)
    inner = smoothed[len(extra) : -len(extra)]
    moves = np.hypot(*np.diff(inner, axis=0).T) > 1e-6
    return inner[np.append(True, moves)]


def _times(path: Route, distance_m: Array, yaw: Array) -> Array:
    """Return when each point of the line is reached: v² ≤ v₀² + 2as from either end and along
    every bend. Where the way turns back the base turns on the spot.
    """
    turn_rate = np.radians(path.turn_rate_deg_s)
    curvature = np.abs(np.gradient(yaw) / np.gradient(distance_m))
    limit = np.minimum(path.speed_m_s, turn_rate / np.maximum(curvature, 1e-6))
    limit[[0, -1]] = 0.0
    gain = 2 * path.acceleration_m_s2 * distance_m
    # The lowest parabola through any earlier (later) limit: a running minimum of v² -+ 2as.
    forward = np.minimum.accumulate(limit**2 - gain) + gain
    backward = np.minimum.accumulate((limit**2 + gain)[::-1])[::-1] - gain
    speed = np.sqrt(np.maximum(np.minimum(forward, backward), MIN_SPEED_M_S**2))
    seconds = np.diff(distance_m) * 2 / (speed[1:] + speed[:-1])
    seconds = np.maximum(seconds, np.abs(np.diff(yaw)) / turn_rate)
    return np.concatenate([[0.0], np.cumsum(seconds)])


@dataclass(frozen=True)
class RigMotion:
    """Where base and camera are. The base follows the floor's height and slope; the camera shakes
    as the scene says.
    """

    scene: Scene
    drive: Drive
    floors: list[Prism]

    def T_world_left(self, time_s: float) -> Array:
        """Return the pose (4, 4) of the rectified left optical frame at a time."""
        rig = self.scene.camera
        roll, pitch, bounce_m = shake(rig.vibration, self.scene.seed, time_s)
        mount = Mount(
            rig.height_m + bounce_m,
            float(np.radians(rig.pitch_deg)) + pitch,
            float(np.radians(rig.roll_deg)) + roll,
            rig.forward_m,
        )
        return self.T_world_base(time_s) @ mount.T_base_left

    def mover_times_s(self, time_s: float) -> list[float]:
        """Return the time of each mover: nobody waits."""
        return [time_s] * len(self.scene.movers)

    def T_world_base(self, time_s: float) -> Array:
        """Return the pose (4, 4) of the base, on the floor, at a time."""
        x, y, yaw = self.drive.at(np.array([time_s]))[0]
        wheels_m = self.scene.sensors.wheel_odometry.track_m  # as far behind one another
        along = np.array([np.cos(yaw), np.sin(yaw)]) * wheels_m / 2
        rear, front = floor_height_m(self.floors, np.array([x, y]) + np.array([-along, along]))
        pitch = -np.arctan2(front - rear, wheels_m)
        rotation = Rotation.from_euler('ZY', [yaw, pitch]).as_matrix()
        return make_transform(rotation, np.array([x, y, (rear + front) / 2]))


def shake(vibration: Vibration, seed: int, time_s: float) -> tuple[float, float, float]:
    """Return roll and pitch in radians and bounce in metres: sums of three random sines each."""
    rng = np.random.default_rng([seed, 3])
    frequency_hz = vibration.frequency_hz * rng.uniform(0.5, 1.5, (3, 3))
    phase = rng.uniform(0, 2 * np.pi, (3, 3))
    wave = np.sin(2 * np.pi * frequency_hz * time_s + phase).sum(axis=1) / 3
    amplitude = [
        np.radians(vibration.roll_deg),
        np.radians(vibration.pitch_deg),
        vibration.bounce_m,
    ]
    roll, pitch, bounce_m = (float(value) for value in wave * amplitude)
    return roll, pitch, bounce_m


@dataclass(frozen=True)
class WheelReadings:
    """Times (N,) in seconds, and what the wheels tell: the base's poses (N, 4, 4) in an odometry
    frame.
    """

    times_s: Array
    T_odom_base: Array


@dataclass(frozen=True)
class ImuReadings:
    """Times (N,) in seconds; gyro_rad_s, accel_m_s2 (N, 3) in the axes of the rectified left
    optical frame, at T_left_imu (4, 4).
    """

    times_s: Array
    gyro_rad_s: Array
    accel_m_s2: Array
    T_left_imu: Array


def smooth_motion(motion: RigMotion) -> RigMotion:
    """Return the same motion, through the same poses at the frames, without jumps of speed."""
    drive = motion.drive
    spline = CubicSpline(drive.times_s, drive.xy_yaw)
    times_s = np.arange(int(drive.times_s[-1] * SMOOTH_RATE_HZ) + 1) / SMOOTH_RATE_HZ
    return RigMotion(motion.scene, Drive(times_s, spline(times_s)), motion.floors)


def wheel_readings(scene: Scene, motion: RigMotion) -> WheelReadings:
    """Return what the wheels of a differential drive tell; motion without jumps of speed."""
    wheels = scene.sensors.wheel_odometry
    times_s = np.arange(int(motion.drive.times_s[-1] * wheels.rate_hz) + 1) / wheels.rate_hz
    true = np.stack([motion.T_world_base(t) for t in times_s])
    R_before = true[:-1, :3, :3]
    forward_m = np.einsum('nij,ni->nj', R_before, np.diff(true[:, :3, 3], axis=0))[:, 0]
    turn_rad = Rotation.from_matrix(
        np.swapaxes(R_before, 1, 2) @ true[1:, :3, :3]
    ).as_rotvec()[:, 2]  # fmt: skip
    half = turn_rad * wheels.track_m / 2
    rng = np.random.default_rng([scene.seed, 5])
    ways_m = [
        way * _slip(wheels, times_s[1:], side) * wheels.scale
        + rng.standard_normal(len(way)) * wheels.noise_m * np.sqrt(np.abs(way))
        for side, way in enumerate((forward_m - half, forward_m + half))
    ]
    forward_m, turn_rad = (ways_m[0] + ways_m[1]) / 2, (ways_m[1] - ways_m[0]) / wheels.track_m
    return WheelReadings(times_s, _dead_reckoning(forward_m, turn_rad))


def _slip(wheels: Wheels, times_s: Array, side: int) -> Array:
    factor = np.ones(len(times_s))
    for start_s, end_s, *factors in wheels.slips:
        factor[(times_s > start_s) & (times_s <= end_s)] = factors[side]
    return factor


def _dead_reckoning(forward_m: Array, turn_rad: Array) -> Array:
    """Return the poses (N + 1, 4, 4) of a base that drives (N,) arcs."""
    x, y, yaw = ODOMETRY_START
    heading = yaw + np.concatenate([[0.0], np.cumsum(turn_rad)])
    middle = heading[:-1] + turn_rad / 2
    poses = np.tile(np.eye(4), (len(heading), 1, 1))
    up = np.array([0.0, 0.0, 1.0])
    poses[:, :3, :3] = Rotation.from_rotvec(heading[:, None] * up).as_matrix()
    poses[:, 0, 3] = x + np.concatenate([[0.0], np.cumsum(forward_m * np.cos(middle))])
    poses[:, 1, 3] = y + np.concatenate([[0.0], np.cumsum(forward_m * np.sin(middle))])
    return poses


def imu_readings(scene: Scene, motion: RigMotion) -> ImuReadings:
    """Return what an IMU tells; motion without jumps of speed."""
    imu = scene.sensors.imu
    count = int(motion.drive.times_s[-1] * imu.rate_hz) - 1
    times_s = np.arange(count + 2) / imu.rate_hz
    T_left_imu = make_transform(np.eye(3), np.array(imu.place_m))
    poses = np.stack([motion.T_world_left(t) @ T_left_imu for t in times_s])
    R, p = poses[:, :3, :3], poses[:, :3, 3]
    turn = Rotation.from_matrix(np.swapaxes(R[:-2], 1, 2) @ R[2:]).as_rotvec()
    lifted = (p[2:] - 2 * p[1:-1] + p[:-2]) * imu.rate_hz**2 + (0.0, 0.0, GRAVITY_M_S2)
    accel = np.einsum('nij,ni->nj', R[1:-1], lifted)
    rng = np.random.default_rng([scene.seed, 6])
    gyro = turn * imu.rate_hz / 2 + np.radians(
        _errors(rng, imu.gyro_bias_deg_s, imu.gyro_noise_deg_s, count)
    )
    accel += _errors(rng, imu.accel_bias_m_s2, imu.accel_noise_m_s2, count)
    return ImuReadings(times_s[1:-1], gyro, accel, T_left_imu)


def _errors(rng: np.random.Generator, bias: float, noise: float, count: int) -> Array:
    direction = rng.normal(size=3)
    steady = bias * direction / np.linalg.norm(direction)
    return np.asarray(steady + noise * rng.standard_normal((count, 3)))
