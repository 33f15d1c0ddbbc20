"""Following pixels and points from frame to frame."""

from dataclasses import replace

import numpy as np
import pytest
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.geometry import invert
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.tracking.images import Images, follow_pixels, shrink
from segfloor_ros.core.slam.tracking.map_tracking import TRACKED_POINTS

SETTINGS = StereoSlamSettings(num_features=800)


@pytest.fixture
def room():
    return StereoRoom()


@pytest.mark.parametrize('width', [320, 640])
def test_flow_of_a_turn_is_that_of_the_pinhole_camera(width, room):
    scale = width / CAMERA.width
    camera = replace(CAMERA, width=width, height=round(CAMERA.height * scale))
    camera = replace(camera, fx=CAMERA.fx * scale, fy=CAMERA.fy * scale)
    camera = replace(camera, cx=(width - 1) / 2, cy=(camera.height - 1) / 2)
    poses = [planar_pose(0, 0, yaw) @ MOUNT.T_base_left for yaw in (0, np.radians(3))]
    last, now = (shrink(room.view(pose, camera)) for pose in poses)
    v, u = np.mgrid[40 : camera.height - 40 : 20, 60 : width - 60 : 20]
    uv = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
    rays = camera.back_project(uv, np.ones(len(uv)))
    truth = camera.project(rays @ (invert(poses[1]) @ poses[0])[:3, :3].T)[:, :2]
    found_uv, found = follow_pixels(last, now, width, uv, uv)
    assert found.mean() > 0.9
    assert np.median(np.abs(found_uv - truth)[found]) < 0.3


def test_follows_a_frame_to_the_millimetre_or_not_at_all(room):
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    slam.process(room.frame(0, planar_pose(0, 0, 0)))
    frame = room.frame(1, planar_pose(0.03, 0, 0.02))
    other = StereoRoom(seed=5).frame(1, planar_pose(0.03, 0, 0.02))
    truth = planar_pose(0.03, 0, 0.02) @ MOUNT.T_base_left

    def follow(frame):
        ids = slam.front_end.local.point_ids
        return slam.front_end.follower.follow(Images.of(frame, CAMERA), ids, np.eye(4))

    track = follow(frame)
    error = MOUNT.T_base_left @ invert(track.T_camera_world) @ invert(truth)
    assert np.linalg.norm(error[:3, 3]) < 0.003
    assert len(track.point_ids) <= TRACKED_POINTS
    assert np.isin(track.point_ids, track.visible_ids).all()
    assert follow(other) is None


def test_points_that_are_gone_are_not_followed(room):
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    slam.process(room.frame(0, planar_pose(0, 0, 0)))
    follower, ids = slam.front_end.follower, slam.front_end.follower.seen_ids
    slam.map.remove_points(ids[::2])
    follower.drop_dead()
    np.testing.assert_array_equal(follower.seen_ids, ids[1::2])
    images = Images.of(room.frame(1, planar_pose(0.03, 0, 0.02)), CAMERA)
    track = follower.follow(images, ids[1::2], np.eye(4))
    assert not np.isin(track.point_ids, ids[::2]).any()


def test_only_keyframes_need_features(monkeypatch, room):
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    extract = slam.front_end.extractor.extract
    calls = []
    monkeypatch.setattr(
        slam.front_end.extractor, 'extract', lambda *given: calls.append(1) or extract(*given)
    )
    for k in range(12):
        result = slam.process(room.frame(k, planar_pose(0.03 * k, 0, 0.01 * k)))[0]
        assert result.tracked
    assert len(calls) == len(slam.map.keyframes) < 8
