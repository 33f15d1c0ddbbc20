"""Result folders and trajectories: round trips, and nothing half-written."""

import dataclasses

import numpy as np
import pytest

from segfloor_ros.apps.results_folder import (
    DriveFrame,
    OutputFolder,
    lost_intervals,
    relocalisations,
    submap_intervals,
    summarise,
)
from segfloor_ros.apps.trajectory import (
    TrackedPose,
    Trajectory,
    corrected_trajectory,
    read_trajectory,
    write_tum,
)
from segfloor_ros.core.contracts import KeyframePath, Mount
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.timing import StageTimes
from segfloor_ros.core.twists import se3_exp


def moved(x, yaw=0.0):
    return se3_exp(np.array([x, 0, 0, 0, 0, 0])) @ se3_exp(np.array([0, 0, 0, 0, 0, yaw]))


def test_lost_intervals_are_closed_and_cover_the_ends():
    tracked = np.array([False, True, True, False, False, True, False])
    assert lost_intervals(range(10, 17), tracked) == [(10, 10), (13, 14), (16, 16)]
    assert lost_intervals(range(3), np.ones(3, bool)) == []


def test_tracking_is_found_again_at_the_first_stamp_with_a_pose():
    tracked = np.array([False, True, False, False, True, True, False])
    stamps = [10**18 + k * 100_000_000 for k in range(7)]
    (found,) = relocalisations(stamps, tracked)
    assert found == {'lost_s': pytest.approx(1e9 + 0.2), 'found_s': pytest.approx(1e9 + 0.4)}
    assert found['found_s'] - found['lost_s'] == pytest.approx(0.2)


def test_submaps_say_whether_they_were_merged():
    in_submap = np.array([False, True, True, False, True, True])
    tracked = np.array([True, False, True, True, False, False])
    assert submap_intervals(range(10, 16), in_submap, tracked) == [
        {'first_frame': 11, 'last_frame': 12, 'merged': True},
        {'first_frame': 14, 'last_frame': 15, 'merged': False},
    ]


def test_frames_of_submaps_that_were_not_merged_are_counted_and_named():
    """Of every second frame of a recording; one frame of the last submap was lost itself."""
    others = dict.fromkeys(
        (
            'skipped_frames', 'keyframes', 'map_updates', 'sensors', 'sensor_remarks',
            'input_faults', 'failed_frames', 'failed_keyframes', 'floor', 'interrupted', 'stages',
            'rss_mb',
        ),
        0,
    )  # fmt: skip
    in_submap = [False, True, True, False, True, True, True, False]
    tracked = [True, False, True, True, False, False, False, True]
    frames = [
        DriveFrame(k, 10 + 2 * k, tracked[k], in_submap[k], False, False, False) for k in range(8)
    ]
    summary = summarise(frames, 1.0, None, False, [], **others)
    assert summary.left_out_frames == 3 and summary.left_out == ['18-22']
    frames = [dataclasses.replace(frame, in_submap=False) for frame in frames]
    none = summarise(frames, 1.0, None, False, [], **others)
    assert none.left_out_frames == 0 and none.left_out == []


def test_comments_of_a_trajectory_are_read_by_us_and_by_evo(tmp_path):
    file_interface = pytest.importorskip('evo.tools.file_interface')
    stamps, path = np.array([10**18, 2 * 10**18]), tmp_path / 'trajectory.txt'
    write_tum(path, Trajectory(stamps, np.stack([moved(0.5), moved(1.5)])), ['frames 0-2', 'b'])
    assert path.read_text().startswith('# frames 0-2\n# b\n1000000000.000000000 0.5')
    times_s, poses = read_trajectory(path)
    np.testing.assert_allclose(times_s, [1e9, 2e9])
    np.testing.assert_allclose(poses[:, 0, 3], [0.5, 1.5])
    by_evo = file_interface.read_tum_trajectory_file(path)
    np.testing.assert_allclose(by_evo.positions_xyz[:, 0], [0.5, 1.5])


def test_frames_move_along_with_their_corrected_keyframe():
    # Two keyframes at odom x = 0 and 1, a frame half a metre after each; the second keyframe is
    # corrected to y = 2 and turned left, so its frame goes half a metre to the left of that.
    poses = [
        TrackedPose(0, moved(0.0), 0),
        TrackedPose(1, moved(0.5), 0),
        TrackedPose(2, moved(1.0), 2),
        TrackedPose(3, moved(1.5), 2),
    ]
    corrected = moved(1.0, np.pi / 2)
    corrected[1, 3] = 2.0
    path = KeyframePath(np.array([0, 2]), np.stack([moved(0.0), corrected]))
    result = corrected_trajectory(poses, path)
    np.testing.assert_array_equal(result.stamp_ns, [0, 1, 2, 3])
    expected = [[0, 0], [0.5, 0], [1, 2], [1, 2.5]]
    np.testing.assert_allclose(result.poses[:, :2, 3], expected, atol=1e-12)


def test_a_frame_whose_keyframe_is_gone_goes_with_the_one_before():
    poses = [TrackedPose(0, moved(0.0), 0), TrackedPose(1, moved(0.5), 77)]
    result = corrected_trajectory(poses, KeyframePath(np.array([0]), moved(3.0)[None]))
    np.testing.assert_allclose(result.poses[:, 0, 3], [3.0, 3.5])
    poses = [TrackedPose(k, moved(0.5 * k), k if k < 2 else 77) for k in range(3)]
    path = KeyframePath(np.array([0, 1]), np.stack([moved(3.0), moved(7.0)]))
    np.testing.assert_allclose(corrected_trajectory(poses, path).poses[:, 0, 3], [3.0, 7.0, 7.5])


def test_tum_lines_are_seconds_metres_and_a_unit_quaternion(tmp_path):
    stamps = np.array([1_500_000_001_000_000_007, 1_500_000_002_000_000_000])
    poses = np.stack([moved(1.25, 0.0), moved(2.0, np.pi / 2)])
    write_tum(tmp_path / 't.txt', Trajectory(stamps, poses))
    lines = (tmp_path / 't.txt').read_text().splitlines()
    assert lines[0].startswith('1500000001.000000007 1.250000000 0.000000000 0.000000000 ')
    values = np.array(lines[1].split()[1:], float)
    np.testing.assert_allclose(values, [2, 0, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-8)


def test_trajectory_of_the_camera_starts_at_identity():
    mount = Mount(0.4, 0.2, 0.0, 0.1)
    base = Trajectory(np.array([0, 1]), np.stack([np.eye(4), moved(1.0)]))
    camera = base.seen_from(mount.T_base_left)
    np.testing.assert_allclose(camera.poses[0], np.eye(4), atol=1e-12)
    # The base goes 1 m ahead: the camera, pitched down by 0.2, sees that as z and up (-y).
    expected = [0, -np.sin(0.2), np.cos(0.2)]
    np.testing.assert_allclose(camera.poses[1][:3, 3], expected, atol=1e-12)
    np.testing.assert_allclose(invert(camera.poses[1]) @ camera.poses[1], np.eye(4), atol=1e-12)


def test_output_folder_appears_only_when_written(tmp_path):
    target = tmp_path / 'out'
    with pytest.raises(RuntimeError), OutputFolder(target) as folder:
        folder.add_picture('floor_masks', '000003', np.zeros((4, 4), np.uint8))
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_output_folder_refuses_a_file(tmp_path):
    (tmp_path / 'out').write_text('mine')
    with pytest.raises(InputError, match='is no folder'):
        OutputFolder(tmp_path / 'out')


def test_stage_times_summary():
    times = StageTimes()
    for ms in (1, 2, 3, 4, 10):
        times.add('step', ms / 1000)
    assert times.summary() == {
        'step': {'count': 5, 'mean_ms': 4.0, 'p50_ms': 3.0, 'p95_ms': 8.8, 'max_ms': 10.0}
    }
