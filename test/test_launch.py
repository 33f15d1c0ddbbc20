"""The launch files: executed by a stand-in for `launch`, which the wheels lack, down to processes
that run; and by `launch` itself where it is installed.
"""

from __future__ import annotations

import ast
import importlib.util
import itertools
import sys
from pathlib import Path

import launch_stand_in
import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDER = REPOSITORY / 'launch_configs'
FILES = sorted(FOLDER.glob('*.launch.py'))
SEGFLOOR, BAG = FOLDER / 'segfloor.launch.py', FOLDER / 'bag.launch.py'
NODES = {
    'stereo_camera', 'stereo_slam', 'floor_segmentation', 'cloud_labelling', 'occupancy_grid',
}  # fmt: skip
STAGES = NODES - {'stereo_camera'}
ARGUMENTS = {
    'namespace', 'params_file', 'use_sim_time', 'input', 'camera', 'composed', 'autostart',
    'respawn', 'namespaced_tf', 'log_level', 'lossless', 'rviz', 'rviz_config',
}  # fmt: skip


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
    assert path != SEGFLOOR or names == ARGUMENTS


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_only_launch_is_imported(path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.module is not None
            assert node.module.split('.')[0] in ('launch', 'launch_ros')
        assert not isinstance(node, ast.Import)


@pytest.fixture
def launched(monkeypatch, tmp_path):
    """Return the processes that a launch file makes of arguments, by executable."""
    monkeypatch.setitem(launch_stand_in.SHARE, 'segfloor_ros', REPOSITORY)

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
