"""Parameters of SLAM that decide what is found, believed, and where the base is."""

import numpy as np
import pytest
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.plugins.assembly import equipped_slam, make_slam
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.tracking.images import FeatureExtractor

BUDGET = 600


@pytest.mark.parametrize(('threshold', 'fewest', 'most'), [(3, 550, 600), (25, 0, 30)])
def test_weak_corners_are_found_down_to_the_threshold(threshold, fewest, most):
    image = StereoRoom(contrast=12.0).frame(0, planar_pose(0, 0, 0)).left
    settings = StereoSlamSettings(num_features=BUDGET, fast_threshold=threshold)
    assert fewest <= len(FeatureExtractor(settings).extract(image)) <= most


@pytest.mark.parametrize(('max_speed_mps', 'is_believed'), [(2.0, False), (6.0, True)])
def test_a_motion_faster_than_a_robot_drives_is_not_believed(max_speed_mps, is_believed):
    room = StereoRoom()
    settings = StereoSlamSettings(num_features=BUDGET, max_speed_mps=max_speed_mps)
    slam = equipped_slam(CAMERA, settings, MOUNT)
    # The last step is 0.3 m within 0.1 s.
    frames = [room.frame(k, planar_pose(x, 0, 0)) for k, x in enumerate((0.0, 0.05, 0.1, 0.4))]
    tracked = [slam.process(frame)[0].tracked for frame in frames]
    assert tracked == [True, True, True, is_believed]


@pytest.mark.parametrize('is_measured', [False, True])
def test_the_camera_may_sit_beside_the_middle_of_the_base(is_measured):
    """The base turns on the spot, and the camera goes around it."""
    forward_m, left_m = 0.25, -0.15
    where = {'camera_forward_m': forward_m, 'camera_left_m': left_m}
    if not is_measured:
        where |= {
            'camera_height_m': MOUNT.height_m,
            'camera_pitch_rad': MOUNT.pitch_rad,
            'camera_roll_rad': 0.0,
        }
    slam = make_slam(CAMERA, StereoSlamSettings(num_features=BUDGET, **where))
    room, results = StereoRoom(), []
    for k in range(8):
        turned = planar_pose(0, 0, 0.05 * k) @ planar_pose(forward_m, left_m, 0)
        results += slam.process(room.frame(k, turned))
    assert slam.mount.T_base_left[:3, 3] == pytest.approx([forward_m, left_m, 0.4], abs=0.01)
    last = results[-1].T_map_odom @ results[-1].T_odom_base
    np.testing.assert_allclose(last, planar_pose(0, 0, 0.35), atol=0.01)
