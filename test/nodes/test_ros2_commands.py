"""What `ros2 lifecycle`, `ros2 param`, `ros2 topic` and launch_ros ask of the nodes, asked with
their own services; the commands themselves are not among the wheels.
"""

import pytest
import yaml
from lifecycle_msgs.msg import State, Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
from node_makers import MAKERS
from node_messages import STAMP_NS, grid_messages, publish
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from stereo_drive import room_drive, write_kitti

from segfloor_ros.nodes.configuration import NODE_SETTINGS
from segfloor_ros.nodes.messages.topics import NODES, TOPICS, to_ns
from segfloor_ros.nodes.occupancy_grid import OccupancyGridNode

LIFECYCLE = {
    'change_state': 'lifecycle_msgs/srv/ChangeState',
    'get_state': 'lifecycle_msgs/srv/GetState',
    'get_available_states': 'lifecycle_msgs/srv/GetAvailableStates',
    'get_available_transitions': 'lifecycle_msgs/srv/GetAvailableTransitions',
    'get_transition_graph': 'lifecycle_msgs/srv/GetAvailableTransitions',
}
PARAMETER_TYPES = {
    bool: ParameterType.PARAMETER_BOOL,
    int: ParameterType.PARAMETER_INTEGER,
    float: ParameterType.PARAMETER_DOUBLE,
    str: ParameterType.PARAMETER_STRING,
}


@pytest.fixture
def run(make_graph, tmp_path):
    """Run a node in a namespace; returns the graph and the node's full name."""

    def run(node: str, *arguments: str):
        drive = write_kitti(tmp_path / 'drive', room_drive(1)[0])
        source = ('-p', f'input:={drive}') if node == 'stereo_camera' else ()
        graph = make_graph('-r', '__ns:=/robot', *source, *arguments)
        graph.add(MAKERS[node]())
        return graph, f'/robot/{node}'

    return run


@pytest.mark.parametrize('node', NODES)
def test_ros2_lifecycle_finds_and_drives_a_node(run, node) -> None:
    graph, name = run(node, '-p', 'autostart:=false')
    events: list[TransitionEvent] = []
    topic = f'{name}/transition_event'
    graph.tester.create_subscription(TransitionEvent, topic, events.append, 10)
    graph.until(lambda: graph.tester.count_publishers(topic), 'the topic of the transitions')

    def served() -> dict[str, list[str]]:
        return dict(graph.tester.get_service_names_and_types_by_node(node, '/robot'))

    expected = {f'{name}/{service}': [kind] for service, kind in LIFECYCLE.items()}
    graph.until(lambda: expected.items() <= served().items(), 'the services')
    states = graph.call(
        GetAvailableStates, f'{name}/get_available_states', GetAvailableStates.Request()
    )
    assert {s.label for s in states.available_states} >= {
        'unconfigured', 'inactive', 'active', 'finalized',
    }  # fmt: skip
    graph_of = graph.call(
        GetAvailableTransitions, f'{name}/get_transition_graph', GetAvailableTransitions.Request()
    )
    edges = {
        (t.start_state.label, t.transition.label, t.goal_state.label)
        for t in graph_of.available_transitions
    }
    assert ('unconfigured', 'configure', 'configuring') in edges
    for label, state in (
        ('configure', 'inactive'),
        ('activate', 'active'),
        ('deactivate', 'inactive'),
    ):
        set_state(graph, name, label)
        found = graph.call(GetState, f'{name}/get_state', GetState.Request()).current_state
        assert found.label == state
    assert found.id == State.PRIMARY_STATE_INACTIVE
    graph.until(lambda: any(e.goal_state.label == 'active' for e in events), 'the event')


def set_state(graph, name: str, label: str) -> None:
    """Take a transition by its label, as the command does."""
    offered = graph.call(
        GetAvailableTransitions,
        f'{name}/get_available_transitions',
        GetAvailableTransitions.Request(),
    ).available_transitions
    (chosen,) = (t.transition.id for t in offered if t.transition.label == label)
    request = ChangeState.Request(transition=Transition(id=chosen, label=label))
    assert graph.call(ChangeState, f'{name}/change_state', request).success, label


@pytest.mark.parametrize('node', NODES)
def test_ros2_param_lists_describes_gets_and_dumps(run, node) -> None:
    graph, name = run(node)
    specs = {spec.name: spec for spec in NODE_SETTINGS[node].specs()}
    listed = graph.call(ListParameters, f'{name}/list_parameters', ListParameters.Request())
    names = sorted(listed.result.names)
    assert set(specs) <= set(names)
    types = graph.call(
        GetParameterTypes, f'{name}/get_parameter_types', GetParameterTypes.Request(names=names)
    ).types
    values = graph.call(
        GetParameters, f'{name}/get_parameters', GetParameters.Request(names=names)
    ).values
    described = graph.call(
        DescribeParameters, f'{name}/describe_parameters', DescribeParameters.Request(names=names)
    ).descriptors
    for parameter, kind, value, description in zip(names, types, values, described, strict=True):
        assert kind == value.type == description.type
        if parameter in specs:
            assert kind == PARAMETER_TYPES[specs[parameter].type], parameter
            assert description.description.startswith(specs[parameter].description)
    # `ros2 param dump` writes these; a node takes the file again.
    dumped = {n: parameter_value_to_python(v) for n, v in zip(names, values, strict=True)}
    assert yaml.safe_load(yaml.safe_dump(dumped)).keys() == dumped.keys()


@pytest.mark.parametrize('service', [SetParameters, SetParametersAtomically])
def test_ros2_param_sets_what_may_change_and_says_why_not(run, service) -> None:
    graph, name = run('occupancy_grid')
    topic = 'set_parameters' if service is SetParameters else 'set_parameters_atomically'

    def change(parameter: str, **value) -> tuple[bool, str]:
        request = service.Request(
            parameters=[Parameter(name=parameter, value=ParameterValue(**value))]
        )
        response = graph.call(service, f'{name}/{topic}', request)
        result = response.results[0] if service is SetParameters else response.result
        return result.successful, result.reason

    double, integer = ParameterType.PARAMETER_DOUBLE, ParameterType.PARAMETER_INTEGER
    assert change('publish_period_s', type=double, double_value=0.5) == (True, '')
    # `ros2 param set NODE publish_period_s 2` sends an integer.
    assert change('publish_period_s', type=integer, integer_value=2) == (True, '')
    value = graph.call(
        GetParameters, f'{name}/get_parameters', GetParameters.Request(names=['publish_period_s'])
    ).values[0]
    assert float(parameter_value_to_python(value)) == 2.0
    refused, reason = change('publish_period_s', type=double, double_value=-1.0)
    assert not refused
    assert 'publish_period_s' in reason
    refused, reason = change('resolution_m', type=double, double_value=0.1)
    assert not refused
    assert 'read-only' in reason
    refused, reason = change('no_such_parameter', type=double, double_value=0.1)
    assert not refused
    assert 'undeclared' in reason


@pytest.mark.parametrize('profile', [QoSProfile(depth=10), qos_profile_sensor_data])
def test_ros2_topic_echo_and_hz_hear_the_map(make_graph, profile) -> None:
    """`echo` asks for what is offered or less, `hz` for sensor data."""
    graph = make_graph()
    node = graph.add(OccupancyGridNode())
    heard = []
    topic = TOPICS['map']
    graph.tester.create_subscription(topic.type, topic.name, heard.append, profile)
    graph.until(lambda: node.count_subscribers('map'), 'the listener')
    publish(graph, grid_messages(STAMP_NS))
    graph.until(lambda: heard, 'the map')
    assert to_ns(heard[0].header.stamp) == STAMP_NS
