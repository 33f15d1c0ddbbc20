"""The five nodes, each a process of its own or all in one. Without `input`, the images come from a
driver.
"""

from pathlib import Path, PurePosixPath

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'segfloor_ros'
STAGES = ('stereo_slam', 'floor_segmentation', 'cloud_labelling', 'occupancy_grid')
SIDES = {'left': 'left_camera_info', 'right': 'right_camera_info'}
YES, NO = ('true', '1', 'yes', 'on'), ('false', '0', 'no', 'off')

CAMERAS = {
    'realsense': {
        'left_image': '/camera/camera/infra1/image_rect_raw',
        'right_image': '/camera/camera/infra2/image_rect_raw',
        'depth': '/camera/camera/depth/image_rect_raw',
        'imu': '/camera/camera/imu',
    },
    'zed': {
        'left_image': '/zed/zed_node/left/color/rect/image',
        'right_image': '/zed/zed_node/right/color/rect/image',
        'depth': '/zed/zed_node/depth/depth_registered',
        'imu': '/zed/zed_node/imu/data',
    },
    'oak': {
        'left_image': '/oak/left/image_rect',
        'right_image': '/oak/right/image_rect',
        'depth': '/oak/stereo/image_raw',
        'imu': '/oak/imu/data',
    },
    'orbbec': {
        'left_image': '/camera/left_ir/image_raw',
        'right_image': '/camera/right_ir/image_raw',
        'depth': '/camera/depth/image_raw',
        'imu': '/camera/gyro_accel/sample',
    },
    'realsense_depth': {
        'left_image': '/camera/camera/color/image_raw',
        'depth': '/camera/camera/aligned_depth_to_color/image_raw',
        'imu': '/camera/camera/imu',
    },
    'zed_depth': {
        'left_image': '/zed/zed_node/left/color/rect/image',
        'depth': '/zed/zed_node/depth/depth_registered',
        'imu': '/zed/zed_node/imu/data',
    },
    'oak_depth': {
        'left_image': '/oak/rgb/image_raw',
        'depth': '/oak/stereo/image_raw',
        'imu': '/oak/imu/data',
    },
    'orbbec_depth': {
        'left_image': '/camera/color/image_raw',
        'depth': '/camera/depth/image_raw',
        'imu': '/camera/gyro_accel/sample',
    },
}
"""Topics by the names that the drivers document; params/camera_NAME.yaml says what to ask of them.
"""
INPUTS = {'depth': 'depth/image_raw', 'odometry': 'wheel_odometry', 'imu': 'imu'}
"""Arguments, and the topics of the nodes that they name."""


ARGUMENTS = {
    'camera': (
        'auto',
        'A camera whose driver runs: realsense, zed, oak or orbbec, or one of these with _depth '
        'behind its name for its depth images, which names its topics. Or '
        'whether to start the node stereo_camera: true, false, or auto, which does so where input '
        'is given; with true the input may stand in params_file.',
    ),
    'left_image': ('', 'Topic of the left images, by default left/image_raw or left/image_rect.'),
    'right_image': ('', 'Topic of the right images.'),
    'odometry': ('', 'Topic of the odometry of the wheels, by default wheel_odometry.'),
    'imu': ('', 'Topic of the IMU, by default imu.'),
    'input': (
        '',
        'Recording or device to play; empty: a camera driver publishes left/image_raw, '
        'right/image_raw and their camera_info.',
    ),
    'params_file': (
        ['params', 'default.yaml'],
        'Parameter file for all nodes; arguments win over it.',
    ),
    'namespace': ('', 'Namespace of all nodes and topics.'),
    'load_map': ('', 'Saved map to go on with; empty: begin with an empty one.'),
    'localize': (
        'false',
        'Only find the robot in the map of load_map, and add nothing to it: true or false.',
    ),
    'composed': ('false', 'Run all nodes as one program, for small machines: true or false.'),
    'rviz': ('false', 'Show the map in RViz: true or false.'),
    'left_camera_info': (
        '',
        'Advanced. Topic of the calibration of the left camera, by default camera_info next to its '
        'images, or left/camera_info where left and right images have one folder.',
    ),
    'right_camera_info': ('', 'Advanced. Topic of the calibration of the right camera, likewise.'),
    'depth': ('', 'Advanced. Topic of depth images, by default depth/image_raw.'),
    'use_sim_time': ('false', 'Advanced. Take the time from /clock: true or false.'),
    'lossless': (
        'auto',
        'Advanced. A recording slows down rather than lose a frame where the nodes cannot follow: '
        'true, false, or auto, which is true unless input is a device.',
    ),
    'autostart': (
        'true',
        'Advanced. Nodes begin to work by themselves: true, or false, with which they wait for a '
        'lifecycle manager.',
    ),
    'respawn': (
        'false',
        'Advanced. Start a node again that has died: true or false. It goes on with what it knew.',
    ),
    'namespaced_tf': (
        'false',
        'Advanced. Take /tf and /tf_static into the namespace, as Nav2 does for several robots: '
        'true or false.',
    ),
    'log_level': ('info', 'Advanced. From which level on the nodes log.'),
    'rviz_config': (['launch_configs', 'segfloor.rviz'], 'Advanced. Layout of RViz.'),
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
        name, default_value=in_package(default), description=description, choices=CHOICES.get(name)
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
    with_camera = has_camera_node(camera, source)
    with_rviz = truth('rviz', LaunchConfiguration('rviz').perform(context))
    if with_rviz:
        require('rviz2', 'rviz:=true', context)
    params_file = LaunchConfiguration('params_file').perform(context)
    if not Path(params_file).is_file():
        raise ValueError(f'params_file:={params_file}: no such file')
    tf = [('/tf', 'tf'), ('/tf_static', 'tf_static')] if own_tf else []
    topics, kind = remapped_topics(camera, context)
    files = [in_package(['params', f'camera_{camera}.yaml'])] if camera in CAMERAS else []

    def node(executable: str, *arguments: str, name: str | None = None) -> Node:
        # Plain command-line parameters win over every section of the file.
        return Node(
            package=PACKAGE,
            executable=executable,
            name=name,
            namespace=LaunchConfiguration('namespace'),
            parameters=[*files, LaunchConfiguration('params_file'), {'use_sim_time': sim_time}],
            remappings=[*topics, *tf],
            ros_arguments=[
                *('--log-level', log_level),
                *('-p', f'autostart:={str(autostart).lower()}', *kind, *arguments),
            ],
            respawn=respawn,
            output='screen',
        )

    # Without a word on the input, that of the parameter file holds.
    given = () if with_camera and not source else ('-p', as_text('input', source, with_camera))
    if lossless.lower() != 'auto' or (with_camera and source):
        devices = [word.strip().removeprefix('/dev/video') for word in source.split(',')]
        is_recording = not all(word.isdigit() for word in devices)
        slows_down = is_recording if lossless.lower() == 'auto' else truth('lossless', lossless)
        given = (*given, '-p', f'lossless:={str(slows_down).lower()}')
    maps = of_maps(context)
    if composed:
        nodes = [node('segfloor_pipeline', *given, *maps)]
    else:
        nodes = [node('stereo_camera', *given, name='stereo_camera')] if with_camera else []
        nodes += [
            node(stage, *(maps if stage == 'stereo_slam' else ()), name=stage) for stage in STAGES
        ]
    return [*nodes, rviz(sim_time, tf)] if with_rviz else nodes


def of_maps(context: LaunchContext) -> tuple[str, ...]:
    """Return the arguments on a saved map; none where none is named: the parameter file holds."""
    file = LaunchConfiguration('load_map').perform(context)
    localize = truth('localize', LaunchConfiguration('localize').perform(context))
    if not file:
        if localize:
            raise ValueError('localize:=true needs the map to localize in: load_map:=FILE')
        return ()
    localizes = f'localize:={str(localize).lower()}'
    return ('-p', as_text('load_map', file, True), '-p', localizes)


def has_camera_node(camera: str, source: str) -> bool:
    """Return whether the node stereo_camera is wanted. Raises ValueError."""
    if camera in CAMERAS:
        return False
    if camera.lower() == 'auto':
        return bool(source)
    if camera.strip().lower() not in (*YES, *NO):
        names = ', '.join(CAMERAS)
        raise ValueError(f'camera:={camera}: expected true, false, auto, {names}')
    return truth('camera', camera)


def remapped_topics(
    camera: str, context: LaunchContext
) -> tuple[list[tuple[str, str]], tuple[str, ...]]:
    """Return the remappings of the inputs, and the parameter that says which images they are: those
    with rect in their name are taken for rectified. Raises ValueError.
    """
    preset, found = CAMERAS.get(camera, {}), []
    kind: tuple[str, ...] = ()

    def topic(argument: str) -> str:
        return LaunchConfiguration(argument).perform(context) or preset.get(argument, '')

    images = {side: topic(f'{side}_image').removesuffix('/compressed') for side in SIDES}
    folders = [PurePosixPath(image).parent for image in images.values() if image]
    for side, image in images.items():
        if image:
            if not PurePosixPath(image).name:
                raise ValueError(f'{side}_image:={image}: expected the name of a topic')
            kind_name = 'rect' if 'rect' in image else 'raw'
            name = f'{side}/image_{kind_name}'
            found += [(name, image), (f'{name}/compressed', f'{image}/compressed')]
            kind = ('-p', f'image_kind:={kind_name}')
        info = topic(SIDES[side])
        if image and not info and len(set(folders)) == len(folders):
            info = str(PurePosixPath(image).with_name('camera_info'))
        found += [(f'{side}/camera_info', info)] if info else []
    found += [(name, topic(argument)) for argument, name in INPUTS.items() if topic(argument)]
    return found, kind


def require(package: str, wish: str, context: LaunchContext) -> None:
    """Raise RuntimeError where a package is missing, before anything has been started."""
    try:
        FindPackageShare(package).perform(context)
    except Exception:
        name = package.replace('_', '-')
        raise RuntimeError(
            f'{wish} needs the package {package}: apt install ros-$ROS_DISTRO-{name}, or leave it '
            'out; nothing has been started'
        ) from None


def rviz(sim_time: bool, remappings: list[tuple[str, str]]) -> Node:
    """Return RViz with the package's layout, whose topics are relative to the namespace."""
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
