"""The five nodes in one program, of two processes."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from ros_graph import fresh_graph, surroundings
from std_srvs.srv import SetBool, Trigger
from stereo_drive import lockstep_map, room_drive, write_kitti

from segfloor_ros.apps.map_files import load_map
from segfloor_ros.nodes.kept_state import KeptState
from segfloor_ros.nodes.messages.topics import CAMERA, GRID, NODES, SLAM, published_by, to_ns

FRAMES = 14

PIPELINE = (sys.executable, '-m', 'segfloor_ros.apps.segfloor_pipeline')


@pytest.fixture(scope='module')
def drive(tmp_path_factory):
    return write_kitti(tmp_path_factory.mktemp('recording') / 'drive', room_drive(FRAMES)[0])


@pytest.fixture(scope='module')
def pipeline(drive, tmp_path_factory):
    """The graph around a pipeline that plays the drive once it is asked to."""
    folder = tmp_path_factory.mktemp('pipeline')
    parameters = {'input': drive, 'rate': 0.0, 'start_paused': 'true', 'background': 'false',
                  'map_file': folder / 'map.yaml'}  # fmt: skip
    options = [word for name, value in parameters.items() for word in ('-p', f'{name}:={value}')]
    command = [*PIPELINE, '--ros-args']
    with fresh_graph() as graph, (folder / 'log').open('w') as log:
        process = subprocess.Popen([*command, *options], stdout=log, stderr=log)
        try:
            yield graph, process, folder
        finally:
            process.kill()
            process.wait()


def test_it_makes_the_map_of_the_run_and_serves_listeners_outside(pipeline, drive) -> None:
    graph, _, folder = pipeline
    names = ('keyframe/features', 'keyframe/path', 'labelled_points', 'map')
    received = {name: graph.collect(name) for name in names}
    graph.until(lambda: all(graph.reports_any(node) for node in NODES), 'all nodes')
    graph.until(lambda: all(graph.tester.count_publishers(name) for name in names), 'the topics')
    graph.call(SetBool, f'{CAMERA}/pause', SetBool.Request(data=False))
    graph.until(lambda: len(graph.reports(SLAM)) == FRAMES, 'all frames')
    keyframes = [s.stamp_ns for s in graph.reports(SLAM) if s.values['keyframe'] == '1']
    graph.until(lambda: len(graph.reports(GRID)) == len(keyframes), 'all keyframes in the map')
    graph.until(lambda: len(received['labelled_points']) == len(keyframes), 'all clouds')
    for name in names[:3]:
        assert [to_ns(m.header.stamp) for m in received[name]] == keyframes, name
    assert graph.call(Trigger, 'save_map', Trigger.Request()).success
    np.testing.assert_array_equal(load_map(folder / 'map.yaml').cells, lockstep_map(drive).cells)


def publishes(graph, node: str, topic: str) -> bool:
    publishers = graph.tester.get_publishers_info_by_topic(topic)
    return node in {publisher.node_name for publisher in publishers}


def test_it_has_the_topics_of_the_five_nodes_and_ends_on_interrupt(pipeline) -> None:
    graph, process, folder = pipeline
    for node in NODES:
        for topic in published_by(node):
            graph.until(partial(publishes, graph, node, topic.name), f'{topic.name} of {node}')
    # Impatient hands, and launch, interrupt more than once.
    while process.poll() is None:
        process.send_signal(signal.SIGINT)
        time.sleep(0.01)
    assert process.returncode == 0
    assert 'Traceback' not in (folder / 'log').read_text()


def helpers_of(process: subprocess.Popen) -> list[int]:
    """Return the processes that a process has started."""
    listed = Path(f'/proc/{process.pid}/task/{process.pid}/children').read_text()
    return [int(word) for word in listed.split()]


def is_running(process_id: int) -> bool:
    with contextlib.suppress(OSError):
        state = Path(f'/proc/{process_id}/stat').read_text().rpartition(')')[2].split()[0]
        return state != 'Z'
    return False


def wait_until(is_so: Callable[[], bool]) -> None:
    end_s = time.monotonic() + 60
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.1)


@contextlib.contextmanager
def started(said: Path) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """Start the program, and wait for SLAM and for the helper; its words go to a file. Gives the
    process and the number of the helper.
    """
    with surroundings(), said.open('w') as log:
        process = subprocess.Popen(PIPELINE, stdout=log, stderr=log)
        try:
            wait_until(lambda: f'[{SLAM}]' in said.read_text())
            (helper,) = helpers_of(process)
            yield process, helper
        finally:
            process.kill()
            process.wait()


@pytest.mark.slow
def test_a_process_that_is_stopped_and_goes_on_ends_nothing(tmp_path) -> None:
    with started(tmp_path / 'log') as (process, helper):
        for number in (signal.SIGSTOP, signal.SIGCONT):
            os.kill(helper, number)
            time.sleep(0.3)
        assert is_running(process.pid) and is_running(helper)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0


@pytest.mark.slow
@pytest.mark.parametrize('victim', ['SLAM', 'the others'])
def test_when_one_process_is_killed_the_other_one_ends(victim, tmp_path) -> None:
    with started(tmp_path / 'log') as (process, helper):
        wait_until(lambda: len(os.listdir(f'/proc/{helper}/task')) > 5)  # its middleware runs
        time.sleep(3)  # what was kept before is taken up or dropped
        kept = KeptState(SLAM, 60.0)
        kept.note({'of': 'this life'})
        os.kill(process.pid if victim == 'SLAM' else helper, signal.SIGKILL)
        status = process.wait(30)
        wait_until(lambda: not is_running(helper))
        assert kept.file.with_suffix('.json').exists()
    assert status == (-signal.SIGKILL if victim == 'SLAM' else 128 + signal.SIGKILL)


@pytest.mark.parametrize(
    'parameter',
    ['input:=nowhere', 'num_featurs:=3', pytest.param('num_features:=-1', marks=pytest.mark.slow)],
)
def test_a_mistake_of_any_node_ends_it_with_one_line(parameter) -> None:
    with surroundings():
        words = (*PIPELINE, '--ros-args', '-p', parameter)
        done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    lines = [line for line in done.stderr.splitlines() if line.startswith('segfloor: ')]
    assert (done.returncode, len(lines)) == (2, 1), done.stderr
    assert 'Traceback' not in done.stderr
