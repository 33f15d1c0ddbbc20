"""The five nodes, each a process of its own or all in one. Without `input`, the images come from a
driver.
"""

from launch import Condition, LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition, UnlessCondition
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
    composed = LaunchConfiguration('composed')
    has_source = PythonExpression([repr(''), ' != ', "'", source, "'"])
    plays = IfCondition(
        PythonExpression([has_source, " and '", composed, "'.lower() in ('false', '0')"])
    )
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
            DeclareLaunchArgument(
                'composed',
                default_value='false',
                description='Run all nodes in one process, for small machines: true or false.',
            ),
            all_in_one(source, IfCondition(composed)),
            stage('stereo_camera', plays, input=ParameterValue(source, value_type=str)),
            *(stage(name, UnlessCondition(composed)) for name in STAGES),
        ]
    )


def stage(name: str, condition: Condition, **parameters: ParameterValue) -> Node:
    """Return one node with the parameter file and what the arguments say beside it."""
    return Node(
        package=PACKAGE,
        executable=name,
        name=name,
        namespace=LaunchConfiguration('namespace'),
        parameters=[
            ParameterFile(LaunchConfiguration('params_file')),
            {**sim_time(), **parameters},
        ],
        condition=condition,
        output='screen',
    )


def all_in_one(source: LaunchConfiguration, condition: Condition) -> Node:
    """Return the process of all nodes; they name themselves."""
    return Node(
        package=PACKAGE,
        executable='segfloor_pipeline',
        namespace=LaunchConfiguration('namespace'),
        parameters=[ParameterFile(LaunchConfiguration('params_file')), sim_time()],
        # Of parameters for all nodes, only those of the command line win over the file's sections.
        ros_arguments=['-p', ["input:='", source, "'"]],
        condition=condition,
        output='screen',
    )


def sim_time() -> dict[str, ParameterValue]:
    """Return the parameter that says whose time it is."""
    return {'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)}
