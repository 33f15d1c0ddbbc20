"""The import rules of the package, read from the source."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / 'segfloor_ros'
MODULES = sorted(PACKAGE.rglob('*.py'))
ROS_FREE_ROOMS = (
    'camera', 'slam', 'floor', 'cloud', 'grid', 'evaluation', 'simulation', 'navigation',
    'semantics',
)  # fmt: skip
ROS = {
    'rclpy', 'rcl_interfaces', 'tf2_ros', 'launch', 'launch_ros', 'ament_index_python', 'cv_bridge',
    'rosbag2_py', 'message_filters', 'builtin_interfaces',
}  # fmt: skip
# What belongs to one room or to a command only; the others must do without it.
ONLY_IN = {
    'typer': ('cli',),
    'rich': ('cli',),
    'mujoco': ('simulation',),
    'rosbags': ('camera', 'cli'),
    'evo': ('evaluation',),
    'matplotlib': ('evaluation', 'cli'),
    'distributed': ('suite',),
    'fsspec': ('suite',),
    'junitparser': ('suite',),
    'rerun': ('cli',),
    'onnxruntime': ('semantics',),
}
FLOW = ('camera', 'slam', 'floor', 'cloud', 'grid')
"""Data flows one way: a stage may know the data of the stages before it, not of those behind it."""


def is_ros(name: str) -> bool:
    top = name.split('.')[0]
    return top in ROS or top.endswith(('_msgs', '_srvs'))


def imports_of(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: relative import'
            assert node.module is not None
            yield node.module
            yield from (f'{node.module}.{alias.name}' for alias in node.names)


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix('.py')


def rooms_imported(path: Path) -> set[str]:
    names = (name.split('.') for name in imports_of(path))
    return {name[1] for name in names if name[0] == 'segfloor_ros' and len(name) > 1}


@pytest.mark.parametrize('path', MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_a_module_keeps_to_the_rules(path) -> None:
    room, names = room_of(path), set(imports_of(path))
    if room not in ('messages', 'nodes', 'cli'):
        assert not {name for name in names if is_ros(name)}, 'ROS outside of messages, nodes, cli'
    if room != 'nodes':
        assert 'nodes' not in rooms_imported(path)
    if room != 'cli':
        assert 'cli' not in rooms_imported(path)
    assert not any(name.split('.')[0] in ('tools', 'test') for name in names)
    if room in ROS_FREE_ROOMS:
        assert 'messages' not in rooms_imported(path)
        assert 'pipeline' not in rooms_imported(path)
    for package, rooms in ONLY_IN.items():
        if any(name.split('.')[0] == package for name in names):
            assert room in rooms, f'{package} is for {rooms}'


@pytest.mark.parametrize('room', FLOW)
def test_a_stage_knows_nothing_of_the_stages_behind_it(room) -> None:
    behind = set(FLOW[FLOW.index(room) + 1 :])
    for path in MODULES:
        if room_of(path) == room:
            assert not rooms_imported(path) & behind, path.relative_to(PACKAGE)


def test_ros_in_the_commands_is_for_replay_recorder_and_exploration_alone() -> None:
    for path in MODULES:
        if room_of(path) == 'cli' and not path.stem.startswith(
            ('replay_', 'topic_recorder', 'explore_')
        ):
            ros = {name for name in imports_of(path) if is_ros(name)}
            assert not ros, path.relative_to(PACKAGE)


def test_no_two_test_files_share_a_name() -> None:
    """pytest imports them by name: two of one name fail, though each passes by itself."""
    names = [path.name for path in Path(__file__).parent.rglob('test_*.py')]
    assert len(names) == len(set(names))


def test_every_room_is_a_package_with_a_purpose() -> None:
    for path in PACKAGE.rglob('__init__.py'):
        assert ast.get_docstring(ast.parse(path.read_text())), path


def test_the_rules_catch_what_they_are_for(tmp_path) -> None:
    module = tmp_path / 'module.py'
    module.write_text('import sensor_msgs.msg\nfrom rclpy.node import Node\nimport numpy\n')
    assert {name for name in imports_of(module) if is_ros(name)} == {
        'sensor_msgs.msg',
        'rclpy.node',
        'rclpy.node.Node',
    }


def test_what_a_program_runs_comes_after_all_that_it_defines():
    for path in MODULES:
        mains = [
            isinstance(part, ast.If) and '__name__' in ast.dump(part.test)
            for part in ast.parse(path.read_text()).body
        ]
        assert not any(mains[:-1]), path


def test_no_class_is_above_twenty_methods() -> None:
    for path in MODULES:
        for part in ast.walk(ast.parse(path.read_text())):
            if isinstance(part, ast.ClassDef):
                methods = [one for one in part.body if isinstance(one, ast.FunctionDef)]
                assert len(methods) <= 20, f'{path}: {part.name}'
