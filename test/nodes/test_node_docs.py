"""The pages of the nodes: as generated, and what they say against the running nodes."""

import importlib.util
import re
import sys
from functools import partial
from pathlib import Path

import pytest
from ros_graph import fresh_graph
from stereo_drive import room_drive, write_kitti

from segfloor_ros.apps.stereo_camera import make_stereo_camera
from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.floor_segmentation import FloorSegmentationNode
from segfloor_ros.nodes.messages.topics import NODES
from segfloor_ros.nodes.occupancy_grid import OccupancyGridNode
from segfloor_ros.nodes.stereo_slam import StereoSlamNode

DOCS = Path(__file__).resolve().parents[2] / 'docs'
MAKERS = (make_stereo_camera, StereoSlamNode, FloorSegmentationNode, CloudLabellingNode,
          OccupancyGridNode)  # fmt: skip
ALTERNATIVES = (
    (),
    ('-p', 'image_transport:=compressed'),
    ('-p', 'image_kind:=rect'),
    ('-p', 'image_kind:=rect', '-p', 'image_transport:=compressed'),
    ('-p', 'use_depth:=true'),
)
ON_DEMAND = {
    'floor_segmentation': {
        'scan': 'frame/left/image_rect',
        'obstacle_scan': 'frame/left/image_rect',
    },
    'cloud_labelling': {'obstacle_points': 'odometry'},
}
"""By node: what must be listened to for what to be received."""
OF_ROS = ('/parameter_events', '/rosout', '/clock', '/transition_event', '/tf', '/tf_static')
SERVICES_OF_ROS = re.compile(
    r'/(describe|get|list|set)_parameter(s|_types|s_atomically)$|/get_type_description$'
    r'|/(change|get)_state$|/get_available_(states|transitions)$|/get_transition_graph$'
)


@pytest.mark.parametrize('node', NODES)
def test_the_page_of_a_node_is_as_generated(node, monkeypatch) -> None:
    monkeypatch.syspath_prepend(DOCS)
    spec = importlib.util.spec_from_file_location('generate', DOCS / 'generate.py')
    assert spec is not None and spec.loader is not None
    generate = importlib.util.module_from_spec(spec)
    sys.modules['generate'] = generate
    spec.loader.exec_module(generate)
    committed = (DOCS / 'nodes' / f'{node}.md').read_text()
    assert committed == generate.page(node), 'run: python docs/generate.py'


def documented(node: str, title: str) -> dict[str, str]:
    """Return the names in the tables of a section of a page, with what their second column says."""
    page = (DOCS / 'nodes' / f'{node}.md').read_text()
    (section,) = re.findall(rf'^## {title}\n(.*?)(?=^## |\Z)', page, re.M | re.S)
    return dict(re.findall(r'^\| `([^`]+)` \| `([^`]*)`', section, re.M))


@pytest.mark.parametrize(('node', 'make'), [*zip(NODES, MAKERS, strict=True)], ids=NODES)
def test_what_is_documented_exists_and_what_exists_is_documented(tmp_path, node, make) -> None:
    drive = write_kitti(tmp_path / 'drive', room_drive(1)[0])
    source = ('-p', f'input:={drive}') if node == 'stereo_camera' else ()
    published, subscribed, services = {}, {}, {}
    parameters: set[str] = set()
    for alternative in ALTERNATIVES if node in ('stereo_camera', 'stereo_slam') else ((),):
        with fresh_graph('-r', '__ns:=/robot', *source, *alternative) as graph:
            made = graph.add(make())
            graph.until(partial(graph.reports_any, node), 'a sign of life')
            for demanded, on_demand in ON_DEMAND.get(node, {}).items():
                graph.collect_at(f'/robot/{demanded}', demanded)
                graph.until(partial(made.count_subscribers, on_demand), 'the demand')
            published |= {p.topic_name: [ros_name(p.msg_type)] for p in made.publishers}
            subscribed |= {s.topic_name: [ros_name(s.msg_type)] for s in made.subscriptions}
            services |= {s.service_name: [ros_name(s.srv_type)] for s in made.services}
            parameters |= set(made.get_parameters_by_prefix(''))
    assert relative(published) == documented(node, 'Publishes')
    assert relative(subscribed) == documented(node, 'Subscribes to')
    own = {name: kinds for name, kinds in services.items() if not SERVICES_OF_ROS.search(name)}
    assert relative(own, node) == documented(node, 'Services')
    of_ros = {'use_sim_time', 'start_type_description_service'}
    drawers = [documented(node, f'{kind} parameters') for kind in ('Basic', 'Advanced')]
    assert len(drawers[0]) <= 12
    assert parameters - of_ros == {*drawers[0], *drawers[1]}


def ros_name(kind: type) -> str:
    """Return the name of a message or service class, e.g. `sensor_msgs/msg/Image`."""
    package, group = kind.__module__.split('.')[:2]
    return f'{package}/{group}/{kind.__name__}'


def relative(found, node: str = '') -> dict[str, str]:
    """Return names and types as the pages have them, without what every ROS node has."""
    return {
        name.replace(f'/robot/{node}/', '~/').removeprefix('/robot/'): kind
        for name, (kind, *_) in found.items()
        if not name.endswith(OF_ROS)
    }


def test_every_fault_in_the_table_is_tried_by_the_test_named_beside_it() -> None:
    named = set(re.findall(r'\| `(test_\w+)` \|$', (DOCS / 'faults.md').read_text(), re.M))
    tests = ''.join(path.read_text() for path in Path(__file__).parents[1].rglob('test_*.py'))
    assert len(named) >= 12
    assert named <= set(re.findall(r'^def (test_\w+)', tests, re.M))
    faults = (Path(__file__).parent / 'test_faults.py').read_text()
    assert set(re.findall(r'^def (test_\w+)', faults, re.M)) <= named
