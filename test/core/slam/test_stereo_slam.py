"""The whole SLAM stage on a rendered room with known motion."""

import threading
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.contracts import NO_POINT, Mount, StereoFrame
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import invert, rotation_angle
from segfloor_ros.core.plugins.assembly import equipped_slam, make_slam
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.stereo_slam import CAMERA_AS_BASE

SETTINGS = StereoSlamSettings(num_features=800)


def drive(count=30):
    """Base poses: 4 cm a frame along an arc that turns 1.2 degrees a frame."""
    poses = [planar_pose(0, 0, 0)]
    for k in range(1, count):
        yaw = np.radians(1.2) * k
        last = poses[-1][:2, 3]
        poses.append(planar_pose(last[0] + 0.04 * np.cos(yaw), last[1] + 0.04 * np.sin(yaw), yaw))
    return poses


@pytest.fixture(scope='module')
def frames():
    room = StereoRoom()
    return [room.frame(i, pose) for i, pose in enumerate(drive())]


@pytest.fixture(scope='module')
def results(frames):
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    return [result for frame in frames for result in slam.process(frame)]


def pose_of(result):
    return result.T_map_odom @ result.T_odom_base


def test_every_frame_is_tracked_to_the_centimetre(results):
    assert all(result.tracked for result in results)
    for result, truth in zip(results, drive(), strict=True):
        error = invert(truth) @ pose_of(result)
        assert np.linalg.norm(error[:3, 3]) < 0.01
        assert rotation_angle(error[:3, :3]) < np.radians(0.3)


def test_the_map_starts_at_the_base_on_the_floor(results):
    np.testing.assert_allclose(pose_of(results[0]), np.eye(4), atol=1e-9)
    heights = results[-1].keyframe or [r.keyframe for r in results if r.keyframe][-1]
    z = heights.cloud.xyz_map[:, 2]
    # The room: most points on floor, walls and ceiling between 0 and 2.4 m.
    assert (np.abs(z) < 0.03).sum() > 50
    assert ((z > -0.15) & (z < 2.6)).mean() > 0.97


def test_points_lie_on_the_walls_of_the_room(results):
    cloud = [r.keyframe for r in results if r.keyframe][-1].cloud.xyz_map
    to_face = np.abs(np.concatenate([cloud - [-3, -2.5, 0], cloud - [6, 2.5, 2.4]], axis=1)).min(
        axis=1
    )
    assert np.median(to_face) < 0.03


def test_keyframes_carry_what_the_next_stages_need(results):
    keyframes = [r.keyframe for r in results if r.keyframe]
    assert 4 <= len(keyframes) <= 15
    for keyframe in keyframes:
        known = keyframe.features.point_id != NO_POINT
        assert known.sum() > 100
        assert np.isnan(keyframe.features.xyz_map[~known]).all()
        assert np.isin(keyframe.features.point_id[known], keyframe.cloud.point_id).all()
        assert (np.diff(keyframe.cloud.point_id) > 0).all()
        assert keyframe.path.stamp_ns[-1] == keyframe.stamp_ns
        np.testing.assert_allclose(keyframe.path.T_map_base[-1], keyframe.T_map_base)


def test_odom_is_continuous_at_keyframes(results):
    steps = [
        np.linalg.norm((invert(a.T_odom_base) @ b.T_odom_base)[:3, 3]) for a, b in pairwise(results)
    ]
    assert max(steps) < 0.05  # 4 cm a frame


def test_repeats_to_the_bit(frames, results):
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    again = [result for frame in frames for result in slam.process(frame)]
    for a, b in zip(results, again, strict=True):
        np.testing.assert_array_equal(a.T_odom_base, b.T_odom_base)
        np.testing.assert_array_equal(a.T_map_odom, b.T_map_odom)


@pytest.mark.slow
def test_the_background_thread_loses_nothing(frames):
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT, background=True)
    results = [result for frame in frames for result in slam.process(frame)]
    slam.close()
    assert not [t for t in threading.enumerate() if t.name.startswith('adjustment')]
    assert [r.index for r in results] == list(range(len(frames)))
    assert sum(r.keyframe is not None for r in results) >= 4
    for result, truth in zip(results, drive(), strict=True):
        assert result.tracked
        assert np.linalg.norm((invert(truth) @ pose_of(result))[:3, 3]) < 0.015
    for a, b in pairwise(results):
        assert np.linalg.norm((invert(a.T_odom_base) @ b.T_odom_base)[:3, 3]) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize('is_late', [False, True])
def test_pose_and_images_of_a_keyframe_are_announced_before_the_map_takes_it_in(frames, is_late):
    """Before its features are measured; late where an adjustment has still to move the map."""
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT, background=True)
    announced, observed = {}, []
    observe, collect = slam.front_end.observe, slam.back_end.collect

    def announce(result, frame, moving):
        assert slam.map.keyframes[-1].stamp_ns < result.stamp_ns  # not yet in the map
        # The second one has no adjustment before it.
        assert len(observed) == (is_late and len(slam.map.keyframes) > 1)
        announced[result.stamp_ns] = result, frame, moving

    def note_observed(frame, images, track):
        observed.append(frame.stamp_ns)
        # The map is as it was when the frame was tracked in it.
        if track is not None:
            pose = slam.front_end.motion.T_camera_world
            np.testing.assert_allclose(track.T_camera_world, pose, atol=1e-12)
        return observe(frame, images, track)

    slam.announce, slam.front_end.observe = announce, note_observed
    if is_late:
        slam.back_end.collect = lambda wait: collect(wait) if wait else None
    else:
        slam.back_end.collect = lambda wait: collect(wait=True)
    results = []
    for frame in frames:
        observed.clear()
        results += slam.process(frame)
    slam.close()
    keyframes = [r for r in results if r.keyframe]
    # The first one begins the map.
    assert list(announced) == [r.stamp_ns for r in keyframes[1:]]
    for result in keyframes[2:]:
        early, frame, _ = announced[result.stamp_ns]
        np.testing.assert_array_equal(frame.left, result.keyframe.left)
        # Early it is by the points tracked alone, not by all features of the keyframe.
        tolerance = 1e-12 if is_late else 1e-3
        np.testing.assert_allclose(early.T_odom_base, result.T_odom_base, atol=tolerance)
        T_map_base = early.T_map_odom @ early.T_odom_base
        np.testing.assert_allclose(T_map_base, result.keyframe.T_map_base, atol=tolerance)


def test_a_keyframe_is_announced_late_while_the_whole_map_may_move(frames):
    """And after a frame that did not become one: nobody waits for more than one in vain."""
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT, background=True)
    collect, observe = slam.back_end.collect, slam.front_end.observe
    slam.back_end.collect = lambda wait: collect(wait=True)
    observed, early, is_blank = [], [], [False]

    def note_observed(frame, images, track):
        observed.append(frame.index)
        return None if is_blank[0] else observe(frame, images, track)

    def announce(result, frame, moving):
        early.append(frame.index not in observed)

    slam.front_end.observe, slam.announce = note_observed, announce
    left = iter(frames)

    def drive_on():
        before = len(early), len(slam.map.keyframes)
        while (len(early), len(slam.map.keyframes)) == before:
            slam.process(next(left))
        return early[-1]

    slam.process(next(left))
    assert drive_on()
    slam.back_end._global._apply = lambda result: None
    assert not drive_on()
    slam.back_end._global._apply = None
    is_blank[0] = True
    assert drive_on()
    count = len(early)
    for _ in range(3):
        slam.process(next(left))
    assert len(early) == count
    is_blank[0] = False
    assert not drive_on()
    assert drive_on()
    slam.close()


def test_an_adjustment_moves_the_camera_with_its_keyframe_and_leaves_odom(frames):
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    for frame in frames[:12]:
        before = slam.process(frame)[-1]
    last = slam.map.keyframes[-1]
    adjustment = slam.back_end.mapper.plan_adjustment(last)
    # Keyframes, those that hold them and points, all 10 cm to the side.
    problem = adjustment.problem
    poses = problem.T_camera_world.copy()
    poses[:, :3, 3] -= poses[:, :3, :3] @ [0.1, 0.0, 0.0]
    moved = replace(
        problem, T_camera_world=poses, points_world=problem.points_world + np.array([0.1, 0.0, 0.0])
    )
    moved = replace(adjustment, problem=moved)
    slam.back_end._local.submit(
        partial(slam.back_end.mapper.solve, moved), partial(slam.back_end.mapper.apply, moved)
    )
    old = last.T_camera_world
    same_view = replace(frames[11], left=frames[11].left ^ 1, index=12, stamp_ns=12 * 100_000_000)
    after = slam.process(same_view)[-1]
    assert not np.allclose(old, last.T_camera_world, atol=0.05)
    step = invert(before.T_odom_base) @ after.T_odom_base
    assert np.linalg.norm(step[:3, 3]) < 0.01
    assert np.linalg.norm((invert(before.T_map_odom) @ after.T_map_odom)[:3, 3]) > 0.05


def test_covariance_is_a_covariance(results):
    for result in results[1:]:
        assert (np.linalg.eigvalsh(result.covariance) > 0).all()
        assert np.sqrt(result.covariance[0, 0]) < 0.02


def test_black_frames_are_lost_and_tracking_returns(frames):
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    results = []
    for frame in frames:
        if 10 <= frame.index < 14:
            black = np.zeros_like(frame.left)
            frame = StereoFrame(frame.index, frame.stamp_ns, black, black)
        results += slam.process(frame)
    assert [r.index for r in results if not r.tracked] == [10, 11, 12, 13]
    assert 'without contrast' in results[10].state
    assert results[10].keyframe is None
    assert results[10].covariance[0, 0] > 1e3
    for result, truth in zip(results[14:], drive()[14:], strict=True):
        assert result.tracked
        assert np.linalg.norm((invert(truth) @ pose_of(result))[:3, 3]) < 0.02


def test_a_frozen_camera_is_lost_and_tracking_returns(frames):
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    results = []
    for frame in frames[:18]:
        if 10 <= frame.index < 13:
            frame = StereoFrame(frame.index, frame.stamp_ns, frames[9].left, frames[9].right)
        results += slam.process(frame)
    assert [r.index for r in results if not r.tracked] == [11, 12]
    assert 'although the camera was moving' in results[11].state
    for result, truth in zip(results[13:], drive()[13:18], strict=True):
        assert np.linalg.norm((invert(truth) @ pose_of(result))[:3, 3]) < 0.02


def test_images_that_come_twice_are_repeated_and_the_motion_goes_on(frames):
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    results = []
    for frame in frames[:20]:
        if frame.index in (6, 8, 14):
            before = frames[frame.index - 1]
            frame = StereoFrame(frame.index, frame.stamp_ns, before.left, before.right)
        results += slam.process(frame)
    assert all(result.tracked for result in results)
    assert [r.index for r in results if r.repeated] == [6, 8, 14]
    assert not any(results[i].keyframe for i in (6, 8, 14))
    for result, truth in zip(results, drive()[:20], strict=True):
        assert np.linalg.norm((invert(truth) @ pose_of(result))[:3, 3]) < 0.01
    assert results[14].covariance[0, 0] > results[13].covariance[0, 0]


def test_a_jump_without_any_prediction_is_found_by_descriptors(frames):
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    room = StereoRoom()
    slam.process(room.frame(0, planar_pose(0, 0, 0)))
    far = planar_pose(0.5, 0.2, 0.3)  # 17 degrees: 50 of 320 pixels
    result = slam.process(room.frame(1, far))[0]
    assert result.tracked
    assert np.linalg.norm((invert(far) @ pose_of(result))[:3, 3]) < 0.02


@pytest.mark.slow
def test_who_was_lost_must_find_what_should_be_there(frames, monkeypatch):
    monkeypatch.setattr('segfloor_ros.core.slam.places.place_recognition.CHANCE_SHARE', 1.0)
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    black = np.zeros_like(frames[0].left)
    tracked = []
    for frame in frames[:8]:
        if frame.index == 4:  # a picture of somewhere else: lost
            frame = StereoRoom(seed=99).frame(4, planar_pose(1.0, 1.0, 2.0))
        if frame.index == 5:
            frame = StereoFrame(5, frame.stamp_ns, black, black)
            monkeypatch.setattr('segfloor_ros.core.slam.tracking.evidence.ENOUGH_EVIDENCE', 1e9)
        tracked += [result.tracked for result in slam.process(frame)]
    # Where no evidence is enough, not even the right view is.
    assert tracked == [True] * 4 + [False] * 4


def test_teleported_camera_is_lost_not_wrong(frames):
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    other = StereoRoom(seed=99)
    results = []
    for frame in frames[:15]:
        if frame.index >= 10:
            frame = other.frame(frame.index, planar_pose(1.0, 1.0, 2.0))
        results += slam.process(frame)
    assert [r.tracked for r in results] == [True] * 10 + [False] * 5


def test_standing_still_adds_nothing(frames):
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    for k in range(60):
        still = StereoFrame(k, k * 100_000_000, frames[0].left, frames[0].right)
        result = slam.process(still)[0]
    assert len(slam.map.keyframes) == 1
    assert np.linalg.norm(pose_of(result)[:3, 3]) < 1e-3


def test_results_wait_for_the_mount_and_none_is_lost(frames):
    class LateMeter:
        """Knows the mount at the third keyframe."""

        def __init__(self):
            self.seen = 0
            self.mount = self.remark = None
            self.is_final = self.may_change = False

        def add(self, left, right, T_world_left, up_world, is_new_view):
            self.seen += is_new_view
            self.mount = MOUNT if self.seen == 3 else None
            self.is_final = self.mount is not None

    slam = equipped_slam(CAMERA, SETTINGS, None, LateMeter())
    batches = [slam.process(frame) for frame in frames]
    sizes = [len(batch) for batch in batches]
    first = next(i for i, size in enumerate(sizes) if size)
    assert first >= 2
    assert sizes[first] == first + 1
    assert sizes[first + 1 :] == [1] * (len(frames) - first - 1)
    assert [r.index for batch in batches for r in batch] == list(range(len(frames)))


@pytest.mark.slow
def test_a_path_alone_waits_for_no_mount_and_measures_it_all_the_same(frames):
    """Places are believed by what the ground shows, too, so the path would differ without it."""
    with_map, alone = make_slam(CAMERA, SETTINGS), make_slam(CAMERA, SETTINGS, CAMERA_AS_BASE)
    mapped = [result for frame in frames for result in with_map.process(frame)]
    batches = [alone.process(frame) for frame in frames]
    assert [len(batch) for batch in batches] == [1] * len(frames)
    assert with_map.mount is not None and alone.rig.mount == with_map.mount
    assert alone.mount is CAMERA_AS_BASE
    T_base_left = with_map.mount.T_base_left
    for one, (other,) in zip(mapped, batches, strict=True):
        T_first_left = invert(T_base_left) @ one.T_map_odom @ one.T_odom_base @ T_base_left
        T = CAMERA_AS_BASE.T_base_left
        at_left = invert(T) @ other.T_map_odom @ other.T_odom_base @ T
        np.testing.assert_allclose(at_left, T_first_left, atol=1e-12)


@pytest.mark.parametrize(
    'mount', [Mount(0.0), Mount(-0.03, forward_m=0.1), Mount(0.5, roll_rad=1.5)]
)
def test_a_frame_that_is_no_mount_will_do_for_a_path_alone(mount):
    """A body of a camera that is carried by hand, a drone, a camera on its side."""
    with pytest.raises(InputError, match='the camera would '):
        make_slam(CAMERA, SETTINGS, mount)
    slam = make_slam(CAMERA, SETTINGS, mount, path_only=True)
    assert slam.mount == mount and slam.rig.mount is None


def test_a_camera_that_looks_straight_down_is_mounted_well():
    slam = make_slam(CAMERA, SETTINGS, Mount(0.5, np.radians(88.0), np.pi))
    assert slam.mount is not None


@pytest.mark.slow
def test_waiting_for_the_mount_does_not_fill_the_memory(frames, monkeypatch):
    monkeypatch.setattr('segfloor_ros.core.slam.held_results.MAX_HELD_KEYFRAMES', 3)
    slam = equipped_slam(CAMERA, SETTINGS)
    for frame in frames[:-1]:
        assert slam.process(frame) == []
    keyframes = len(slam.map.keyframes)
    assert keyframes > 4
    slam.rig.mount = MOUNT
    results = slam.process(frames[-1])
    assert len(results) == len(frames)
    assert all(result.tracked for result in results)
    with_images = [result.index for result in results if result.keyframe]
    assert 0 < len(with_images) <= 3
    assert with_images[0] == 0
