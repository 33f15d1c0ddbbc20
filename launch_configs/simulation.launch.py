"""A simulated robot and the nodes that map what its camera sees, in its time; Nav2 may drive it."""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'segfloor_ros'

ARGUMENTS = {
    'scene': ('hall', 'A shipped scene, a scene file, or a map_server map (YAML).'),
    'robot': ('turtlebot3_burger', 'The robot: turtlebot3_burger or husky.'),
    'namespace': ('', 'Namespace of all nodes and topics.'),
    'params_file': (['params', 'simulation.yaml'], 'Parameter file for all nodes.'),
    'composed': ('false', 'Run the mapping nodes as one program: true or false.'),
    'load_map': ('', 'Saved map to go on with; empty: begin with an empty one.'),
    'rviz': ('false', 'Show the map in RViz: true or false.'),
    'nav2': ('false', 'Start navigation_launch.py of nav2_bringup: true or false.'),
    'nav2_params': (['params', 'nav2.yaml'], 'Parameter file for Nav2.'),
    'log_level': ('info', 'Advanced. From which level on the nodes log.'),
}
"""By name default and description; a list is a file of the package."""
CHOICES = {'log_level': ['debug', 'info', 'warn', 'error', 'fatal'], 'nav2': ['true', 'false']}
HANDED_ON = ('namespace', 'params_file', 'composed', 'load_map', 'log_level', 'rviz')


def generate_launch_description() -> LaunchDescription:
    """Return the arguments, the nodes, the robot and Nav2."""
    handed_on = {name: LaunchConfiguration(name) for name in HANDED_ON}
    return LaunchDescription(
        [
            *(declare(name, default, text) for name, (default, text) in ARGUMENTS.items()),
            include(in_package(['launch_configs', 'segfloor.launch.py']), handed_on),
            OpaqueFunction(function=robot),
            OpaqueFunction(function=navigation),
        ]
    )


def robot(context: LaunchContext) -> list[Node]:
    """Return the node of the robot."""
    own = {name: LaunchConfiguration(name).perform(context) for name in ('scene', 'robot')}
    return [
        Node(
            package=PACKAGE,
            executable='simulated_robot',
            name='simulated_robot',
            namespace=LaunchConfiguration('namespace'),
            parameters=[LaunchConfiguration('params_file'), own],
            ros_arguments=['--log-level', LaunchConfiguration('log_level')],
            output='screen',
        )
    ]


def navigation(context: LaunchContext) -> list[IncludeLaunchDescription]:
    """Return Nav2 where it is wanted."""
    if LaunchConfiguration('nav2').perform(context) != 'true':
        return []
    file = PathJoinSubstitution(
        [FindPackageShare('nav2_bringup'), 'launch', 'navigation_launch.py']
    )
    named = {'params_file': LaunchConfiguration('nav2_params')}
    return [include(file, {**named, 'namespace': LaunchConfiguration('namespace')})]


def include(
    file: PathJoinSubstitution | str, arguments: dict[str, LaunchConfiguration]
) -> IncludeLaunchDescription:
    """Return another launch file, in the time of the robot."""
    return IncludeLaunchDescription(
        PythonLaunchDescriptionSource(file),
        launch_arguments={**arguments, 'use_sim_time': 'true'}.items(),
    )


def declare(name: str, default: str | list[str], description: str) -> DeclareLaunchArgument:
    """Return an argument."""
    return DeclareLaunchArgument(
        name, default_value=in_package(default), description=description, choices=CHOICES.get(name)
    )


def in_package(default: str | list[str]) -> str | PathJoinSubstitution:
    """Return a text as it is, and the parts of a path as a file of the package."""
    if isinstance(default, str):
        return default
    return PathJoinSubstitution([FindPackageShare(PACKAGE), *default])
