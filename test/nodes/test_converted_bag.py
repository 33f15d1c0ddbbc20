"""From `segfloor convert` to a pose: SLAM gets the messages of the bag, as a player sends them."""

import subprocess
import sys

import pytest
from stereo_drive import room_drive, write_kitti

from segfloor_ros.nodes.messages.topics import TOPICS
from segfloor_ros.nodes.stereo_slam import StereoSlamNode

FRAMES = 4
CONVERT_S = 120


@pytest.mark.parametrize('coding', [pytest.param('raw', marks=pytest.mark.slow), 'jpeg'])
def test_a_converted_recording_is_tracked_as_it_is_played(make_graph, tmp_path, coding) -> None:
    """Its images are rectified, so they are on image_rect; nobody says so to SLAM."""
    rosbag2 = pytest.importorskip('rosbags.rosbag2')
    frames, _ = room_drive(FRAMES)
    drive = write_kitti(tmp_path / 'drive', frames)
    bag = tmp_path / 'out.mcap'
    start = 'from segfloor_ros.apps.cli import start; start()'
    words = ['convert', str(drive), str(bag), '--images', coding]
    done = subprocess.run(
        [sys.executable, '-c', start, *words], capture_output=True, text=True, timeout=CONVERT_S
    )
    assert done.returncode == 0, done.stderr
    graph = make_graph('-p', 'image_reliability:=reliable')
    with rosbag2.Reader(bag) as reader:
        names = {c.topic: c.topic.removeprefix('/') for c in reader.connections}
        assert 'left/image_rect' in {n.removesuffix('/compressed') for n in names.values()}
        publishers = {topic: graph.publisher(name) for topic, name in names.items()}
        assert set(names.values()) <= set(TOPICS)
        node = graph.add(StereoSlamNode())
        graph.connected(list(publishers.values()))
        for connection, _, data in reader.messages():
            publishers[connection.topic].publish(bytes(data))
    graph.until(lambda: len(graph.reports('stereo_slam')) == FRAMES, 'all frames')
    graph.until(lambda: node.count_publishers('keyframe/odometry'), 'the outputs')
    assert all(s.values.get('tracked') != '0' for s in graph.reports('stereo_slam'))
