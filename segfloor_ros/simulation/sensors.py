"""What simulated wheels, an IMU and a depth camera tell of a drive."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from segfloor_ros.geometry import Array, make_transform
from segfloor_ros.simulation.drive import Drive
from segfloor_ros.simulation.rig import RigMotion
from segfloor_ros.simulation.scene import DepthSensor, Scene, Wheels

GRAVITY_M_S2 = 9.81
SMOOTH_RATE_HZ = 1000.0
ODOMETRY_START = (2.0, -1.0, 0.7)
"""x, y, yaw that the odometry begins with: its frame is none that anyone else knows."""

HOLE_SIZE_PX = 12.0
EDGE_RATIO = 0.05
"""Relative step of the depth at which a sensor sees neither side."""


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
    told = [
        way * _slip(wheels, times_s[1:], side) * wheels.scale
        + rng.standard_normal(len(way)) * wheels.noise_m * np.sqrt(np.abs(way))
        for side, way in enumerate((forward_m - half, forward_m + half))
    ]
    forward_m, turn_rad = (told[0] + told[1]) / 2, (told[1] - told[0]) / wheels.track_m
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


def depth_reading_mm(
    scene: Scene, focal_px: float, true_m: NDArray[np.float32], frame: int, time_s: float
) -> NDArray[np.uint16]:
    """Return the depth image (H, W) in mm, 0 where nothing is measured, of true depths (H, W)."""
    sensor: DepthSensor = scene.sensors.depth
    if any(start <= time_s < end for start, end in scene.camera.covered):
        return np.zeros(true_m.shape, np.uint16)
    rng = np.random.default_rng([scene.seed, 7, frame])
    scale = focal_px * sensor.baseline_m
    noise = cv2.GaussianBlur(rng.standard_normal(true_m.shape, np.float32), (0, 0), 1.0)
    noise *= np.float32(sensor.noise_px / noise.std())
    disparity_px = np.round((scale / true_m + noise) / sensor.step_px) * sensor.step_px
    depth_m = scale / np.maximum(disparity_px, sensor.step_px)
    patches = cv2.GaussianBlur(rng.standard_normal(true_m.shape, np.float32), (0, 0), HOLE_SIZE_PX)
    hole = patches < np.quantile(patches, sensor.hole_share)
    kernel = np.ones((3, 3), np.uint8)
    hole |= cv2.dilate(true_m, kernel) > cv2.erode(true_m, kernel) * (1 + EDGE_RATIO)
    hole |= (depth_m < sensor.min_m) | (depth_m > sensor.max_m)
    return np.where(hole, 0, np.round(depth_m * 1000)).astype(np.uint16)
