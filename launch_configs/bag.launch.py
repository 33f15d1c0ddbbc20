"""A rosbag2 recording, played by `ros2 bag play` in its own time, through the nodes."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import EnvironmentVariable, LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'segfloor_ros'
MIDDLEWARE = 'FASTRTPS_DEFAULT_PROFILES_FILE'


ARGUMENTS = {
    'camera': (
        'false',
        'The camera of the recording, whose driver has named the topics: realsense, zed, oak, '
        'orbbec; or false.',
    ),
    'left_image': ('', 'Topic of the left images, by default left/image_raw or left/image_rect.'),
    'right_image': ('', 'Topic of the right images.'),
    'odometry': ('', 'Topic of the odometry of the wheels, by default wheel_odometry.'),
    'imu': ('', 'Topic of the IMU, by default imu.'),
    'rate': ('1.0', 'Speed against real time.'),
    'params_file': (['params', 'default.yaml'], 'Parameter file for all nodes.'),
    'namespace': ('', 'Namespace of all nodes and topics.'),
    'composed': ('false', 'Run all nodes as one program, for small machines: true or false.'),
    'rviz': ('false', 'Show the map in RViz: true or false.'),
    'left_camera_info': (
        '',
        'Advanced. Topic of the calibration of the left camera, by default camera_info next to its '
        'images, or left/camera_info where left and right images have one folder.',
    ),
    'right_camera_info': ('', 'Advanced. Topic of the calibration of the right camera, likewise.'),
    'depth': ('', 'Advanced. Topic of depth images, by default depth/image_raw.'),
    'delay': ('5.0', 'Advanced. Seconds until the player begins, so that the nodes are connected.'),
    'log_level': ('info', 'Advanced. From which level on the nodes log.'),
}
"""By name default and description; a list is a file of the package."""
CHOICES = {'log_level': ['debug', 'info', 'warn', 'error', 'fatal']}
HANDED_ON = (
    *('namespace', 'params_file', 'composed', 'log_level', 'rviz', 'camera'),
    *('left_image', 'right_image', 'left_camera_info', 'right_camera_info'),
    *('depth', 'odometry', 'imu'),
)


def generate_launch_description() -> LaunchDescription:
    """Return the player, the nodes and the arguments."""
    nodes = in_package(['launch_configs', 'segfloor.launch.py'])
    handed_on = {name: LaunchConfiguration(name) for name in HANDED_ON}
    return LaunchDescription(
        [
            DeclareLaunchArgument('bag', description='rosbag2 recording: a folder, or a file.'),
            *(declare(name, default, text) for name, (default, text) in ARGUMENTS.items()),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(nodes),
                launch_arguments={**handed_on, 'use_sim_time': 'true'}.items(),
            ),
            player(),
        ]
    )


def player() -> ExecuteProcess:
    """Return `ros2 bag play` with the clock."""
    middleware = EnvironmentVariable(
        MIDDLEWARE, default_value=in_package(['params', 'fastdds.xml'])
    )
    return ExecuteProcess(
        cmd=[
            *('ros2', 'bag', 'play', LaunchConfiguration('bag')),
            *('--clock', '--rate', LaunchConfiguration('rate')),
            *('--delay', LaunchConfiguration('delay')),
        ],
        # Unless the user has named another file; what it is for stands in this one.
        additional_env={MIDDLEWARE: middleware},
        output='screen',
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
