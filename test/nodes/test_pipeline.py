"""The five nodes in one process."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from functools import partial

import numpy as np
import pytest
from ros_graph import fresh_graph
from std_srvs.srv import SetBool, Trigger
from stereo_drive import lockstep_map, room_drive, write_kitti

from segfloor_ros.apps.map_files import load_map
from segfloor_ros.nodes.messages.topics import CAMERA, GRID, NODES, SLAM, published_by, to_ns

FRAMES = 14


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
    command = [sys.executable, '-m', 'segfloor_ros.apps.segfloor_pipeline', '--ros-args']
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
