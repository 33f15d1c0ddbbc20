"""What is shipped for other programs: layouts of RViz and Foxglove, parameters of Nav2."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from rclpy.node import Node

from segfloor_ros.nodes.messages.topics import DIAGNOSTICS, FRESH_S, TOPICS

REPOSITORY = Path(__file__).resolve().parents[2]
NAV2 = REPOSITORY / 'params' / 'nav2.yaml'
OF_OTHERS = {'/goal_pose', '/clicked_point', '/initialpose', '/map_updates'}
DISPLAYED = {
    'Map': 'nav_msgs/msg/OccupancyGrid',
    'Path': 'nav_msgs/msg/Path',
    'Odometry': 'nav_msgs/msg/Odometry',
    'PointCloud2': 'sensor_msgs/msg/PointCloud2',
    'LaserScan': 'sensor_msgs/msg/LaserScan',
    'Image': 'sensor_msgs/msg/Image',
}
NAV2_PLUGINS = {
    'GridBased': 'nav2_navfn_planner::NavfnPlanner',
    'FollowPath': 'nav2_regulated_pure_pursuit_controller::RegulatedPurePursuitController',
    'static_layer': 'nav2_costmap_2d::StaticLayer',
    'obstacle_layer': 'nav2_costmap_2d::ObstacleLayer',
    'inflation_layer': 'nav2_costmap_2d::InflationLayer',
    'navigate_to_pose': 'nav2_bt_navigator::NavigateToPoseNavigator',
    'spin': 'nav2_behaviors::Spin',
    'progress_checker': 'nav2_controller::SimpleProgressChecker',
    'goal_checker': 'nav2_controller::SimpleGoalChecker',
}
"""By the names that Nav2 exports since Jazzy: with `::` everywhere."""
MANAGED_BY_NAV2 = {
    'controller_server', 'smoother_server', 'planner_server', 'behavior_server', 'bt_navigator',
    'waypoint_follower', 'velocity_smoother', 'collision_monitor', 'docking_server',
    'route_server',
}  # fmt: skip
"""What navigation_launch.py of Jazzy starts."""
OBSERVATION_KEYS = {
    'topic', 'sensor_frame', 'observation_persistence', 'expected_update_rate', 'data_type',
    'min_obstacle_height', 'max_obstacle_height', 'inf_is_valid', 'marking', 'clearing',
    'obstacle_max_range', 'obstacle_min_range', 'raytrace_max_range', 'raytrace_min_range',
}  # fmt: skip
"""What ObstacleLayer reads of an observation source."""


def strings(tree: Any) -> Iterator[str]:
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from (*strings(key), *strings(value))
    elif isinstance(tree, list):
        for value in tree:
            yield from strings(value)
    elif isinstance(tree, str):
        yield tree


def test_rviz_shows_topics_that_exist_with_their_types_and_qos() -> None:
    layout = yaml.safe_load((REPOSITORY / 'launch_configs' / 'segfloor.rviz').read_text())
    manager = layout['Visualization Manager']
    assert manager['Global Options']['Fixed Frame'] == 'map'
    shown = set()
    for display in manager['Displays']:
        kind = display['Class'].removeprefix('rviz_default_plugins/')
        assert display['Name']
        if kind == 'TF':
            continue
        topic = TOPICS[display['Topic']['Value'].removeprefix('/')]
        assert topic.type_name == DISPLAYED[kind]
        durability = display['Topic']['Durability Policy'].upper().replace(' ', '_')
        assert durability == topic.profile.durability.name
        shown.add(topic.name)
    assert shown >= {'map', 'keyframe/path', 'odometry', 'floor_points', 'obstacle_points'}


def test_foxglove_shows_topics_that_exist_in_panels_that_are_configured() -> None:
    path = REPOSITORY / 'launch_configs' / 'segfloor_foxglove.json'
    layout = json.loads(path.read_text())
    panels = {s for s in strings(layout['layout']) if '!' in s}
    assert panels == set(layout['configById'])
    named = {s.partition('.')[0] for s in strings(layout['configById']) if s.startswith('/')}
    known = {f'/{name}' for name in TOPICS} | {DIAGNOSTICS.name} | OF_OTHERS
    assert named <= known
    assert {'/map', '/keyframe/left/image_rect', '/odometry', DIAGNOSTICS.name} <= named


@pytest.fixture
def nav2_node(monkeypatch):
    """Make a node as Nav2 does, with the parameters of the file."""
    rclpy.init(args=['--ros-args', '--params-file', str(NAV2)])
    made = []

    def make(name: str, namespace: str = '') -> dict[str, Any]:
        node = Node(name, namespace=namespace, automatically_declare_parameters_from_overrides=True)
        made.append(node)
        return {n: p.value for n, p in node.get_parameters_by_prefix('').items()}

    yield make
    for node in made:
        node.destroy_node()
    rclpy.try_shutdown()


def names_of(tree: dict[str, Any], prefix: str = '') -> Iterator[str]:
    """Return the names of the parameters in a tree, levels separated by dots."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from names_of(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}'


def test_every_name_of_a_parameter_is_one_that_nav2_knows() -> None:
    """Key by key: a name that a node does not know is silently ignored there."""
    known = yaml.safe_load((Path(__file__).parent / 'nav2_names.yaml').read_text())
    ours = yaml.safe_load(NAV2.read_text())
    ours |= {name: ours[name][name] for name in ('global_costmap', 'local_costmap')}
    assert set(known['bringup']) - {'costmap'} == MANAGED_BY_NAV2
    for node, sections in ours.items():
        group = 'costmap' if node.endswith('costmap') else node
        names = {name for kind in known.values() for name in kind.get(group, ())}
        of_any = {name for name in names if '*' in name}
        for name in names_of(sections['ros__parameters']):
            any_name = re.sub(r'(?<=obstacle_layer\.)\w+(?=\.)', '*', name)
            assert name in names or any_name in of_any, f'{node}: {name}'


def test_nav2_gets_its_parameters_under_the_names_of_its_nodes(nav2_node) -> None:
    assert set(yaml.safe_load(NAV2.read_text())) == MANAGED_BY_NAV2 | {
        'global_costmap', 'local_costmap',
    }  # fmt: skip
    for name in MANAGED_BY_NAV2:
        parameters = nav2_node(name)
        assert len(parameters) > 2, name
        check_plugins(parameters)
    for name, frame in (('global_costmap', 'map'), ('local_costmap', 'odom')):
        parameters = nav2_node(name, name)
        check_plugins(parameters)
        assert parameters['global_frame'] == frame
        assert parameters['plugins'] == ['static_layer', 'obstacle_layer', 'inflation_layer']
        assert parameters['static_layer.map_topic'] == '/map'
        assert parameters['static_layer.map_subscribe_transient_local'] is True
        assert parameters['obstacle_layer.obstacles.topic'] == '/obstacle_points'
        assert parameters['obstacle_layer.obstacles.data_type'] == 'PointCloud2'
        assert parameters['obstacle_layer.moving.topic'] == '/moving_points'
        assert parameters['obstacle_layer.moving.marking'] is True
        assert parameters['obstacle_layer.observation_sources'] == 'obstacles moving floor'
        floor = {
            name.removeprefix('obstacle_layer.floor.'): value
            for name, value in parameters.items()
            if name.startswith('obstacle_layer.floor.')
        }
        assert floor.keys() <= OBSERVATION_KEYS
        assert TOPICS[floor['topic'].removeprefix('/')].type_name.endswith(floor['data_type'])
        assert (floor['clearing'], floor['marking'], floor['inf_is_valid']) == (True, False, True)
    monitor = nav2_node('collision_monitor')
    assert monitor['source_timeout'] > 2 * FRESH_S
    assert (monitor['near.topic'], monitor['near.type']) == ('/obstacle_scan', 'scan')
    assert nav2_node('planner_server')['planner_plugins'] == ['GridBased']


def check_plugins(parameters: dict[str, Any]) -> None:
    """Every plugin that is listed has a type, in the form of Jazzy, and none is left over."""
    listed = {
        name
        for key, value in parameters.items()
        if key in ('plugins', 'navigators') or key.endswith('_plugins')
        for name in value
    }
    listed |= {v for k, v in parameters.items() if k == 'waypoint_task_executor_plugin'}
    typed = {k.removesuffix('.plugin'): v for k, v in parameters.items() if k.endswith('.plugin')}
    assert set(typed) == listed
    for name, plugin in typed.items():
        assert '::' in plugin
        assert '/' not in plugin
        assert NAV2_PLUGINS.get(name, plugin) == plugin
