"""The five nodes, each a process of its own or all in one. Without `input`, the images come from a
driver.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'segfloor_ros'
STAGES = ('stereo_slam', 'floor_segmentation', 'cloud_labelling', 'occupancy_grid')
RESPAWN_DELAY_S = 2.0
YES, NO = ('true', '1', 'yes', 'on'), ('false', '0', 'no', 'off')


ARGUMENTS = {
    'namespace': ('', 'Namespace of all nodes and topics.'),
    'params_file': (
        ['params', 'default.yaml'],
        'Parameter file for all nodes; arguments win over it.',
    ),
    'use_sim_time': ('false', 'Take the time from /clock: true or false.'),
    'input': (
        '',
        'Recording or device to play; empty: a camera driver publishes left/image_raw, '
        'right/image_raw and their camera_info.',
    ),
    'camera': (
        'auto',
        'Start the node stereo_camera: true, false, or auto, which does so where input is given; '
        'with true the input may stand in params_file.',
    ),
    'lossless': (
        'auto',
        'A recording slows down rather than lose a frame where the nodes cannot follow: true, '
        'false, or auto, which is true unless input is a device.',
    ),
    'composed': ('false', 'Run all nodes in one process, for small machines: true or false.'),
    'autostart': (
        'true',
        'Nodes begin to work by themselves: true, or false, with which they wait for a lifecycle '
        'manager.',
    ),
    'respawn': (
        'false',
        'Start a node again that has died: true or false. It goes on with what it knew.',
    ),
    'namespaced_tf': (
        'false',
        'Take /tf and /tf_static into the namespace, as Nav2 does for several robots: true or '
        'false.',
    ),
    'log_level': (
        'info',
        'From which level on the nodes log.',
    ),
    'rviz': ('false', 'Show the map in RViz: true or false.'),
    'rviz_config': (['launch_configs', 'segfloor.rviz'], 'Layout of RViz.'),
}
"""By name default and description; a list is a file of the package."""
CHOICES = {'log_level': ['debug', 'info', 'warn', 'error', 'fatal']}


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and the nodes."""
    arguments = [
        declare(name, default, description) for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=make_nodes)])


def declare(name: str, default: str | list[str], description: str) -> DeclareLaunchArgument:
    """Return an argument."""
    return DeclareLaunchArgument(
        name,
        default_value=in_package(default),
        description=description,
        choices=CHOICES.get(name),
    )


def in_package(default: str | list[str]) -> str | PathJoinSubstitution:
    """Return a text as it is, and the parts of a path as a file of the package."""
    if isinstance(default, str):
        return default
    return PathJoinSubstitution([FindPackageShare(PACKAGE), *default])


def make_nodes(context: LaunchContext) -> list[Node]:
    """Return the processes that the arguments ask for."""
    source = LaunchConfiguration('input').perform(context)
    camera = LaunchConfiguration('camera').perform(context)
    composed = truth('composed', LaunchConfiguration('composed').perform(context))
    autostart = truth('autostart', LaunchConfiguration('autostart').perform(context))
    sim_time = truth('use_sim_time', LaunchConfiguration('use_sim_time').perform(context))
    respawn = truth('respawn', LaunchConfiguration('respawn').perform(context))
    own_tf = truth('namespaced_tf', LaunchConfiguration('namespaced_tf').perform(context))
    log_level = LaunchConfiguration('log_level').perform(context)
    lossless = LaunchConfiguration('lossless').perform(context)
    with_camera = bool(source) if camera.lower() == 'auto' else truth('camera', camera)
    with_rviz = truth('rviz', LaunchConfiguration('rviz').perform(context))
    remappings = [('/tf', 'tf'), ('/tf_static', 'tf_static')] if own_tf else []

    def node(executable: str, *arguments: str, name: str | None = None) -> Node:
        # Plain command-line parameters win over every section of the file.
        return Node(
            package=PACKAGE,
            executable=executable,
            name=name,
            namespace=LaunchConfiguration('namespace'),
            parameters=[LaunchConfiguration('params_file'), {'use_sim_time': sim_time}],
            remappings=remappings,
            ros_arguments=[
                *('--log-level', log_level),
                *('-p', f'autostart:={str(autostart).lower()}', *arguments),
            ],
            respawn=respawn,
            respawn_delay=RESPAWN_DELAY_S,
            output='screen',
        )

    # Without a word on the input, that of the parameter file holds.
    given = () if with_camera and not source else ('-p', as_text('input', source, with_camera))
    if lossless.lower() != 'auto' or (with_camera and source):
        is_recording = not source.removeprefix('/dev/video').isdigit()
        slows_down = is_recording if lossless.lower() == 'auto' else truth('lossless', lossless)
        given = (*given, '-p', f'lossless:={str(slows_down).lower()}')
    if composed:
        nodes = [node('segfloor_pipeline', *given)]
    else:
        nodes = [node('stereo_camera', *given, name='stereo_camera')] if with_camera else []
        nodes += [node(stage, name=stage) for stage in STAGES]
    return [*nodes, rviz(sim_time, remappings)] if with_rviz else nodes


def rviz(sim_time: bool, remappings: list[tuple[str, str]]) -> Node:
    """Return RViz with the package's layout."""
    return Node(
        package='rviz2',
        executable='rviz2',
        namespace=LaunchConfiguration('namespace'),
        arguments=['-d', LaunchConfiguration('rviz_config')],
        parameters=[{'use_sim_time': sim_time}],
        remappings=remappings,
        output='screen',
    )


def as_text(name: str, text: str, is_wanted: bool) -> str:
    """Return an assignment of a text as YAML, or of the empty text where it is not wanted."""
    quoted = text.replace("'", "''") if is_wanted else ''
    return f"{name}:='{quoted}'"


def truth(name: str, text: str) -> bool:
    """Return the truth value of an argument. Raises ValueError naming it."""
    if text.strip().lower() not in (*YES, *NO):
        raise ValueError(f'{name}:={text}: expected true or false')
    return text.strip().lower() in YES
