"""What a keyframe holds of what moves."""

from dataclasses import replace

import numpy as np
import pytest
from stereo_drive import room_drive
from stereo_room import CAMERA, MOUNT

from segfloor_ros.core.plugins.assembly import make_slam
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.tracking.images import MASK_DILATION_PX

BORDER_PX = 40


@pytest.mark.parametrize('is_masked', [False, True])
def test_the_black_border_of_rectification_does_not_move(is_masked) -> None:
    settings = StereoSlamSettings(keyframe_max_frames=1, num_features=700)
    slam = make_slam(CAMERA, settings, MOUNT)
    mask = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    mask[100:140, 200:240] = 255
    keyframes = []
    for frame in room_drive(6, step_m=0.04)[0]:
        left = frame.left.copy()
        left[:, :BORDER_PX] = 0
        given = replace(frame, left=left, excluded=mask if is_masked else None)
        keyframes += [r.keyframe for r in slam.process(given) if r.keyframe is not None]
    assert len(keyframes) >= 2
    for keyframe in keyframes:
        if not is_masked:
            assert keyframe.moving is None or not keyframe.moving.any()
            continue
        moving = keyframe.moving
        assert (moving[mask > 0] == 255).all()
        around = MASK_DILATION_PX + 1
        moving[100 - around : 140 + around, 200 - around : 240 + around] = 0
        assert not moving.any()
