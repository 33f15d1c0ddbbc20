"""A frame found by the one before alone, where the map is of no help."""

from itertools import combinations

import numpy as np
import pytest
from sampled_poses import twists_from
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.slam.rig import Rig
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.tracking.frame_to_frame import FrameToFrame
from segfloor_ros.core.slam.tracking.front_end import FrontEnd
from segfloor_ros.core.slam.tracking.images import Images
from segfloor_ros.core.slam.tracking.map_tracking import Follower, Tracker
from segfloor_ros.core.slam.tracking.pose import PoseEstimate
from segfloor_ros.core.twists import adjoint, se3_exp

SETTINGS = StereoSlamSettings(num_features=600, max_speed_mps=5.0)
SOMEWHERE = se3_exp(np.array([0.7, -0.4, 1.5, 0.3, -0.9, 0.2]))
SURE = 1e-6 * np.eye(6)


def step(k: int) -> Array:
    """Return the base after k large steps: 30 cm and 0.4 rad to either side."""
    return planar_pose(0.15 * k, 0.15 * (k % 2), 0.4 * (k % 2))


def camera_step(before: int, now: int) -> Array:
    """Return the true motion (4, 4) of the camera between two frames."""
    T_base_camera = MOUNT.T_base_left
    return invert(step(now) @ T_base_camera) @ step(before) @ T_base_camera


def after(frame, T_camera_world: Array = SOMEWHERE) -> FrameToFrame:
    """Return what has seen a frame and its pose."""
    found = FrameToFrame(Rig(CAMERA), SETTINGS.fast_threshold)
    found.see(
        frame, Images.of(frame, CAMERA), PoseEstimate(T_camera_world, np.zeros(0, bool), SURE, 1.0)
    )
    return found


@pytest.mark.parametrize('seed', [0, 1])
def test_a_large_step_is_found_as_well_as_it_says(seed: int) -> None:
    room = StereoRoom(seed)
    first, second = room.frame(0, step(0)), room.frame(1, step(1))
    found = after(first).find(second, Images.of(second, CAMERA))
    assert found is not None
    error = twists_from(camera_step(0, 1) @ SOMEWHERE, found.T_camera_world[None])[0]
    assert np.abs(error).max() < 0.05
    # Six errors of one sigma each make 6; the depths of the first frame err together.
    assert error @ np.linalg.solve(found.covariance, error) < 60


def test_the_error_of_the_last_pose_is_part_of_that_of_the_next() -> None:
    room = StereoRoom()
    first, second = room.frame(0, step(0)), room.frame(1, step(1))
    images, unsure = Images.of(second, CAMERA), np.diag([1e-3, 2e-3, 3e-3, 1e-4, 2e-4, 3e-4])
    finder = after(first)
    sure = finder.find(second, images).covariance
    before = PoseEstimate(SOMEWHERE, np.zeros(0, bool), SURE + unsure, 1.0)
    finder.see(first, Images.of(first, CAMERA), before)
    A = adjoint(camera_step(0, 1))
    added = finder.find(second, images).covariance - sure
    np.testing.assert_allclose(added, A @ unsure @ A.T, atol=3e-4)


def test_nothing_is_found_in_another_room_and_nothing_without_a_frame_before() -> None:
    frames = [StereoRoom(seed).frame(seed, step(seed)) for seed in range(5)]
    for before, now in combinations(frames, 2):
        assert after(before).find(now, Images.of(now, CAMERA)) is None
    images = Images.of(frames[0], CAMERA)
    assert FrameToFrame(Rig(CAMERA), 20).find(frames[0], images) is None
    finder = after(frames[0])
    finder.reset()
    assert finder.find(frames[0], images) is None


def test_the_last_pose_moves_along_with_the_map() -> None:
    room = StereoRoom()
    first, second = room.frame(0, step(0)), room.frame(1, step(1))
    images = Images.of(second, CAMERA)
    finder = after(first)
    stayed = finder.find(second, images).T_camera_world
    moved = se3_exp(np.array([0.4, 0.1, -0.3, 0.2, -0.1, 0.3]))
    finder.move_map(moved)
    np.testing.assert_allclose(
        finder.find(second, images).T_camera_world, stayed @ moved, atol=1e-9
    )


def test_a_keyframe_that_the_map_moves_takes_the_last_frame_along() -> None:
    room, slam = StereoRoom(), equipped_slam(CAMERA, SETTINGS, MOUNT)
    for k in range(2):
        slam.process(room.frame(k, planar_pose(0.05 * k, 0, 0)))
    front_end, frame = slam.front_end, room.frame(2, planar_pose(0.1, 0, 0))
    images = Images.of(frame, CAMERA)
    before = slam.map.keyframes[-1].T_camera_world
    stayed = front_end.frame_to_frame.find(frame, images).T_camera_world
    T_after_before = se3_exp(np.array([0.02, 0.01, -0.03, 0.02, -0.01, 0.03]))
    front_end.follow_map(before, before @ T_after_before)
    moved = front_end.frame_to_frame.find(frame, images).T_camera_world
    np.testing.assert_allclose(moved, stayed @ T_after_before, atol=1e-9)


@pytest.mark.parametrize('by_last_frame', [True, False])
def test_where_the_map_is_of_no_help_the_last_frame_is(monkeypatch, by_last_frame: bool) -> None:
    room, slam = StereoRoom(), equipped_slam(CAMERA, SETTINGS, MOUNT)
    monkeypatch.setattr(Tracker, 'best', lambda *_: None)
    monkeypatch.setattr(Follower, 'follow', lambda *_: None)
    monkeypatch.setattr(FrontEnd, '_relocalise', lambda *_: None)
    if not by_last_frame:
        monkeypatch.setattr(FrameToFrame, 'find', lambda *_: None)
    results = [r for k in range(5) for r in slam.process(room.frame(k, step(k), rate_hz=2.0))]
    # Once it has been lost for a while, a map begins anew.
    assert [r.tracked for r in results][:4] == [True] + [by_last_frame] * 3
    if not by_last_frame:
        return
    assert len(results) == 5
    for result in results:
        error = invert(step(result.index)) @ result.T_map_odom @ result.T_odom_base
        assert np.linalg.norm(error[:3, 3]) < 0.04
        assert (
            np.linalg.norm(error[:3, 3]) < 4 * np.sqrt(np.trace(result.covariance[:3, :3])) + 1e-6
        )
    # The map is tied together by what the images of two frames show.
    first, *later = slam.map.keyframes
    assert first.motion is None and len(later) == 4
    for k, keyframe in enumerate(later):
        assert keyframe.motion.source == 'images'
        off = twists_from(camera_step(k, k + 1), keyframe.motion.T_now_before[None])[0]
        assert np.abs(off).max() < 0.05
