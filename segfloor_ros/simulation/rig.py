"""The simulated stereo rig: its calibration and where it is at any time of the drive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.geometry import Array, make_transform
from segfloor_ros.simulation.drive import Drive
from segfloor_ros.simulation.scene import CameraRig, Scene, Vibration
from segfloor_ros.simulation.solids import Prism
from segfloor_ros.simulation.truth_map import floor_height_m

WHEELBASE_M = 0.3
RAW_CENTRE_OFFSET_PX = ((3.2, -2.7), (-4.1, 1.6))
"""Principal points of unrectified left and right images, off the middle as in real cameras."""


@dataclass(frozen=True)
class RawCamera:
    """Calibration of one camera as in CameraInfo: K (3, 3), D (5,) of plumb_bob, R (3, 3),
    P (3, 4).
    """

    K: Array
    D: Array
    R: Array
    P: Array


def rectified_camera(rig: CameraRig) -> StereoCamera:
    """Return the ideal pair: square pixels, optical axis through the middle of the image."""
    focal_px = rig.width / 2 / float(np.tan(np.radians(rig.fov_x_deg) / 2))
    centre = ((rig.width - 1) / 2, (rig.height - 1) / 2)
    return StereoCamera(rig.width, rig.height, focal_px, focal_px, *centre, rig.baseline_m)


def raw_cameras(rig: CameraRig, seed: int) -> tuple[RawCamera, RawCamera]:
    """Return the calibrations of the left and the right camera that takes the images."""
    camera = rectified_camera(rig)
    rng = np.random.default_rng([seed, 2])
    sides = []
    for index, offset in enumerate(RAW_CENTRE_OFFSET_PX):
        P = np.column_stack([camera.K, [-camera.disparity_times_depth * index, 0.0, 0.0]])
        if rig.rectified:
            sides.append(RawCamera(camera.K, np.zeros(5), np.eye(3), P))
            continue
        axis = rng.normal(size=3)
        turn = axis / np.linalg.norm(axis) * np.radians(rig.misalignment_deg)
        K = camera.K + np.array([[0, 0, offset[0]], [0, 0, offset[1]], [0, 0, 0]])
        D = np.array([*rig.distortion, *[0.0] * 5])[:5]
        sides.append(RawCamera(K, D, Rotation.from_rotvec(turn).as_matrix(), P))
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
