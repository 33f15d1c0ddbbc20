"""Where the camera is between frames."""

import numpy as np

from segfloor_ros.slam.body_motion import BodyMotion
from segfloor_ros.slam.motion import CameraMotion


def test_without_wheels_nothing_holds_the_pose_also_right_after_a_keyframe():
    motion = CameraMotion(2.0, BodyMotion())
    motion.take(np.eye(4), 1e-6 * np.eye(6), 0)
    motion.start_keyframe()
    assert not motion.is_held(100_000_000)
