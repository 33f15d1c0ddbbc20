"""The import rules of the package, read from the source."""

import ast
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from segfloor_ros.apps.programs import APPS
from tools import closure as closures
from tools.closure import circles, closure

PACKAGE = Path(__file__).resolve().parents[1] / 'segfloor_ros'
MODULES = sorted(PACKAGE.rglob('*.py'))
STOREYS = ('core', 'nodes', 'apps')
"""From the lowest up: what lies lower imports nothing that lies higher."""
ROS = {
    'rclpy', 'rcl_interfaces', 'tf2_ros', 'launch', 'launch_ros', 'ament_index_python', 'cv_bridge',
    'rosbag2_py', 'message_filters', 'builtin_interfaces',
}  # fmt: skip
CORE_USES = {'numpy', 'cv2', 'scipy', 'segfloor_ros', *sys.stdlib_module_names}
# What belongs to one room or to a command only; the others must do without it.
ONLY_IN = {
    'typer': ('apps.cli',),
    'rich': ('apps.cli',),
    'mujoco': ('apps.simulation',),
    'rosbags': ('apps.recordings', 'apps.cli'),
    'evo': ('apps.evaluation',),
    'matplotlib': ('apps.evaluation', 'apps.cli'),
    'distributed': ('apps.suite',),
    'fsspec': ('apps.suite',),
    'junitparser': ('apps.suite',),
    'rerun': ('apps.cli',),
    'onnxruntime': ('core.plugins.semantics',),
}
STAGES = ('slam', 'floor', 'cloud', 'grid')
"""Data flows from left to right; what passes between them is in `core.contracts`."""

CEILINGS = {
    'core.pipeline': 9400,
    'core.slam.stereo_slam': 6050,
    'core.floor.segmentation': 2800,
    'core.cloud': 750,
    'core.grid.mapper': 1400,
    'nodes.stereo_camera': 3550,
    'nodes.stereo_slam': 9700,
    'nodes.floor_segmentation': 4900,
    'nodes.cloud_labelling': 3000,
    'nodes.occupancy_grid': 3350,
    'apps.cli.main': 415,
}
"""Code lines that a reader must load to understand a module (`tools.closure`). They may only fall:
a feature that does not fit is a plug-in, or belongs to another storey."""


def is_ros(name: str) -> bool:
    top = name.split('.')[0]
    return top in ROS or top.endswith(('_msgs', '_srvs'))


@cache
def imports_of(path: Path) -> tuple[str, ...]:
    return tuple(names_imported(ast.parse(path.read_text()), path))


def names_imported(tree: ast.Module, path: Path) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: relative import'
            assert node.module is not None
            yield node.module
            yield from (f'{node.module}.{alias.name}' for alias in node.names)


def name_of(path: Path) -> str:
    """Return the name of a module within the package, e.g. `core.slam.rig`."""
    return '.'.join(path.relative_to(PACKAGE).with_suffix('').parts).removesuffix('.__init__')


def imported_modules(path: Path) -> set[str]:
    """Return what a module imports of the package, also within functions, by names within it."""
    names = (name.partition('.') for name in imports_of(path))
    return {rest for top, _, rest in names if top == 'segfloor_ros' and rest}


def is_in(name: str, room: str) -> bool:
    return name == room or name.startswith(f'{room}.')


@pytest.mark.parametrize('path', MODULES, ids=name_of)
def test_a_module_keeps_to_the_rules(path) -> None:
    name, names = name_of(path), set(imports_of(path))
    tops = {imported.split('.')[0] for imported in names}
    assert not tops & {'tools', 'test'}
    for package, rooms in ONLY_IN.items():
        if package in tops:
            assert any(is_in(name, room) for room in rooms), f'{package} is for {rooms}'
    if name == '__init__':
        return
    storey = name.partition('.')[0]
    higher = STOREYS[STOREYS.index(storey) + 1 :]
    assert not {one for one in imported_modules(path) if one.partition('.')[0] in higher}
    if storey == 'core' and name != 'core.plugins.semantics.network':  # may use onnxruntime
        assert tops <= CORE_USES


@pytest.mark.parametrize('stage', STAGES)
def test_a_stage_imports_neither_other_stages_nor_plugins(stage) -> None:
    others = [f'core.{room}' for room in (*STAGES, 'plugins', 'pipeline') if room != stage]
    for path in MODULES:
        if is_in(name_of(path), f'core.{stage}'):
            found = {n for n in imported_modules(path) for other in others if is_in(n, other)}
            assert not found, path.relative_to(PACKAGE)


def test_plugins_are_imported_by_no_part_of_the_core() -> None:
    for path in MODULES:
        name = name_of(path)
        if is_in(name, 'core') and not is_in(name, 'core.plugins'):
            assert not [n for n in imported_modules(path) if is_in(n, 'core.plugins')], name


def test_no_modules_import_one_another_in_a_circle() -> None:
    assert not circles()


@pytest.mark.parametrize('entry', CEILINGS)
def test_what_a_reader_must_load_only_shrinks(entry) -> None:
    assert sum(closure(entry).values()) <= CEILINGS[entry]


def test_a_closure_holds_imports_for_types_but_not_those_of_functions(
    tmp_path, monkeypatch
) -> None:
    package = tmp_path / 'segfloor_ros'
    package.mkdir()
    (package / '__init__.py').write_text('"""Nothing."""\n')
    (package / 'a.py').write_text(
        'from typing import TYPE_CHECKING\n\n# A comment.\nif TYPE_CHECKING:\n'
        '    from segfloor_ros import b\n\n\ndef f():\n    import segfloor_ros.c\n'
    )
    (package / 'b.py').write_text('import segfloor_ros.a\n\nB = 1\n')
    (package / 'c.py').write_text('C = 1\n')
    monkeypatch.setattr(closures, 'PACKAGE', package)
    monkeypatch.setattr(closures, 'imported_by', closures.imported_by.__wrapped__)
    assert closure('a') == {'segfloor_ros': 0, 'segfloor_ros.a': 5, 'segfloor_ros.b': 2}
    assert circles() == [{'segfloor_ros.a', 'segfloor_ros.b'}]


def test_ros_in_the_apps_is_for_nodes_replay_recorder_and_exploration_alone() -> None:
    """The apps that are nodes are programs; `recordings.ros_bag` reads with ROS where it is."""
    programs = tuple(module.removeprefix('segfloor_ros.') for module in APPS.values())
    begin = ('apps.cli.replay_', 'apps.cli.topic_recorder', 'apps.cli.explore_')
    for path in MODULES:
        name = name_of(path)
        if not name.startswith((*begin, *programs, 'apps.recordings.ros_bag', 'nodes.')):
            ros = {imported for imported in imports_of(path) if is_ros(imported)}
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
