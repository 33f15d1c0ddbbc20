"""The launch files: what can be checked without `launch`, and the rest where it is installed."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path

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
    assert declared == {'namespace', 'params_file', 'use_sim_time', 'input', 'composed'}


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_it_loads(path) -> None:
    launch = pytest.importorskip('launch', reason='launch is not among the pip wheels')
    pytest.importorskip('launch_ros')
    spec = importlib.util.spec_from_file_location('launch_file', path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert isinstance(module.generate_launch_description(), launch.LaunchDescription)
