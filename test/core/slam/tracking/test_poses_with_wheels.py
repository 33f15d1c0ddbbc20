"""Poses by images and wheels together, in a rig whose disparities are off by what it knows."""

from dataclasses import replace

import numpy as np
import pytest
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.contracts import StereoFrame, WheelPose
from segfloor_ros.core.geometry import invert, make_transform
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.plugins.sensors import body_motion
from segfloor_ros.core.plugins.sensors.wheel_odometry import WheelCalibration
from segfloor_ros.core.slam.rig import OffsetEstimate
from segfloor_ros.core.slam.settings import StereoSlamSettings

OFFSET_PX, FRAMES = 0.6, 4


def base_at(k):
    """4 cm a frame, on an arc."""
    return planar_pose(2.0 * np.sin(0.02 * k), 2.0 * (1 - np.cos(0.02 * k)), 0.02 * k)


@pytest.fixture(scope='module')
def frames():
    """The right image is shifted: every disparity is larger by the offset."""
    room, shifted = StereoRoom(), replace(CAMERA, cx=CAMERA.cx - OFFSET_PX)
    T_left_right = make_transform(np.eye(3), np.array([CAMERA.baseline_m, 0.0, 0.0]))
    poses = [base_at(k) @ MOUNT.T_base_left for k in range(FRAMES)]
    return [
        StereoFrame(k, k * 10**8, room.view(T), room.view(T @ T_left_right, shifted))
        for k, T in enumerate(poses)
    ]


def driven(frames, wheels):
    """Return the poses (N, 4, 4) of the base in the map, and those in odom that sensors learn from.
    wheels: poses of the base every 20 ms.
    """
    slam = equipped_slam(CAMERA, StereoSlamSettings(num_features=600), MOUNT)
    slam.rig.offset.estimate = OffsetEstimate(np.array([OFFSET_PX, 0.0, 0.0]), 1e4 * np.eye(3))
    learnt, learn = [], slam.sensors.learn

    def note(stamp_ns, T_odom_camera, R_world_odom):
        learnt.append(MOUNT.T_base_left @ T_odom_camera @ invert(MOUNT.T_base_left))
        learn(stamp_ns, T_odom_camera, R_world_odom)

    slam.sensors.learn = note
    # Wheels that have proved good: they move the pose of images by more than a hair.
    slam.sensors._calibrator.current = WheelCalibration(sigma=(1e-3,) * 6)
    for k, pose in enumerate(wheels):
        slam.add(WheelPose(k * 20_000_000, pose))
    (results,) = zip(*(slam.process(frame) for frame in frames), strict=True)
    return np.stack([r.T_map_odom @ r.T_odom_base for r in results]), np.stack(learnt)


@pytest.fixture(scope='module')
def on_wheels(frames):
    """Wheels that err by 3 mm per root metre go 1 % too far, which is less than that."""
    poses = [base_at(k / 5) for k in range(5 * FRAMES + 5)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(body_motion, 'SIGMA_ROOT_M', 0.003)
        return driven(frames, [make_transform(T[:3, :3], 1.01 * T[:3, 3]) for T in poses])


@pytest.fixture(scope='module')
def alone(frames):
    return driven(frames, [])


def test_the_offset_of_the_rig_pulls_no_pose(on_wheels, alone):
    """Points that are seen 0.6 px too near would put the camera 2 mm or more ahead."""
    for poses, _ in (on_wheels, alone):
        errors_m = [(invert(base_at(k)) @ T)[:3, 3] for k, T in enumerate(poses)]
        assert np.abs(errors_m).max() < 0.0015


def test_sensors_learn_from_what_the_images_alone_show(on_wheels, alone):
    np.testing.assert_allclose(on_wheels[1], alone[1], atol=2e-5)
    assert np.abs(on_wheels[0][1:] - alone[0][1:])[:, :3, 3].max() > 1e-4
