"""The five nodes, each a process of its own. Without `input`, the images come from a driver."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'segfloor_ros'
STAGES = ('stereo_slam', 'floor_segmentation', 'cloud_labelling', 'occupancy_grid')


def generate_launch_description() -> LaunchDescription:
    """Return the nodes and the arguments."""
    defaults = PathJoinSubstitution([FindPackageShare(PACKAGE), 'params', 'default.yaml'])
    source = LaunchConfiguration('input')
    has_source = IfCondition(PythonExpression([repr(''), ' != ', "'", source, "'"]))
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'namespace', default_value='', description='Namespace of all nodes and topics.'
            ),
            DeclareLaunchArgument(
                'params_file',
                default_value=defaults,
                description='Parameter file for all nodes; arguments win over it.',
            ),
            DeclareLaunchArgument(
                'use_sim_time',
                default_value='false',
                description='Take the time from /clock: true or false.',
            ),
            DeclareLaunchArgument(
                'input',
                default_value='',
                description='Recording or device to play; empty: a camera driver publishes '
                'left/image_raw, right/image_raw and their camera_info.',
            ),
            stage('stereo_camera', has_source, input=ParameterValue(source, value_type=str)),
            *(stage(name) for name in STAGES),
        ]
    )


def stage(name: str, condition: IfCondition | None = None, **parameters: ParameterValue) -> Node:
    """Return one node with the parameter file and what the arguments say beside it."""
    use_sim_time = ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)
    return Node(
        package=PACKAGE,
        executable=name,
        name=name,
        namespace=LaunchConfiguration('namespace'),
        parameters=[
            ParameterFile(LaunchConfiguration('params_file')),
            {'use_sim_time': use_sim_time, **parameters},
        ],
        condition=condition,
        output='screen',
    )
