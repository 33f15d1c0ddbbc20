"""The processes of the launch files, started with the command lines that `ros2 launch` makes."""

import signal
import subprocess
import sys
from pathlib import Path

import launch_stand_in
import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import GetParameters
from stereo_drive import room_drive, write_kitti

from segfloor_ros.apps.programs import program_of
from segfloor_ros.nodes.messages.topics import NODES, SLAM

LAUNCH = Path(__file__).resolve().parents[2] / 'launch_configs' / 'segfloor.launch.py'
STOP_S = 20.0


def parameter(graph, node: str, name: str):
    request = GetParameters.Request(names=[name])
    (found,) = graph.call(GetParameters, f'{node}/get_parameters', request).values
    return found


@pytest.mark.slow
@pytest.mark.parametrize('composed', ['false', 'true'])
def test_the_nodes_are_as_the_arguments_say(make_graph, monkeypatch, tmp_path, composed) -> None:
    monkeypatch.setitem(launch_stand_in.SHARE, 'segfloor_ros', LAUNCH.parents[1])
    drive = write_kitti(tmp_path / "the drive's", room_drive(2)[0])
    (tmp_path / 'params').mkdir()
    arguments = {'composed': composed, 'input': str(drive), 'namespace': 'robot',
                 'use_sim_time': 'true', 'autostart': 'false', 'namespaced_tf': 'true',
                 'log_level': 'debug'}  # fmt: skip
    processes = launch_stand_in.launch(LAUNCH, tmp_path / 'params', arguments)
    graph, started = make_graph(), []
    try:
        for process in processes:
            module = program_of(process.executable)
            command = [sys.executable, '-m', module, *process.arguments]
            with (tmp_path / f'{process.executable}.log').open('wb') as log:
                started.append(subprocess.Popen(command, stdout=log, stderr=log))
        wanted = {f'/robot/{node}: health' for node in NODES}
        graph.until(lambda: wanted <= {s.name for s in graph.statuses}, 'all five nodes')
        states = {s.values['state'] for s in graph.statuses if s.kind == 'health'}
        assert states == {'unconfigured'}
        for node in NODES:
            assert parameter(graph, f'/robot/{node}', 'use_sim_time').bool_value, node
            assert not parameter(graph, f'/robot/{node}', 'autostart').bool_value, node
        assert parameter(graph, '/robot/stereo_camera', 'input').string_value == str(drive)
        configure(graph, f'/robot/{SLAM}')
        graph.until(lambda: graph.tester.count_subscribers('/robot/tf_static'), 'tf of its own')
        assert graph.tester.count_publishers('/tf') == 0
    finally:
        for process in started:
            process.send_signal(signal.SIGINT)
        statuses = [process.wait(STOP_S) for process in started]
    assert set(statuses) == {0}


def configure(graph, node: str) -> None:
    transition = Transition(id=Transition.TRANSITION_CONFIGURE)
    request = ChangeState.Request(transition=transition)
    assert graph.call(ChangeState, f'{node}/change_state', request).success
