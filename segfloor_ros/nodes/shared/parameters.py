"""ROS parameters from settings: descriptors, ranges, checks and changes while running."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Mapping, Sequence
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from segfloor_ros.configuration import ROS_PARAMETERS
from segfloor_ros.errors import SettingsError
from segfloor_ros.files.yaml_files import yaml_value
from segfloor_ros.node_settings import NODE_SETTINGS, NodeSettings, is_node_parameter
from segfloor_ros.settings import SettingSpec, suggestion

Settings = TypeVar('Settings', bound=NodeSettings)


def descriptor(spec: SettingSpec) -> ParameterDescriptor:
    """Return the descriptor of a setting. The type stays open, so that `1` is taken for 1.0 as on
    the command line; the check of the setting decides.
    """
    unit = f' [{spec.unit}]' if spec.unit else ''
    result = ParameterDescriptor(
        name=spec.name,
        description=spec.description + unit,
        additional_constraints=spec.range_text(),
        read_only=not spec.live,
        dynamic_typing=True,
    )
    if spec.within is None:
        return result
    low, high = spec.within
    if spec.type is int:
        result.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=0)]
    # rclpy holds not-a-number ("to be measured") to be out of every range.
    if spec.type is float and spec.default == spec.default:
        result.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
        ]
    return result


class NodeParameters(Generic[Settings]):
    """The parameters of one node.

    The node must have been created with `automatically_declare_parameters_from_overrides`, which
    is how unknown names are found. Raises SettingsError naming parameter, value and range.
    """

    def __init__(self, node: Node, settings: Settings) -> None:
        self.settings = settings
        self._read_overrides(node)
        for spec in settings.specs():
            value = getattr(self.settings, spec.name)
            node.declare_parameter(spec.name, value, descriptor(spec), True)

    def change(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Take over new values of live parameters, or none of them with the reason."""
        try:
            self._replace({parameter.name: parameter.value for parameter in parameters})
        except SettingsError as error:
            return SetParametersResult(successful=False, reason=str(error))
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
        self._refuse_unknown(given)
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

    def _refuse_unknown(self, given: Mapping[str, Any]) -> None:
        known = [spec.name for spec in self.settings.specs()]
        for name in given:
            # A section `/**` of a parameter file reaches every node; names of other nodes are fine.
            if not any(is_node_parameter(node, name) for node in NODE_SETTINGS):
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
    value = yaml_value(text)
    return '' if value is None and spec.type is str else value
