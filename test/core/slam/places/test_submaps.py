"""A camera that got lost, maps on its own, and recognises the map again."""

import numpy as np
import pytest
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.geometry import invert, transform_points
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.slam.session import SessionState
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.thresholds import PROOF

SETTINGS = StereoSlamSettings(num_features=600)
ROOM = StereoRoom()
KNOWN = [planar_pose(0.04 * k, 0.0, 0.03 * k) for k in range(20)]
BEHIND = [planar_pose(0.0, 0.06 * min(k, 5), 2.6) for k in range(24)]
"""Away from what is known, for longer than the camera is looked for there."""

TURN = [planar_pose(0.02 * k, 0.3, 2.6 - 0.11 * k) for k in range(25)]
ON = [planar_pose(0.5 + 0.03 * k, 0.3 - 0.02 * k, -0.1 + 0.03 * k) for k in range(10)]


def drive(slam, poses, first=0, room=ROOM):
    """Return what comes of each frame, a list of results each."""
    return [slam.process(room.frame(first + k, pose)) for k, pose in enumerate(poses)]


def errors(results, poses):
    """Return the errors in metres of results, by the true poses of all frames."""
    off = [invert(poses[r.index]) @ r.T_map_odom @ r.T_odom_base for r in results]
    return np.linalg.norm(np.array(off)[:, :3, 3], axis=1)


@pytest.fixture(scope='module')
def merged():
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    return slam, drive(slam, KNOWN + BEHIND + TURN + ON), KNOWN + BEHIND + TURN + ON


@pytest.mark.slow
def test_what_was_mapped_while_lost_comes_at_once_when_the_map_is_recognised(merged):
    slam, batches, poses = merged
    sizes = [len(batch) for batch in batches]
    held = sizes.index(0)
    at = held + np.argmax(np.array(sizes[held:]) > 0)
    assert len(KNOWN) + 10 < held < len(KNOWN) + 20
    assert sizes[at] == at - held + 1 > 20
    assert sizes[at + 1 :] == [1] * (len(sizes) - at - 1)
    results = [r for batch in batches for r in batch]
    assert [r.index for r in results] == list(range(len(poses)))
    lost = [r.index for r in results if not r.tracked]
    assert lost == list(range(len(KNOWN), held))
    assert errors(batches[at] + batches[-1], poses).max() < 0.04
    assert slam.session.state is SessionState.MAPPING


@pytest.mark.slow
def test_keyframes_of_a_submap_are_published_in_the_map(merged):
    _, batches, poses = merged
    batch = max(batches, key=len)
    keyframes = [r.keyframe for r in batch if r.keyframe]
    assert len(keyframes) > 4
    for keyframe in keyframes:
        assert keyframe.path.stamp_ns[-1] == keyframe.stamp_ns
        assert keyframe.path.stamp_ns[0] == 0
        np.testing.assert_allclose(keyframe.T_map_base, poses[keyframe.frame_index], atol=0.04)
        np.testing.assert_array_equal(keyframe.path.T_map_base[-1], keyframe.T_map_base)
        known = keyframe.features.point_id >= 0
        assert known.sum() > 50
        row = np.searchsorted(keyframe.cloud.point_id, keyframe.features.point_id[known])
        xyz = keyframe.features.xyz_map[known]
        np.testing.assert_array_equal(keyframe.cloud.xyz_map[row], xyz)


class CoveredRoom(StereoRoom):
    """Seen by a pair whose right eye is covered in part: features there have no disparity."""

    def frame(self, *args, **more):
        frame = super().frame(*args, **more)
        frame.right[:, : CAMERA.width // 3] = 90
        return frame


@pytest.mark.slow
def test_features_of_the_keyframe_that_joins_a_map_are_where_their_points_are_seen():
    slam, poses = equipped_slam(CAMERA, SETTINGS, MOUNT), KNOWN + BEHIND + TURN + ON
    batches = drive(slam, poses, room=CoveredRoom())
    held = [len(batch) for batch in batches].index(0)
    keyframes = [r.keyframe for batch in batches[held:] for r in batch if r.keyframe]
    assert len(keyframes) > 4
    for keyframe in keyframes:
        features = keyframe.features
        assert len(features.uv_px) == len(features.point_id) == len(features.xyz_map)
        known = features.point_id >= 0
        T_left_map = invert(keyframe.T_map_base @ MOUNT.T_base_left)
        seen = CAMERA.project(transform_points(T_left_map, features.xyz_map[known]))[:, :2]
        off_px = np.linalg.norm(seen - features.uv_px[known], axis=1)
        assert np.median(off_px) < 1.0 and np.percentile(off_px, 90) < 4.0


def test_the_edges_between_merged_maps_are_where_their_keyframes_stand(merged):
    slam, _, _ = merged
    assert len(slam.map.loops) >= PROOF
    for loop in slam.map.loops:
        T_i, T_j = (slam.map.keyframes[k].T_camera_world for k in (loop.i, loop.j))
        np.testing.assert_allclose(loop.T_i_j, T_i @ invert(T_j), atol=0.05)


def test_the_odometry_goes_on_where_the_camera_got_lost(merged):
    _, batches, _ = merged
    odom = np.array([r.T_odom_base for batch in batches for r in batch if r.tracked])
    assert np.linalg.norm(np.diff(odom[:, :3, 3], axis=0), axis=1).max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    'waited_s, is_there', [pytest.param(0, False, marks=pytest.mark.slow), (10, True)]
)
def test_a_submap_is_merged_only_where_the_robot_can_have_driven(waited_s, is_there):
    """What it sees 1.6 s after it got lost looks like a place 4 m away."""
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    way = [planar_pose(-2.0 + 0.1 * k, 0.0, 0.0) for k in range(41)]
    lost = 2 * len(way)
    found = lost + 15 + 10 * waited_s
    # At 0.5 m/s: an image every 0.2 s is enough.
    for k, pose in enumerate(way):
        drive(slam, [pose], 2 * k)
    for k in range(15):
        drive(slam, way[-1:], lost + k, StereoRoom(seed=77 + k % 4))
    for k, pose in enumerate(way[:20]):
        drive(slam, [pose], found + 2 * k)
    assert (slam.session.state.holds_results) is not is_there


@pytest.mark.slow
def test_a_submap_that_is_never_recognised_is_not_in_the_map():
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    drive(slam, KNOWN)
    before = slam.to_arrays()
    batches = drive(slam, KNOWN, len(KNOWN), StereoRoom(seed=77))
    assert slam.session.state.holds_results and batches[-1] == []
    np.testing.assert_array_equal(
        slam.to_arrays()['keyframe_stamp_ns'], before['keyframe_stamp_ns']
    )
    rest = slam.finish()
    assert rest and not any(r.tracked or r.keyframe for r in rest)
    assert [r.index for r in rest][-1] == 2 * len(KNOWN) - 1
    np.testing.assert_allclose(
        [k.T_camera_world for k in slam.map.keyframes], before['keyframe_T_camera_world']
    )


@pytest.mark.slow
def test_of_two_that_were_not_joined_the_larger_is_the_map():
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    way = [planar_pose(0.03 * k, 0.0, 0.03 * k) for k in range(60)]
    poses = KNOWN + way
    drive(slam, KNOWN)
    batches = drive(slam, way, len(KNOWN), StereoRoom(seed=77))
    assert slam.session.state.holds_results and batches[-1] == []
    rest = slam.finish()
    mapped = [r for r in rest if r.tracked]
    began = slam.map.keyframes[0].stamp_ns
    assert len(mapped) > len(KNOWN) and began == mapped[0].stamp_ns
    assert [r.index for r in mapped] == list(range(mapped[0].index, len(poses)))
    assert not any(r.in_submap for r in rest) and any(r.keyframe for r in rest)
    by_truth = [invert(poses[mapped[0].index]) @ poses[r.index] for r in mapped]
    seen = [r.T_map_odom @ r.T_odom_base for r in mapped]
    off = [invert(true) @ invert(seen[0]) @ pose for true, pose in zip(by_truth, seen, strict=True)]
    assert np.linalg.norm(np.array(off)[:, :3, 3], axis=1).max() < 0.04
    assert slam.to_arrays()['keyframe_stamp_ns'][0] == began


@pytest.mark.slow
def test_a_map_that_had_hardly_begun_is_given_up():
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    first, poses = len(KNOWN[:5]), KNOWN[:5] + BEHIND + TURN
    batches = drive(slam, poses)
    assert [len(batch) for batch in batches] == [1] * len(poses)
    results = [r for batch in batches for r in batch]
    again = next(r.index for r in results if r.index >= first and r.tracked)
    assert first + 10 < again < first + 20
    rest = results[again:]
    assert all(r.tracked and r.state == 'tracking' for r in rest)
    path = next(r.keyframe.path for r in reversed(rest) if r.keyframe)
    assert path.stamp_ns[0] == rest[0].stamp_ns
    # It goes on where it got lost; the way since is not known.
    T_true = invert(poses[again]) @ poses[-1]
    T_measured = invert(rest[0].T_odom_base) @ rest[-1].T_odom_base
    np.testing.assert_allclose(T_measured, T_true, atol=0.04)
    given_up = [r.keyframe.cloud.point_id.max() for r in results[:first] if r.keyframe]
    assert rest[0].keyframe.cloud.point_id.min() > max(given_up)


@pytest.mark.slow
def test_a_camera_that_is_lost_again_is_looked_for_in_the_map():
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    drive(slam, KNOWN)
    drive(slam, KNOWN, 20, StereoRoom(seed=77))
    batches = drive(slam, [KNOWN[10]] * 20, 40)
    results = [r for batch in batches for r in batch]
    assert results[-1].tracked and slam.session.state is SessionState.MAPPING
    assert errors(results[-1:], [KNOWN[10]] * 60).max() < 0.02
    # It is not looked for in the submap alone.
    found = next(r.index for r in results if r.tracked)
    assert found <= 40 + 5
