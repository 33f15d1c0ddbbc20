"""Each mechanism at work in the whole SLAM stage, where a drive needs it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hand_made_maps import row_of_views
from stereo_room import CAMERA, MOUNT, ROOM_MAX, ROOM_MIN, StereoRoom, planar_pose

from segfloor_ros.geometry import invert
from segfloor_ros.slam.mapping.fusion import find_duplicates
from segfloor_ros.slam.results import NO_POINT
from segfloor_ros.slam.settings import StereoSlamSettings
from segfloor_ros.slam.stereo_slam import StereoSlam
from segfloor_ros.slam.tracking.consensus import Consensus
from segfloor_ros.slam.tracking.features import FeatureExtractor
from segfloor_ros.slam.tracking.images import Images
from segfloor_ros.slam.tracking.map_tracking import LocalMap, Tracker

SETTINGS = StereoSlamSettings(num_features=600)


def drive(slam, room, poses, change=lambda frame: frame):
    for k, pose in enumerate(poses):
        result = slam.process(change(room.frame(k, pose)))[0]
        assert result.tracked
    return slam.map.keyframes[-1]


def test_what_is_seen_again_is_not_mapped_twice():
    slam = StereoSlam(CAMERA, SETTINGS, MOUNT)
    there = [planar_pose(0.05 * k, 0, 0.04 * k) for k in range(12)]
    last = drive(slam, StereoRoom(), there + there[::-1])
    assert len(np.unique(last.point_id)) > 200
    pairs = find_duplicates(CAMERA, slam.map, last)
    assert (~slam.map.seen_together(*pairs)).sum() <= 5


def test_what_the_right_camera_does_not_see_is_mapped_by_motion():
    def half_covered(frame):
        right = frame.right.copy()
        right[:, CAMERA.width // 2 :] = 128
        return replace(frame, right=right)

    slam = StereoSlam(CAMERA, SETTINGS, MOUNT)
    sideways = [planar_pose(0.02 * k, 0.06 * k, 0.0) for k in range(15)]
    drive(slam, StereoRoom(), sideways, half_covered)
    points, keyframes, rows = slam.map.edges_of(np.flatnonzero(slam.map.alive))
    uvd = np.array(
        [
            slam.map.keyframes[k].observations.uvd_px[row]
            for k, row in zip(keyframes, rows, strict=True)
        ]
    )
    with_disparity = np.unique(points[np.isfinite(uvd[:, 2])])
    by_motion = np.setdiff1d(points, with_disparity)
    assert len(by_motion) > 30
    # They lie about the faces of the room; the parallax is small, and so is what it tells of depth.
    T_world_base = MOUNT.T_base_left
    xyz = slam.map.xyz_world[by_motion] @ T_world_base[:3, :3].T + T_world_base[:3, 3]
    to_face = np.abs(np.concatenate([xyz - ROOM_MIN, xyz - ROOM_MAX], axis=1)).min(axis=1)
    assert np.median(to_face) < 0.25


def test_points_of_a_place_are_tracked_again_though_none_of_them_was_seen_lately():
    # Keyframe 0 sees points 0 to 4, the others, right beside it, only 5 to 9.
    sparse_map = row_of_views(4, [NO_POINT] * 5 + list(range(5, 10)), 0.05)
    sparse_map.unlink(sparse_map.keyframes[0], np.arange(5, 10))
    local = LocalMap(CAMERA, SETTINGS, sparse_map)
    local.move_to(np.arange(5, 10, dtype=np.int32), np.eye(4))
    np.testing.assert_array_equal(local.point_ids, np.arange(10))


@pytest.mark.parametrize('seed', [0, 1, 2])
def test_patches_tell_the_pose_better_than_corners(seed):
    room = StereoRoom(seed)
    slam = StereoSlam(CAMERA, SETTINGS, MOUNT)
    slam.process(room.frame(0, planar_pose(0, 0, 0)))
    moved = planar_pose(0.06, 0.02, 0.05)
    frame = room.frame(1, moved)
    features = FeatureExtractor(SETTINGS).extract(frame.left)
    ids = slam.map.points_of(np.array([0]))
    track = Tracker(CAMERA, Consensus(CAMERA)).track(
        Images.of(frame, CAMERA), features, slam.map, ids, [np.eye(4)]
    )
    truth = invert(MOUNT.T_base_left) @ moved @ MOUNT.T_base_left
    error = track.T_camera_world @ truth
    assert np.linalg.norm(error[:3, 3]) < 0.0015
