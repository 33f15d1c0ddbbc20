"""A second SLAM goes on with the map of a first one."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from stereo_drive import room_drive
from stereo_room import CAMERA, MOUNT

from segfloor_ros.geometry import invert
from segfloor_ros.slam.continuation import Continuation, LastState
from segfloor_ros.slam.results import NO_POINT
from segfloor_ros.slam.settings import StereoSlamSettings
from segfloor_ros.slam.stereo_slam import StereoSlam

SETTINGS = StereoSlamSettings(num_features=700, keyframe_max_frames=3)
KILLED, RESTARTED, FRAMES = 10, 13, 20


@pytest.fixture(scope='module')
def drive():
    return room_drive(FRAMES, step_m=0.04)


@pytest.fixture(scope='module')
def before(drive):
    slam = StereoSlam(CAMERA, SETTINGS, MOUNT)
    return [result for frame in drive[0][:KILLED] for result in slam.process(frame)]


@pytest.fixture(scope='module')
def last(before):
    result = [r for r in before if r.keyframe][-1]
    return LastState(CAMERA, MOUNT, result.keyframe, result.T_map_odom)


@pytest.fixture(scope='module')
def after(drive, last):
    slam = StereoSlam(CAMERA, SETTINGS, last.mount)
    slam.process(last.frame)
    continuation = Continuation(last)
    results = [result for frame in drive[0][RESTARTED:] for result in slam.process(frame)]
    return [continuation.join(result) for result in results]


def test_the_poses_go_on_in_the_old_map_and_in_odom(drive, before, after) -> None:
    poses = drive[1]
    assert all(result.tracked for result in after)
    for result in (*before, *after):
        truth = invert(poses[0]) @ poses[result.index]
        in_map = result.T_map_odom @ result.T_odom_base
        np.testing.assert_allclose(in_map[:3, 3], truth[:3, 3], atol=0.02)
    moved = invert(before[-1].T_odom_base) @ after[0].T_odom_base
    truth = invert(poses[KILLED - 1]) @ poses[RESTARTED]
    np.testing.assert_allclose(moved[:3, 3], truth[:3, 3], atol=0.02)


def test_the_path_keeps_the_old_keyframes_and_each_only_once(last, after) -> None:
    keyframes = [result.keyframe for result in after if result.keyframe]
    assert keyframes
    old = last.keyframe.path
    for keyframe in keyframes:
        path = keyframe.path
        assert all(a < b for a, b in pairwise(path.stamp_ns.tolist()))
        np.testing.assert_array_equal(path.stamp_ns[: len(old.stamp_ns)], old.stamp_ns)
        np.testing.assert_array_equal(path.T_map_base[: len(old.stamp_ns) - 1], old.T_map_base[:-1])
        np.testing.assert_allclose(path.T_map_base[-1], keyframe.T_map_base)


def test_a_point_is_in_the_cloud_once_and_a_feature_where_its_point_is(last, after) -> None:
    old = last.keyframe.cloud
    for keyframe in (result.keyframe for result in after if result.keyframe):
        cloud, features = keyframe.cloud, keyframe.features
        assert (np.diff(cloud.point_id) > 0).all()
        seen_before = last.keyframe.features.point_id
        kept = np.setdiff1d(old.point_id, seen_before)
        assert set(kept) <= set(cloud.point_id.tolist())
        assert not set(seen_before) & set(cloud.point_id.tolist()) - {NO_POINT}
        known = features.point_id != NO_POINT
        row = np.searchsorted(cloud.point_id, features.point_id[known])
        np.testing.assert_array_equal(cloud.point_id[row], features.point_id[known])
        np.testing.assert_allclose(features.xyz_map[known], cloud.xyz_map[row], atol=1e-5)
        assert keyframe.features.point_id[known].min() > old.point_id.max()
