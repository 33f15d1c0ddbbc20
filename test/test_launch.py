"""The launch files: what can be checked without `launch`, and the rest where it is installed."""

from __future__ import annotations

import ast
import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

FOLDER = Path(__file__).resolve().parents[1] / 'launch_configs'
FILES = sorted(FOLDER.glob('*.launch.py'))
NODES = {
    'stereo_camera', 'stereo_slam', 'floor_segmentation', 'cloud_labelling', 'occupancy_grid',
}  # fmt: skip


def calls(tree: ast.AST, name: str) -> list[ast.Call]:
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == name
    ]


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_every_argument_is_described_and_used(path) -> None:
    tree = ast.parse(path.read_text())
    functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert 'generate_launch_description' in functions
    declared = set()
    for call in calls(tree, 'DeclareLaunchArgument'):
        assert isinstance(call.args[0], ast.Constant)
        declared.add(call.args[0].value)
        described = {k.arg: k.value for k in call.keywords}['description']
        assert isinstance(described, ast.Constant)
        assert described.value.endswith('.')
    used = {call.args[0].value for call in calls(tree, 'LaunchConfiguration')}
    assert declared == used
    assert {'namespace', 'params_file'} <= declared


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_only_launch_is_imported(path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.module is not None
            assert node.module.split('.')[0] in ('launch', 'launch_ros')
        assert not isinstance(node, ast.Import)


def test_the_five_nodes_are_started() -> None:
    tree = ast.parse((FOLDER / 'segfloor.launch.py').read_text())
    words = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    assert words >= NODES | {'segfloor_pipeline'}
    declared = {call.args[0].value for call in calls(tree, 'DeclareLaunchArgument')}
    assert declared == {
        'namespace', 'params_file', 'use_sim_time', 'input', 'camera', 'composed', 'autostart',
        'rviz', 'rviz_config',
    }  # fmt: skip


class Configuration:
    """A launch argument whose value is looked up in a plain mapping."""

    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: dict[str, str]) -> str:
        return context[self.name]


@pytest.fixture
def launched(monkeypatch):
    """Return the processes that arguments lead to, with stand-ins for `launch`, which the wheels
    lack: only what this package decides itself is tried.
    """
    names = ('launch', 'launch.actions', 'launch.substitutions', 'launch_ros',
             'launch_ros.actions', 'launch_ros.substitutions')  # fmt: skip
    for name in names:
        monkeypatch.setitem(sys.modules, name, MagicMock())
    sys.modules['launch.substitutions'].LaunchConfiguration = Configuration  # type: ignore
    sys.modules['launch_ros.actions'].Node = SimpleNamespace  # type: ignore
    spec = importlib.util.spec_from_file_location('launched', FOLDER / 'segfloor.launch.py')
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    defaults = {'input': '', 'camera': 'auto', 'composed': 'false', 'autostart': 'true',
                'use_sim_time': 'false', 'rviz': 'false'}  # fmt: skip

    def launched(**arguments: str):
        nodes = module.make_nodes({**defaults, **arguments})
        return {node.executable: node for node in nodes}

    return launched


STAGES = NODES - {'stereo_camera'}


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


def test_what_the_arguments_say_is_handed_on(launched) -> None:
    camera = launched(input="/it's a bag")['stereo_camera']
    assert camera.ros_arguments == ['-p', 'autostart:=true', '-p', "input:='/it''s a bag'"]
    assert launched(camera='true')['stereo_camera'].ros_arguments == ['-p', 'autostart:=true']
    slam = launched(autostart='no', use_sim_time='TRUE')['stereo_slam']
    assert slam.ros_arguments == ['-p', 'autostart:=false']
    assert slam.parameters[1] == {'use_sim_time': True}
    apart = launched(input='/a', camera='false', composed='true')['segfloor_pipeline']
    assert apart.ros_arguments[-1] == "input:=''"
    with pytest.raises(ValueError, match='rviz:=maybe: expected true or false'):
        launched(rviz='maybe')


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_it_loads(path) -> None:
    launch = pytest.importorskip('launch', reason='launch is not among the pip wheels')
    pytest.importorskip('launch_ros')
    spec = importlib.util.spec_from_file_location('launch_file', path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert isinstance(module.generate_launch_description(), launch.LaunchDescription)
