"""`launch` and `launch_ros` for machines without them: as much as the launch files use, with the
signatures of Jazzy and the command lines that it makes of nodes.

What is unknown there is refused here too: a keyword, an argument of an included file, an argument
without a value.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import yaml

SHARE: dict[str, Path] = {}
"""Where packages are installed, by name."""


@dataclass
class LaunchContext:
    """The values of the arguments, and the processes so far."""

    launch_configurations: dict[str, str]
    folder: Path
    processes: list[Process] = field(default_factory=list)


@dataclass
class Process:
    """A process that would be started: what of which package, with which command line."""

    package: str
    executable: str
    arguments: list[str]
    environment: dict[str, str]
    respawn: bool = False


def text(context: LaunchContext, found: Any) -> str:
    """Return what a text or a substitution stands for."""
    if isinstance(found, str):
        return found
    assert hasattr(found, 'perform'), f'{found!r} is neither text nor substitution'
    return found.perform(context)


class LaunchConfiguration:
    """The value of an argument."""

    def __init__(self, variable_name: str, *, default: Any = None) -> None:
        self.name, self.default = variable_name, default

    def perform(self, context: LaunchContext) -> str:
        """Return the value."""
        if self.default is not None and self.name not in context.launch_configurations:
            return text(context, self.default)
        return context.launch_configurations[self.name]


class EnvironmentVariable:
    """A variable of the environment."""

    def __init__(self, name: str, *, default_value: Any = None) -> None:
        self.name, self.default_value = name, default_value

    def perform(self, context: LaunchContext) -> str:
        """Return its value."""
        return os.environ.get(self.name) or text(context, self.default_value)


class PathJoinSubstitution:
    """A path of several parts."""

    def __init__(self, substitutions: list[Any]) -> None:
        self.parts = list(substitutions)

    def perform(self, context: LaunchContext) -> str:
        """Return the path."""
        return os.path.join(*(text(context, part) for part in self.parts))


class FindPackageShare:
    """The share folder of a package."""

    def __init__(self, package: str) -> None:
        self.package = package

    def perform(self, context: LaunchContext) -> str:
        """Return the folder."""
        return str(SHARE[self.package])


class DeclareLaunchArgument:
    """An argument of a launch file."""

    def __init__(
        self,
        name: str,
        *,
        default_value: Any = None,
        description: str | None = None,
        choices: list[str] | None = None,
    ) -> None:
        self.name, self.default_value, self.choices = name, default_value, choices
        self.description = description

    def execute(self, context: LaunchContext) -> None:
        """Give it a value."""
        if self.name not in context.launch_configurations:
            assert self.default_value is not None, f'{self.name} has no value'
            value = text(context, self.default_value)
            context.launch_configurations[self.name] = value
        assert not self.choices or context.launch_configurations[self.name] in self.choices


class OpaqueFunction:
    """A function that makes actions."""

    def __init__(self, *, function: Any, args: Any = None, kwargs: Any = None) -> None:
        self.function, self.args, self.kwargs = function, args or (), kwargs or {}

    def execute(self, context: LaunchContext) -> None:
        """Execute what it makes."""
        for action in self.function(context, *self.args, **self.kwargs) or ():
            action.execute(context)


class LaunchDescription:
    """Actions in order."""

    def __init__(self, initial_entities: list[Any] | None = None) -> None:
        self.entities = list(initial_entities or ())

    def execute(self, context: LaunchContext) -> None:
        """Execute them."""
        for entity in self.entities:
            entity.execute(context)


class PythonLaunchDescriptionSource:
    """A launch file in Python."""

    def __init__(self, launch_file_path: Any) -> None:
        self.path = launch_file_path


class IncludeLaunchDescription:
    """Another launch file, with values for its arguments; these stay, as in `launch`."""

    def __init__(self, launch_description_source: Any, *, launch_arguments: Any = None) -> None:
        self.source, self.arguments = launch_description_source, list(launch_arguments or ())

    def execute(self, context: LaunchContext) -> None:
        """Execute the file."""
        description = load(Path(text(context, self.source.path)))
        known = {e.name for e in description.entities if isinstance(e, DeclareLaunchArgument)}
        for name, value in self.arguments:
            assert name in known, f'{self.source.path} has no argument {name}'
            context.launch_configurations[name] = text(context, value)
        description.execute(context)


class ExecuteProcess:
    """A command."""

    def __init__(self, *, cmd: list[Any], output: str = 'log', additional_env: Any = None) -> None:
        assert output in ('log', 'screen', 'both', 'own_log', 'full')
        self.cmd, self.environment = list(cmd), dict(additional_env or {})

    def execute(self, context: LaunchContext) -> None:
        """Note it."""
        executable, *words = (text(context, word) for word in self.cmd)
        environment = {name: text(context, value) for name, value in self.environment.items()}
        context.processes.append(Process('', executable, words, environment))


class Node:
    """A process with the arguments of ROS, in the order of `launch_ros.actions.Node`."""

    def __init__(
        self,
        *,
        executable: str,
        package: str | None = None,
        name: str | None = None,
        namespace: Any = None,
        parameters: list[Any] | None = None,
        remappings: list[tuple[str, str]] | None = None,
        ros_arguments: list[Any] | None = None,
        arguments: list[Any] | None = None,
        respawn: bool = False,
        respawn_delay: float | None = None,
        output: str = 'log',
    ) -> None:
        assert isinstance(parameters or [], list)
        assert isinstance(ros_arguments or [], list)
        assert output in ('log', 'screen', 'both', 'own_log', 'full')
        assert respawn_delay is None or respawn_delay >= 0
        self.package, self.executable, self.name = package or '', executable, name
        self.namespace, self.parameters = namespace, parameters or []
        self.remappings, self.respawn = remappings or [], respawn
        self.ros_arguments, self.arguments = ros_arguments, arguments or []

    def execute(self, context: LaunchContext) -> None:
        """Note it."""
        words = [text(context, word) for word in self.arguments]
        if self.ros_arguments is not None:
            words += ['--ros-args', *(text(context, word) for word in self.ros_arguments)]
        words.append('--ros-args')
        full_name = '/**'
        if self.name is not None:
            words += ['-r', f'__node:={self.name}']
        if self.namespace is not None:
            namespace = '/' + text(context, self.namespace).lstrip('/')
            words += ['-r', f'__ns:={namespace}']
            full_name = f'{namespace.rstrip("/")}/{self.name}' if self.name else full_name
        for found in self.parameters:
            words += ['--params-file', self._file(context, found, full_name)]
        for source, target in self.remappings:
            words += ['-r', f'{source}:={target}']
        context.processes.append(Process(self.package, self.executable, words, {}, self.respawn))

    def _file(self, context: LaunchContext, found: Any, full_name: str) -> str:
        if not isinstance(found, dict):
            path = text(context, found)
            assert Path(path).is_file(), path
            return path
        file = context.folder / f'launch_params_{len(list(context.folder.iterdir()))}'
        file.write_text(yaml.dump({full_name: {'ros__parameters': found}}))
        return str(file)


NAMES = {
    'launch': (LaunchContext, LaunchDescription),
    'launch.actions': (
        DeclareLaunchArgument,
        ExecuteProcess,
        IncludeLaunchDescription,
        OpaqueFunction,
    ),
    'launch.launch_description_sources': (PythonLaunchDescriptionSource,),
    'launch.substitutions': (EnvironmentVariable, LaunchConfiguration, PathJoinSubstitution),
    'launch_ros': (),
    'launch_ros.actions': (Node,),
    'launch_ros.substitutions': (FindPackageShare,),
}


def modules() -> dict[str, ModuleType]:
    """Return the modules under the names of the real ones."""
    made = {name: ModuleType(name) for name in NAMES}
    for name, kinds in NAMES.items():
        for kind in kinds:
            setattr(made[name], kind.__name__, kind)
    return made


def load(path: Path) -> LaunchDescription:
    """Return the description of a launch file."""
    spec = importlib.util.spec_from_file_location(path.stem.replace('.', '_'), path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    kept = {name: sys.modules.get(name) for name in NAMES}
    sys.modules.update(modules())
    try:
        spec.loader.exec_module(module)
        return module.generate_launch_description()
    finally:
        for name, before in kept.items():
            sys.modules.pop(name)
            if before is not None:
                sys.modules[name] = before


def launch(path: Path, folder: Path, arguments: dict[str, str]) -> list[Process]:
    """Return the processes that `ros2 launch` would start. Raises AssertionError for an argument
    that the file does not have. folder: for files of parameters.
    """
    description = load(path)
    known = {e.name for e in description.entities if isinstance(e, DeclareLaunchArgument)}
    assert arguments.keys() <= known, arguments.keys() - known
    context = LaunchContext(dict(arguments), folder)
    description.execute(context)
    return context.processes
