"""What is held back, while a camera is lost or its mount is not known: all of it arrives later, and
what is newest is soon among it.
"""

from __future__ import annotations

import pytest
from stereo_drive import write_kitti
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.apps.stereo_camera import make_stereo_camera
from segfloor_ros.core.plugins.assembly import make_slam
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.nodes.messages.camera_infos import rectified_calibration
from segfloor_ros.nodes.messages.topics import to_ns
from segfloor_ros.nodes.slam_outputs import CameraFrames
from segfloor_ros.nodes.stereo_slam import StereoSlamNode

KNOWN = [planar_pose(0.04 * k, 0.0, 0.03 * k) for k in range(20)]
BEHIND = [planar_pose(0.0, 0.06 * min(k, 5), 2.6) for k in range(120)]
TURN = [planar_pose(0.02 * k, 0.3, 2.6 - 0.11 * k) for k in range(25)]
ON = [planar_pose(0.5 + 0.03 * k, 0.3 - 0.02 * k, -0.1 + 0.03 * k) for k in range(10)]
QUEUE = 100
"""The depth of the queue of odometry."""


@pytest.mark.slow
def test_more_held_results_than_a_queue_holds_arrive(make_graph, tmp_path) -> None:
    room, poses = StereoRoom(), KNOWN + BEHIND + TURN + ON
    frames = [room.frame(k, pose, 10.0) for k, pose in enumerate(poses)]
    folder = write_kitti(tmp_path / 'drive', frames)
    mount = (MOUNT.height_m, MOUNT.pitch_rad, MOUNT.roll_rad)
    named = zip(('camera_height_m', 'camera_pitch_rad', 'camera_roll_rad'), mount, strict=True)
    graph = make_graph(
        *('-p', f'input:={folder}', '-p', 'rate:=0.0', '-p', 'background:=false'),
        *('-p', 'num_features:=600'),
        *(word for name, value in named for word in ('-p', f'{name}:={value}')),
    )
    odometry = graph.collect('odometry')
    graph.add(StereoSlamNode())
    graph.add(make_stereo_camera())
    last_ns = frames[-1].stamp_ns
    graph.until(lambda: odometry and to_ns(odometry[-1].header.stamp) == last_ns, 'the last pose')
    came = [to_ns(message.header.stamp) for message in odometry]
    lost = [k for k, frame in enumerate(frames) if frame.stamp_ns not in set(came)]
    assert came == sorted(came)
    # No pose for 1.5 s, until it maps on its own; then all of more than a queue holds.
    assert lost == list(range(len(KNOWN), len(KNOWN) + len(lost)))
    assert 10 < len(lost) < len(poses) - len(KNOWN) - len(ON) - QUEUE


def test_what_was_held_back_does_not_delay_what_is_newest(make_graph) -> None:
    """Tracking leaves the node no time for anything else: results go out all the same."""
    room = StereoRoom()
    frames = [room.frame(k, planar_pose(0.02 * k, 0.0, 0.0), 10.0) for k in range(41)]
    settings = StereoSlamSettings(num_features=600)
    slam = make_slam(CAMERA, settings, mount=MOUNT)
    results = [result for frame in frames for result in slam.process(frame)]
    graph = make_graph()
    node = graph.add(StereoSlamNode())
    sent = node._results
    sent.topics.begin(rectified_calibration(CAMERA), CameraFrames('left', 'right'))
    held, *later = results[:20], *([result] for result in results[20:])
    for batch in (held, *later):  # with no turn of the executor in between
        sent.add(batch, slam, 30.0)
    assert sent.topics.newest_ns == frames[-1].stamp_ns
