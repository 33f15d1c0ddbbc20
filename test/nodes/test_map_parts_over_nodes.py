"""What a camera maps while it is lost, over DDS: all of it arrives once the map is recognised."""

from __future__ import annotations

import pytest
from stereo_drive import write_kitti
from stereo_room import MOUNT, StereoRoom, planar_pose

from segfloor_ros.apps.stereo_camera import make_stereo_camera
from segfloor_ros.nodes.messages.topics import to_ns
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
