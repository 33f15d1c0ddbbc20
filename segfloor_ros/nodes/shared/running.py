"""The program of a node: its arguments, its parameters with descriptors, ranges and checks, and its
run until it is interrupted, on a middleware that is set up for stereo images.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import logging
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import cv2
import rclpy
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.utilities import remove_ros_args

from segfloor_ros.core.errors import SegfloorError, SettingsError
from segfloor_ros.core.settings import SettingSpec, suggestion
from segfloor_ros.nodes.messages.topics import prepare_middleware
from segfloor_ros.nodes.settings.shared import ROS_PARAMETERS, NodeSettings

INTERRUPT_HEARD_S = 0.2

HELP = ('-h', '--help')

M_ARENA_MAX = -8
"""Of glibc's malloc.h."""

Settings = TypeVar('Settings', bound=NodeSettings)


def run_node(make_node: Callable[[], Node]) -> None:
    """Run a node until it is interrupted (status 0); bad parameters or input end it with one
    line and status 2.
    """
    run_nodes(lambda: [make_node()])


def check_arguments(arguments: Sequence[str]) -> None:
    """End the process on arguments that are not of ROS: with help on --help and -h, with one line
    and status 2 on others.
    """
    program, *others = remove_ros_args(list(arguments))
    if any(word in HELP for word in others):
        print(help_text(Path(program).stem))
        sys.exit(0)
    if others:
        print(
            f'segfloor: unknown argument {others[0]}; parameters are given as --ros-args -p '
            'NAME:=VALUE, and --help lists them',
            file=sys.stderr,
        )
        sys.exit(2)


def help_text(program: str) -> str:
    """Return what a node's program takes, with the parameters of the node."""
    from segfloor_ros.nodes.configuration import NODE_SETTINGS  # of all nodes

    lines = [
        f'usage: {program} [--ros-args [-p NAME:=VALUE] [--params-file FILE] [-r FROM:=TO]]',
        '',
    ]
    for node in [program] if program in NODE_SETTINGS else NODE_SETTINGS:
        lines.append(f'parameters of {node}:')
        for spec in NODE_SETTINGS[node].specs():
            unit = f' {spec.unit}' if spec.unit else ''
            lines.append(f'  {spec.name} (default {spec.default!r}{unit}): {spec.description}')
    return '\n'.join(lines)


def _share_one_heap() -> None:
    """Let all threads of this process take their memory from one heap: each of its own keeps what
    it once needed. Where there is no glibc, nothing changes.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, 1)


def _begin_ros(arguments: Sequence[str]) -> None:
    try:
        check_arguments(arguments)
        rclpy.init()
    except Exception as error:  # of several kinds, for arguments and files that rcl cannot read
        text = ' '.join(str(error).split()).partition(', at ')[0]
        raise SettingsError(f'ROS does not take the arguments: {text}') from None


def _interrupt(number: int, frame: object) -> None:
    """End the process in order. A second interrupt must not break off what the first has begun."""
    signal.signal(signal.SIGINT, _ignore)
    raise KeyboardInterrupt


def _ignore(number: int, frame: object) -> None:
    """Not SIG_IGN: rclpy gives back the handler that it found to Python."""


def run_nodes(make_nodes: Callable[[], Sequence[Node]]) -> None:
    """Run nodes in one executor, like `run_node`."""
    logging.basicConfig(format='segfloor: %(message)s', level=logging.WARNING)
    status = 0
    nodes: Sequence[Node] = ()
    signal.signal(signal.SIGINT, _interrupt)
    for number in (signal.SIGTERM, signal.SIGHUP):  # rclpy handles SIGTERM later
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt)
    try:
        _share_one_heap()
        cv2.setNumThreads(-1)  # OpenCV with TBB asks the environment only then
        prepare_middleware()
        _begin_ros(sys.argv)
        executor = SingleThreadedExecutor()
        nodes = make_nodes()
        for node in nodes:
            executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except SegfloorError as error:
        print(f'segfloor: {error}', file=sys.stderr)
        status = 2
    except Exception:
        # An interrupt takes the middleware away under whatever is being done at that moment, and
        # may be heard of a little later than what it broke.
        with contextlib.suppress(KeyboardInterrupt):
            time.sleep(INTERRUPT_HEARD_S)
        if rclpy.ok():
            raise
    finally:
        signal.signal(signal.SIGINT, _ignore)
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
        # Python gives its own handlers up before it ends.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.exit(status)


def descriptor(spec: SettingSpec) -> ParameterDescriptor:
    """Return the descriptor of a setting. The type stays open, so that the check of the setting
    says what is wrong.
    """
    result = ParameterDescriptor(
        name=spec.name,
        description=spec.description + (f' [{spec.unit}]' if spec.unit else ''),
        additional_constraints=spec.range_text(),
        read_only=not spec.live,
        dynamic_typing=True,
    )
    low, high = spec.within or (0, 0)
    if spec.type is int and spec.within:
        result.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=0)]
    # rclpy holds not-a-number ("to be measured") to be out of every range.
    elif spec.within and spec.default == spec.default:
        ends = {'from_value': float(low), 'to_value': float(high)}
        result.floating_point_range = [FloatingPointRange(**ends, step=0.0)]
    return result


class NodeParameters(Generic[Settings]):
    """The parameters of one node.

    The node must have been created with `automatically_declare_parameters_from_overrides`, which
    is how unknown names are found. on_change: called when live parameters have changed. Raises
    SettingsError naming parameter, value and range.
    """

    def __init__(self, node: Node, settings: Settings, on_change: Callable[[], None]) -> None:
        self.settings = settings
        self._on_change = on_change
        self._read_overrides(node)
        for spec in settings.specs():
            value = getattr(self.settings, spec.name)
            node.declare_parameter(spec.name, value, descriptor(spec), True)
        node.add_pre_set_parameters_callback(self._with_fractions)
        node.add_on_set_parameters_callback(self._change)

    def _with_fractions(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """Return parameters with `1` as 1.0 where the parameter has fractions."""
        types = {spec.name: spec.type for spec in self.settings.specs()}
        return [
            Parameter(p.name, value=float(p.value))
            if types.get(p.name) is float and type(p.value) is int
            else p
            for p in parameters
        ]

    def _change(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Take over new values of live parameters, or none of them with the reason."""
        try:
            self._replace({parameter.name: parameter.value for parameter in parameters})
        except SettingsError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self._on_change()
        return SetParametersResult(successful=True)

    def _replace(self, values: Mapping[str, Any]) -> None:
        """Take over those of the values that are this node's."""
        names = {spec.name for spec in self.settings.specs()} & values.keys()
        self.settings = self.settings.replaced(**{name: values[name] for name in names})

    def _read_overrides(self, node: Node) -> None:
        names = [
            name
            for name in node.get_parameters_by_prefix('')
            if name.partition('.')[0] not in ROS_PARAMETERS
        ]
        given = {name: node.get_parameter(name).value for name in names}
        self._refuse_unknown(given, node)
        given.update(self._command_line())
        self._replace(given)
        for name in given:
            node.undeclare_parameter(name)

    def _command_line(self) -> dict[str, Any]:
        """Return what the command line says of this node's parameters. It wins over files: rcl
        lets a file's section for the node win over a plain `-p name:=value` once any file has a
        section for all nodes.
        """
        specs = {spec.name: spec for spec in self.settings.specs()}
        assigned = command_line_parameters(sys.argv)
        return {name: _parsed(assigned[name], specs[name]) for name in assigned & specs.keys()}

    def _refuse_unknown(self, given: Mapping[str, Any], owner: Node) -> None:
        from segfloor_ros.nodes.configuration import NODE_SETTINGS, unread_sections  # of all nodes

        for line in unread_sections(sys.argv, owner.get_fully_qualified_name()):
            owner.get_logger().warning(line)
        known = [spec.name for spec in self.settings.specs()]
        for name in given:
            # A section `/**` of a parameter file reaches every node; names of other nodes are fine.
            if not any(settings.has(name) for settings in NODE_SETTINGS.values()):
                node = self.settings.stage_name()
                raise SettingsError(f'unknown parameter {node}.{name}{suggestion(name, known)}')


def command_line_parameters(arguments: Sequence[str]) -> dict[str, str]:
    """Return the parameters for any node that a command line assigns: `-p name:=value` between
    `--ros-args` and `--`.
    """
    assigned: dict[str, str] = {}
    is_for_ros = False
    for word, following in itertools.pairwise((*arguments, '')):
        if word in ('--ros-args', '--'):
            is_for_ros = word == '--ros-args'
        name, separator, value = following.partition(':=')
        if is_for_ros and word in ('-p', '--param') and separator and ':' not in name:
            assigned[name] = value
    return assigned


def _parsed(text: str, spec: SettingSpec) -> Any:
    from segfloor_ros.nodes.yaml_files import yaml_value

    value = yaml_value(text)
    return '' if value is None and spec.type is str else value
