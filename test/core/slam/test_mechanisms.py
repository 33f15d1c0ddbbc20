"""Each mechanism at work in the whole SLAM stage, where a drive needs it."""

from __future__ import annotations

import numpy as np
import pytest
from hand_made_maps import row_of_views
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.contracts import NO_POINT
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.slam.mapping.keyframe_mapping import find_duplicates
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.tracking.images import FeatureExtractor, Images
from segfloor_ros.core.slam.tracking.map_tracking import LocalMap, Start, Tracker
from segfloor_ros.core.slam.tracking.pose import PoseEstimate
from segfloor_ros.core.twists import se3_exp

SETTINGS = StereoSlamSettings(num_features=600)


def drive(slam, room, poses, change=lambda frame: frame):
    for k, pose in enumerate(poses):
        result = slam.process(change(room.frame(k, pose)))[0]
        assert result.tracked
    return slam.map.keyframes[-1]


def test_what_is_seen_again_is_not_mapped_twice():
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    there = [planar_pose(0.05 * k, 0, 0.04 * k) for k in range(12)]
    last = drive(slam, StereoRoom(), there + there[::-1])
    assert len(np.unique(last.point_id)) > 200
    pairs = find_duplicates(slam.map, last)
    assert (~slam.map.seen_together(*pairs)).sum() <= 5


def test_points_of_a_place_are_tracked_again_though_none_of_them_was_seen_lately():
    # Keyframe 0 sees points 0 to 4, the others, right beside it, only 5 to 9.
    sparse_map = row_of_views(4, [NO_POINT] * 5 + list(range(5, 10)), 0.05)
    sparse_map.unlink(0, np.arange(5, 10))
    local = LocalMap(sparse_map, 30)
    local.move_to(np.arange(5, 10, dtype=np.int32), np.eye(4))
    np.testing.assert_array_equal(local.point_ids, np.arange(10))


def test_smaller_novelty_makes_more_keyframes():
    def keyframes(novelty):
        settings = StereoSlamSettings(num_features=600, keyframe_novelty=novelty)
        slam = equipped_slam(CAMERA, settings, MOUNT)
        drive(slam, StereoRoom(), [planar_pose(0.02 * k, 0, 0) for k in range(14)])
        return len(slam.map.keyframes)

    few, usual, many = (keyframes(novelty) for novelty in (3.0, 1.0, 0.3))
    assert few < usual < many


@pytest.mark.parametrize('seed', [0, 1, 2])
def test_patches_give_the_pose_better_than_corners(seed):
    room = StereoRoom(seed)
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    slam.process(room.frame(0, planar_pose(0, 0, 0)))
    moved = planar_pose(0.06, 0.02, 0.05)
    frame = room.frame(1, moved)
    features = FeatureExtractor(SETTINGS).extract(frame.left)
    ids = slam.map.points_of(np.array([0]))
    starts = [Start(np.eye(4))]
    track = Tracker(slam.map).best(Images.of(frame, CAMERA), features, ids, starts, None)
    truth = invert(MOUNT.T_base_left) @ moved @ MOUNT.T_base_left
    error = track.T_camera_world @ truth
    assert np.linalg.norm(error[:3, 3]) < 0.0015


@pytest.mark.parametrize(('is_expected', 'measured'), [(True, 1), (False, 2)])
def test_a_second_start_is_measured_only_where_the_first_was_not_expected(is_expected, measured):
    slam, room = equipped_slam(CAMERA, SETTINGS, MOUNT), StereoRoom()
    slam.process(room.frame(0, planar_pose(0, 0, 0)))
    moved = planar_pose(0.06, 0.02, 0.05)
    frame = room.frame(1, moved)
    T_camera_world = invert(invert(MOUNT.T_base_left) @ moved @ MOUNT.T_base_left)
    tracker, found = Tracker(slam.map), []
    track_at = tracker.track_at
    tracker.track_at = lambda *given, **named: found.append(track_at(*given, **named)) or found[-1]
    at = T_camera_world if is_expected else se3_exp(np.full(6, 0.05)) @ T_camera_world
    expected = PoseEstimate(at, np.zeros(0, bool), 1e-4 * np.eye(6), 1.0)
    features = FeatureExtractor(SETTINGS).extract(frame.left)
    ids = slam.map.points_of(np.array([0]))
    starts = [Start(T_camera_world), Start(np.eye(4)), Start(np.eye(4))]
    best = tracker.best(Images.of(frame, CAMERA), features, ids, starts, expected)
    assert best.fits(PoseEstimate(T_camera_world, np.zeros(0, bool), 1e-6 * np.eye(6), 1.0))
    assert len(found) == measured


def test_what_a_keyframe_shows_anew_shares_its_error():
    """What wheels measure from there is compared with points that err as the keyframe does."""
    slam, room = equipped_slam(CAMERA, SETTINGS, MOUNT), StereoRoom()
    for k in range(12):
        (result,) = slam.process(room.frame(k, planar_pose(0.08 * k, 0, 0.06 * k)))
        if k and result.keyframe is not None:
            break
    motion = slam.front_end.motion
    at_keyframe = motion.since_keyframe.covariance.trace()
    assert 0.2 * motion.covariance.trace() < at_keyframe < 0.95 * motion.covariance.trace()
