"""The launch files: executed by a stand-in for `launch`, which the wheels lack, down to processes
that run; and by `launch` itself where it is installed.
"""

import ast
import importlib.util
import itertools
import sys
from collections.abc import Iterator
from pathlib import Path

import launch_stand_in
import pytest
import yaml

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDER = REPOSITORY / 'launch_configs'
FILES = sorted(FOLDER.glob('*.launch.py'))
SEGFLOOR, BAG = FOLDER / 'segfloor.launch.py', FOLDER / 'bag.launch.py'
SIMULATION = FOLDER / 'simulation.launch.py'
NODES = {
    'stereo_camera', 'stereo_slam', 'floor_segmentation', 'cloud_labelling', 'occupancy_grid',
}  # fmt: skip
STAGES = NODES - {'stereo_camera'}
ARGUMENTS = {
    'namespace', 'params_file', 'use_sim_time', 'input', 'camera', 'composed', 'autostart',
    'respawn', 'namespaced_tf', 'log_level', 'lossless', 'rviz', 'rviz_config', 'left_image',
    'right_image', 'left_camera_info', 'right_camera_info', 'depth', 'odometry', 'imu',
    'load_map', 'localize',
}  # fmt: skip

NAV2_STAND_IN = """
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration
NAMES = ('params_file', 'use_sim_time', 'namespace')
def generate_launch_description():
    values = [LaunchConfiguration(name) for name in NAMES[:2]]
    declared = [DeclareLaunchArgument(name, description='A.') for name in NAMES]
    return LaunchDescription([*declared, ExecuteProcess(cmd=['nav2', *values])])
"""


def named_calls(tree: ast.AST) -> list[ast.Call]:
    """Return the calls of LaunchConfiguration by a name that stands there."""
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == 'LaunchConfiguration'
        and isinstance(node.args[0], ast.Constant)
    ]


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_every_argument_is_described_and_used(path) -> None:
    entities = launch_stand_in.load(path).entities
    declared = [e for e in entities if isinstance(e, launch_stand_in.DeclareLaunchArgument)]
    names = {argument.name for argument in declared}
    assert len(names) == len(declared)
    assert all(argument.description.endswith('.') for argument in declared)
    # Named where it is declared, and once more at least.
    source = path.read_text()
    assert {name for name in names if source.count(f"'{name}'") > 1} == names
    assert {call.args[0].value for call in named_calls(ast.parse(source))} <= names
    assert {'namespace', 'params_file'} <= names
    are_advanced = [argument.description.startswith('Advanced. ') for argument in declared]
    assert are_advanced.count(False) <= 12
    assert are_advanced == sorted(are_advanced), 'the basic ones come first'
    assert path != SEGFLOOR or names == ARGUMENTS


def test_a_saved_map_goes_to_slam_alone(launched) -> None:
    found = launched(load_map="home's.map", localize='true')
    with_map = {name for name, process in found.items() if 'home' in str(process.arguments)}
    assert with_map == {'stereo_slam'}
    words = found['stereo_slam'].arguments
    assert "load_map:='home''s.map'" in words
    assert 'localize:=true' in words
    assert not any('load_map' in str(process.arguments) for process in launched().values())
    with pytest.raises(ValueError, match='load_map:=FILE'):
        launched(localize='true')


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_a_parameter_file_that_is_not_there_is_an_error(launched, path) -> None:
    bag = {'bag': '/a'} if path == BAG else {}
    with pytest.raises(ValueError, match=r'params_file:=/nope\.yaml: no such file'):
        launched(path, params_file='/nope.yaml', **bag)


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_only_launch_is_imported(path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.module is not None
            assert node.module.split('.')[0] in ('launch', 'launch_ros', 'pathlib')
        assert not isinstance(node, ast.Import)


@pytest.fixture
def launched(monkeypatch, tmp_path):
    """Return the processes that a launch file makes of arguments, by executable."""
    monkeypatch.setitem(launch_stand_in.SHARE, 'segfloor_ros', REPOSITORY)
    monkeypatch.setitem(launch_stand_in.SHARE, 'rviz2', tmp_path)

    def launched(path: Path = SEGFLOOR, **arguments: str):
        processes = launch_stand_in.launch(path, tmp_path, arguments)
        return {process.executable: process for process in processes}

    return launched


@pytest.mark.parametrize(
    ('arguments', 'processes'),
    [
        ({}, STAGES),
        ({'input': '/a'}, NODES),
        ({'input': '/a', 'camera': 'false'}, STAGES),
        ({'camera': 'True'}, NODES),
        ({'input': '/a', 'composed': 'true'}, {'segfloor_pipeline'}),
        ({'rviz': '1'}, STAGES | {'rviz2'}),
    ],
)
def test_the_arguments_say_which_processes_there_are(launched, arguments, processes) -> None:
    assert launched(**arguments).keys() == processes


def after(words: list[str], flag: str) -> list[str]:
    """Return the words that follow a flag."""
    return [word for flagged, word in itertools.pairwise(words) if flagged == flag]


def test_what_the_arguments_say_is_handed_on(launched) -> None:
    camera = launched(input="/it's a bag")['stereo_camera'].arguments
    assert after(camera, '-p') == ['autostart:=true', "input:='/it''s a bag'", 'lossless:=true']
    assert after(launched(camera='true')['stereo_camera'].arguments, '-p') == ['autostart:=true']
    slam = launched(autostart='no', log_level='debug', namespace='robot')['stereo_slam'].arguments
    assert after(slam, '-p') == ['autostart:=false']
    assert after(slam, '--log-level') == ['debug']
    assert after(slam, '-r') == ['__node:=stereo_slam', '__ns:=/robot']
    apart = launched(input='/a', camera='false', composed='true')['segfloor_pipeline'].arguments
    assert after(apart, '-p')[-1] == "input:=''"
    for arguments, is_lossless in (
        ({'input': '/a'}, 'true'),
        ({'input': '/dev/video0'}, 'false'),
        ({'input': '0'}, 'false'),
        ({'input': '0,2'}, 'false'),
        ({'input': '/dev/video0,/dev/video2'}, 'false'),
        ({'input': '/a', 'lossless': 'false'}, 'false'),
        ({'camera': 'true', 'lossless': 'yes'}, 'true'),
    ):
        camera = launched(**arguments)['stereo_camera'].arguments
        assert after(camera, '-p')[-1] == f'lossless:={is_lossless}', arguments
    tf = ['/tf:=tf', '/tf_static:=tf_static']
    for process in launched(namespaced_tf='true', rviz='true', namespace='robot').values():
        assert after(process.arguments, '-r')[-2:] == tf
    assert all(process.respawn for process in launched(respawn='true').values())
    assert not any(process.respawn for process in launched().values())
    with pytest.raises(ValueError, match='rviz:=maybe: expected true or false'):
        launched(rviz='maybe')


def test_without_rviz_nothing_is_started(launched, monkeypatch) -> None:
    monkeypatch.delitem(launch_stand_in.SHARE, 'rviz2')
    with pytest.raises(RuntimeError, match='rviz:=true needs the package rviz2: apt install'):
        launched(rviz='true')
    assert launched().keys() == STAGES


def test_the_topics_of_rviz_are_relative_to_the_namespace() -> None:
    layout = yaml.safe_load((FOLDER / 'segfloor.rviz').read_text())
    topics = list(topics_of(layout))
    assert {'map', 'keyframe/path', 'obstacle_points'} <= set(topics)
    assert not [topic for topic in topics if topic.startswith('/')]


def topics_of(found) -> Iterator[str]:
    """Yield the topics of a layout."""
    if isinstance(found, list):
        for one in found:
            yield from topics_of(one)
    elif isinstance(found, dict):
        for name, value in found.items():
            if name.endswith('Topic') and isinstance(value, dict):
                yield value['Value']
            else:
                yield from topics_of(value)


def remappings(process) -> dict[str, str]:
    """Return the remappings of a process."""
    found = (word.split(':=') for word in after(process.arguments, '-r'))
    return {source: target for source, target in found if not source.startswith('__')}


def test_topics_are_arguments(launched) -> None:
    names = {
        'left_image': '/cam/left/image_mono', 'right_image': '/cam/right/image_mono',
        'left_camera_info': '/cam/left/info', 'right_camera_info': '/cam/right/info',
        'depth': '/cam/depth', 'odometry': '/wheels/odom', 'imu': '/imu/data',
    }  # fmt: skip
    expected = {
        'left/image_raw': '/cam/left/image_mono', 'right/image_raw': '/cam/right/image_mono',
        'left/image_raw/compressed': '/cam/left/image_mono/compressed',
        'right/image_raw/compressed': '/cam/right/image_mono/compressed',
        'left/camera_info': '/cam/left/info', 'right/camera_info': '/cam/right/info',
        'depth/image_raw': '/cam/depth', 'wheel_odometry': '/wheels/odom', 'imu': '/imu/data',
    }  # fmt: skip
    for node in ('stereo_slam', 'floor_segmentation'):
        process = launched(**names)[node]
        assert remappings(process) == expected
        assert 'image_kind:=raw' in after(process.arguments, '-p')
    assert remappings(launched(BAG, bag='/b', **names)['stereo_slam']) == expected
    assert remappings(launched()['stereo_slam']) == {}
    rectified = launched(left_image='/l/rect/compressed', right_image='/r/rect/compressed')
    found = remappings(rectified['stereo_slam'])
    assert found['left/camera_info'] == '/l/camera_info'
    assert found['left/image_rect/compressed'] == '/l/rect/compressed'
    assert 'image_kind:=rect' in after(rectified['stereo_slam'].arguments, '-p')


@pytest.mark.parametrize(
    ('left', 'right', 'left_info', 'right_info'),
    [
        ('/cam/left_image', '/cam/right_image', None, None),
        ('left_image', 'right_image', None, None),
        ('/cam/left_image/compressed', '/cam/right_image/compressed', None, None),
        ('/cam/l/image', '/cam/r/image', '/cam/l/camera_info', '/cam/r/camera_info'),
        ('/cam/image', '/cam/right/image', '/cam/camera_info', '/cam/right/camera_info'),
        ('/cam/color/image', '', '/cam/color/camera_info', None),
        ('image', '', 'camera_info', None),
    ],
)
def test_no_calibration_is_taken_for_both_cameras(
    launched, left, right, left_info, right_info
) -> None:
    found = remappings(launched(left_image=left, right_image=right)['stereo_slam'])
    assert found['left/image_raw'] == left.removesuffix('/compressed')
    assert (found.get('left/camera_info'), found.get('right/camera_info')) == (
        left_info,
        right_info,
    )


@pytest.mark.parametrize('topic', ['/', '//', '.'])
def test_an_image_without_a_name_is_refused(launched, topic) -> None:
    with pytest.raises(ValueError, match=r'right_image:=.*: expected the name of a topic'):
        launched(left_image='/cam/left/image', right_image=topic)


@pytest.mark.parametrize(
    ('camera', 'left', 'kind'),
    [
        ('realsense', '/camera/camera/infra1/image_rect_raw', 'rect'),
        ('zed', '/zed/zed_node/left/color/rect/image', 'rect'),
        ('oak', '/oak/left/image_rect', 'rect'),
        ('orbbec', '/camera/left_ir/image_raw', 'raw'),
    ],
)
def test_a_camera_is_called_by_its_name(launched, camera, left, kind) -> None:
    processes = launched(camera=camera)
    assert processes.keys() == STAGES
    slam = processes['stereo_slam']
    found = remappings(slam)
    assert found[f'left/image_{kind}'] == left
    assert {f'{s}/{n}' for s in ('left', 'right') for n in ('camera_info', f'image_{kind}')} <= (
        found.keys()
    )
    assert len(set(found.values())) == len(found), 'each topic once'
    assert f'image_kind:={kind}' in after(slam.arguments, '-p')
    files = [Path(file).name for file in after(slam.arguments, '--params-file')]
    assert files[:2] == [f'camera_{camera}.yaml', 'default.yaml']
    mine = remappings(launched(camera=camera, left_image='/mine/image_raw')['stereo_slam'])
    assert mine['left/image_raw'] == '/mine/image_raw'


@pytest.mark.parametrize(
    ('camera', 'left', 'depth', 'kind'),
    [
        (
            'realsense',
            '/camera/camera/color/image_raw',
            '/camera/camera/aligned_depth_to_color/image_raw',
            'raw',
        ),
        (
            'zed',
            '/zed/zed_node/left/color/rect/image',
            '/zed/zed_node/depth/depth_registered',
            'rect',
        ),
        ('oak', '/oak/rgb/image_raw', '/oak/stereo/image_raw', 'raw'),
        ('orbbec', '/camera/color/image_raw', '/camera/depth/image_raw', 'raw'),
    ],
)
def test_the_depth_of_a_camera_is_called_by_its_name(launched, camera, left, depth, kind) -> None:
    slam = launched(camera=f'{camera}_depth')['stereo_slam']
    found = remappings(slam)
    assert found[f'left/image_{kind}'] == left
    assert found['depth/image_raw'] == depth
    assert not any(name.startswith('right/') for name in found)
    files = [Path(file) for file in after(slam.arguments, '--params-file')]
    assert files[0].name == f'camera_{camera}_depth.yaml'
    given = yaml.safe_load((REPOSITORY / 'params' / files[0].name).read_text())
    assert given['/**/stereo_slam']['ros__parameters']['use_depth'] is True


def test_a_camera_that_is_not_known_is_refused_with_those_that_are(launched) -> None:
    with pytest.raises(ValueError, match=r'camera:=kinect: .*realsense, zed, oak, orbbec'):
        launched(camera='kinect')


def test_rviz_shows_the_layout_of_the_package(launched, tmp_path) -> None:
    assert after(launched(rviz='true')['rviz2'].arguments, '-d') == [str(FOLDER / 'segfloor.rviz')]
    mine = launched(rviz='true', rviz_config='/mine.rviz')['rviz2']
    assert after(mine.arguments, '-d') == ['/mine.rviz']


def test_a_bag_is_played_with_its_own_time(launched, monkeypatch) -> None:
    monkeypatch.delenv('FASTRTPS_DEFAULT_PROFILES_FILE', raising=False)
    processes = launched(BAG, bag='/b', rate='0.5', log_level='warn', composed='true')
    player = processes['ros2']
    words = 'bag play /b --clock --rate 0.5 --delay 5.0'
    assert player.arguments == words.split()
    (named,) = player.environment.values()
    assert Path(named) == REPOSITORY / 'params' / 'fastdds.xml'
    pipeline = processes['segfloor_pipeline'].arguments
    assert after(pipeline, '--log-level') == ['warn']
    assert 'use_sim_time: true' in Path(after(pipeline, '--params-file')[-1]).read_text()
    assert processes.keys() == {'ros2', 'segfloor_pipeline'}
    assert launched(BAG, bag='/b').keys() == {'ros2', *STAGES}
    with pytest.raises(AssertionError, match='bag has no value'):
        launched(BAG)
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', '/mine.xml')
    assert set(launched(BAG, bag='/b')['ros2'].environment.values()) == {'/mine.xml'}


def test_a_simulated_robot_comes_in_place_of_the_camera(launched, monkeypatch, tmp_path) -> None:
    processes = launched(SIMULATION, scene='lane', robot='husky')
    assert processes.keys() == {'simulated_robot', *STAGES}
    files = after(processes['simulated_robot'].arguments, '--params-file')
    own = [yaml.safe_load(Path(file).read_text()) for file in files]
    assert {'scene': 'lane', 'robot': 'husky'} in [
        values['ros__parameters'] for file in own for values in file.values()
    ]
    slam = processes['stereo_slam'].arguments
    assert 'use_sim_time: true' in Path(after(slam, '--params-file')[-1]).read_text()
    (tmp_path / 'launch').mkdir()
    (tmp_path / 'launch' / 'navigation_launch.py').write_text(NAV2_STAND_IN)
    monkeypatch.setitem(launch_stand_in.SHARE, 'nav2_bringup', tmp_path)
    nav2 = launched(SIMULATION, nav2='true')['nav2']
    assert nav2.arguments == [str(REPOSITORY / 'params' / 'nav2.yaml'), 'true']


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_it_loads(path) -> None:
    launch = pytest.importorskip('launch', reason='launch is not among the pip wheels')
    pytest.importorskip('launch_ros')
    spec = importlib.util.spec_from_file_location('launch_file', path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules['launch_file'] = module
    spec.loader.exec_module(module)
    assert isinstance(module.generate_launch_description(), launch.LaunchDescription)
