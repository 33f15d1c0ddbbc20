"""The simulated stereo rig: its calibration, where it is at any time of the drive, and what it
makes of ideal pictures: lens, alignment, light, exposure and noise.

What simulated wheels, an IMU and a depth camera tell of a drive.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from segfloor_ros.camera.calibration.parameters import EyeCalibration
from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.errors import InputError
from segfloor_ros.geometry import Array, make_transform
from segfloor_ros.simulation.drive import Drive
from segfloor_ros.simulation.scene import CameraRig, DepthSensor, Scene, Vibration, Wheels
from segfloor_ros.simulation.solids import Prism, floor_height_m

WHEELBASE_M = 0.3
RAW_CENTRE_OFFSET_PX = ((3.2, -2.7), (-4.1, 1.6))
"""Principal points of unrectified left and right images, off the middle as in real cameras."""

Picture = NDArray[np.float32]

UNDISTORT_ITERATIONS = 60

MAX_HALF_PX = 2000

GRAVITY_M_S2 = 9.81
SMOOTH_RATE_HZ = 1000.0
ODOMETRY_START = (2.0, -1.0, 0.7)
"""x, y, yaw that the odometry begins with: its frame is none that anyone else knows."""

HOLE_SIZE_PX = 12.0
EDGE_RATIO = 0.05
"""Relative step of the depth at which a sensor sees neither side."""


def rectified_camera(rig: CameraRig) -> StereoCamera:
    """Return the ideal pair: square pixels, optical axis through the middle of the image."""
    focal_px = rig.width / 2 / float(np.tan(np.radians(rig.fov_x_deg) / 2))
    centre = ((rig.width - 1) / 2, (rig.height - 1) / 2)
    return StereoCamera(rig.width, rig.height, focal_px, focal_px, *centre, rig.baseline_m)


def raw_cameras(rig: CameraRig, seed: int) -> tuple[EyeCalibration, EyeCalibration]:
    """Return the calibrations of the left and the right camera that takes the images."""
    camera = rectified_camera(rig)
    rng = np.random.default_rng([seed, 2])
    sides = []
    for index, offset in enumerate(RAW_CENTRE_OFFSET_PX):
        P = np.column_stack([camera.K, [-camera.disparity_times_depth * index, 0.0, 0.0]])
        if rig.rectified:
            sides.append(EyeCalibration.of_rectified(rig.width, rig.height, P))
            continue
        axis = rng.normal(size=3)
        turn = axis / np.linalg.norm(axis) * np.radians(rig.misalignment_deg)
        K = camera.K + np.array([[0, 0, offset[0]], [0, 0, offset[1]], [0, 0, 0]])
        D = np.array([*rig.distortion, *[0.0] * 5])[:5]
        R = Rotation.from_rotvec(turn).as_matrix()
        sides.append(EyeCalibration(rig.width, rig.height, K, D, R, P))
    return sides[0], sides[1]


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

    def T_world_base(self, time_s: float) -> Array:
        """Return the pose (4, 4) of the base, on the floor, at a time."""
        x, y, yaw = self.drive.at(np.array([time_s]))[0]
        along = np.array([np.cos(yaw), np.sin(yaw)]) * WHEELBASE_M / 2
        rear, front = floor_height_m(self.floors, np.array([x, y]) + np.array([-along, along]))
        pitch = -np.arctan2(front - rear, WHEELBASE_M)
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
class ImagingPlan:
    """How pictures are taken: the size of the ideal picture, large enough for the lens, and for
    either camera where each of its pixels lies in it (H, W, 2), None where it is the picture.
    """

    width: int
    height: int
    focal_px: float
    raw: tuple[EyeCalibration, EyeCalibration]
    lookup: tuple[Picture, Picture] | None


def plan_imaging(scene: Scene) -> ImagingPlan:
    """Return the plan for a scene's camera."""
    camera, raw = rectified_camera(scene.camera), raw_cameras(scene.camera, scene.seed)
    if scene.camera.rectified:
        return ImagingPlan(camera.width, camera.height, camera.fx, raw, None)
    rays = [_rays(side, camera.width, camera.height) * camera.fx for side in raw]
    half = np.ceil(np.max([np.abs(side).max(axis=(0, 1)) for side in rays], axis=0)).astype(int) + 2
    if (half > MAX_HALF_PX).any():
        raise InputError('the distortion folds the image over; the lens cannot be simulated')
    left, right = ((side + half - 0.5).astype(np.float32) for side in rays)
    return ImagingPlan(2 * int(half[0]), 2 * int(half[1]), camera.fx, raw, (left, right))


def _rays(side: EyeCalibration, width: int, height: int) -> Array:
    """Return x/z and y/z (H, W, 2), in the rectified frame, of every pixel of a raw camera."""
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    x, y = (u - side.K[0, 2]) / side.K[0, 0], (v - side.K[1, 2]) / side.K[1, 1]
    rays = np.stack([*undistort(x, y, side.D), np.ones_like(x)], axis=-1) @ side.R.T
    return rays[..., :2] / rays[..., 2:]


def undistort(x: Array, y: Array, distortion: Array) -> tuple[Array, Array]:
    """Return ideal for distorted normalised coordinates, by fixed-point iteration of the plumb_bob
    model (Brown 1966; k1 k2 p1 p2 k3 as in OpenCV).
    """
    k1, k2, p1, p2, k3 = distortion
    ideal_x, ideal_y = x, y
    for _ in range(UNDISTORT_ITERATIONS):
        r2 = ideal_x**2 + ideal_y**2
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        shift_x = 2 * p1 * ideal_x * ideal_y + p2 * (r2 + 2 * ideal_x**2)
        shift_y = p1 * (r2 + 2 * ideal_y**2) + 2 * p2 * ideal_x * ideal_y
        ideal_x, ideal_y = (x - shift_x) / radial, (y - shift_y) / radial
    return ideal_x, ideal_y


def ideal_image(ideal: Picture, plan: ImagingPlan, side: int) -> Picture:
    """Return the image (H, W) of camera `side`, without noise, of an ideal picture."""
    picture = ideal
    if picture.shape != (plan.height, plan.width):
        picture = cv2.resize(picture, (plan.width, plan.height), interpolation=cv2.INTER_AREA)
    if plan.lookup is not None:
        picture = cv2.remap(picture, plan.lookup[side], None, cv2.INTER_CUBIC)
    return picture


def develop(
    ideal: Picture, plan: ImagingPlan, scene: Scene, side: int, frame: int, time_s: float
) -> NDArray[np.uint8]:
    """Return the image (H, W) uint8 that camera `side` (0 left, 1 right) delivers of an ideal
    picture. The noise depends on the scene's seed, the frame and the side alone.
    """
    picture = ideal_image(ideal, plan, side)
    gain = brightness(scene, time_s) * (scene.camera.right_gain if side == 1 else 1.0)
    rng = np.random.default_rng([scene.seed, 4, frame, side])
    noise = rng.standard_normal(picture.shape, np.float32) * np.float32(scene.camera.noise_sigma)
    return np.clip(np.round(picture * np.float32(gain) + noise), 0, 255).astype(np.uint8)


def brightness(scene: Scene, time_s: float) -> float:
    """Return the brightness of what the lenses let through at a time."""
    if any(start <= time_s < end for start, end in scene.camera.covered):
        return 0.0
    levels = np.array(scene.lighting.levels)
    return float(np.interp(time_s, levels[:, 0], levels[:, 1])) if len(levels) else 1.0


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
