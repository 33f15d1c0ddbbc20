"""What the programs of the nodes make of their command lines, and of files that cannot be read."""

import subprocess
import sys

import pytest
from node_messages import STAMP_NS, grid_messages, publish
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger
from stereo_drive import room_drive, write_kitti

from segfloor_ros.apps.programs import program_of
from segfloor_ros.apps.stereo_camera import make_stereo_camera
from segfloor_ros.nodes.configuration import STAGE_SETTINGS
from segfloor_ros.nodes.messages.topics import FRAMES, to_ns
from segfloor_ros.nodes.occupancy_grid import OccupancyGridNode

PATIENCE_S = 60


def run(node: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, '-m', program_of(node), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)


def test_help_lists_the_parameters_of_the_node() -> None:
    found = run('occupancy_grid', '--help')
    assert found.returncode == 0
    assert found.stdout.startswith('usage: occupancy_grid [--ros-args')
    for spec in STAGE_SETTINGS['occupancy_grid'].specs():
        assert f'  {spec.name} (default ' in found.stdout
    assert 'publish_period_s (default 1.0 s)' in found.stdout


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['resolution:=0.1'], 'unknown argument resolution:=0.1; parameters are given as'),
        (['--ros-args', '--nonsense'], '--nonsense'),
        (['--ros-args', '--params-file', '/nowhere.yaml'], '/nowhere.yaml'),
        (['--ros-args', '--params-file', 'LATIN1'], "Couldn't parse params file"),
    ],
)
def test_arguments_that_are_not_understood_end_with_one_line(tmp_path, arguments, words) -> None:
    latin1 = tmp_path / 'latin1.yaml'
    latin1.write_bytes('# café\n/**:\n'.encode('latin-1'))
    arguments = [str(latin1) if word == 'LATIN1' else word for word in arguments]
    found = run('cloud_labelling', *arguments)
    assert found.returncode == 2
    lines = found.stderr.strip().splitlines()
    assert len(lines) == 1, found.stderr
    assert lines[0].startswith('segfloor: ')
    assert words in lines[0]


def test_a_recording_is_the_clock_of_the_others_where_it_is_asked_to(make_graph, tmp_path) -> None:
    frames, _ = room_drive(3)
    drive = write_kitti(tmp_path / 'drive', frames)
    graph = make_graph('-p', f'input:={drive}', '-p', 'rate:=50.0', '-p', 'publish_clock:=true')
    times: list[int] = []
    graph.tester.create_subscription(
        Clock, '/clock', lambda message: times.append(to_ns(message.clock)), FRAMES
    )
    for side in ('left', 'right'):
        for name in ('image_raw', 'camera_info'):
            graph.collect(f'{side}/{name}')
    graph.add(make_stereo_camera())
    graph.until(lambda: len(times) == 3, 'the clock')
    assert times == [frame.stamp_ns for frame in frames]


def test_the_name_of_the_map_gets_its_ending_and_must_not_be_empty(make_graph, tmp_path) -> None:
    graph = make_graph('-p', f'map_file:={tmp_path / "plan"}')
    node = graph.add(OccupancyGridNode())
    publish(graph, grid_messages(STAMP_NS))
    graph.until(lambda: graph.reports('occupancy_grid'), 'the update')
    saved = graph.call(Trigger, 'save_map', Trigger.Request())
    assert (saved.success, saved.message) == (True, str(tmp_path / 'plan.yaml'))
    assert {path.name for path in tmp_path.iterdir()} == {'plan.yaml', 'plan.pgm'}
    (result,) = node.set_parameters([Parameter('map_file', value='')])
    assert result.successful
    refused = graph.call(Trigger, 'save_map', Trigger.Request())
    assert not refused.success
    assert refused.message.startswith('map_file is empty')
