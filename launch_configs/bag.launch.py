"""A rosbag2 recording, played by `ros2 bag play` in its own time, through the nodes."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import (
    EnvironmentVariable,
    LaunchConfiguration,
    PathJoinSubstitution,
)
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'segfloor_ros'
MIDDLEWARE = 'FASTRTPS_DEFAULT_PROFILES_FILE'


def generate_launch_description() -> LaunchDescription:
    """Return the player, the nodes and the arguments."""
    share = FindPackageShare(PACKAGE)
    nodes = PathJoinSubstitution([share, 'launch_configs', 'segfloor.launch.py'])
    return LaunchDescription(
        [
            DeclareLaunchArgument('bag', description='Folder of the rosbag2 recording.'),
            DeclareLaunchArgument(
                'rate', default_value='1.0', description='Speed against real time.'
            ),
            DeclareLaunchArgument(
                'delay',
                default_value='5.0',
                description='Seconds until the player begins, so that the nodes are connected.',
            ),
            DeclareLaunchArgument(
                'namespace', default_value='', description='Namespace of all nodes and topics.'
            ),
            DeclareLaunchArgument(
                'params_file',
                default_value=PathJoinSubstitution([share, 'params', 'default.yaml']),
                description='Parameter file for all nodes.',
            ),
            DeclareLaunchArgument(
                'composed',
                default_value='false',
                description='Run all nodes in one process, for small machines: true or false.',
            ),
            DeclareLaunchArgument(
                'log_level',
                default_value='info',
                choices=['debug', 'info', 'warn', 'error', 'fatal'],
                description='From which level on the nodes log.',
            ),
            DeclareLaunchArgument(
                'rviz', default_value='false', description='Show the map in RViz: true or false.'
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(nodes),
                launch_arguments={
                    'namespace': LaunchConfiguration('namespace'),
                    'params_file': LaunchConfiguration('params_file'),
                    'composed': LaunchConfiguration('composed'),
                    'log_level': LaunchConfiguration('log_level'),
                    'rviz': LaunchConfiguration('rviz'),
                    'camera': 'false',
                    'use_sim_time': 'true',
                }.items(),
            ),
            ExecuteProcess(
                cmd=[
                    *('ros2', 'bag', 'play', LaunchConfiguration('bag')),
                    *('--clock', '--rate', LaunchConfiguration('rate')),
                    *('--delay', LaunchConfiguration('delay')),
                ],
                # Unless the user has named another file; what it is for stands in this one.
                additional_env={
                    MIDDLEWARE: EnvironmentVariable(
                        MIDDLEWARE,
                        default_value=PathJoinSubstitution([share, 'params', 'fastdds.xml']),
                    )
                },
                output='screen',
            ),
        ]
    )
