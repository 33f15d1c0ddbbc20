"""Where settings come from: defaults < parameter file < command line.

A parameter file is a plain ROS 2 parameter file; the nodes and the `segfloor` command read the
same one. The robot is one for all stages, whichever of them it was set for. The parameters of the
nodes are the settings of their stages, and what only nodes have: frames, rates, quality of service.
"""

from __future__ import annotations

import re
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from segfloor_ros.core.configuration import Configuration, merge
from segfloor_ros.core.errors import SettingsError, about
from segfloor_ros.core.files.whole import shortened
from segfloor_ros.core.settings import (
    GONE,
    ROBOT_PARAMETERS,
    RobotSettings,
    StageSettings,
    suggestion,
)
from segfloor_ros.nodes.settings.camera import StereoCameraNodeSettings
from segfloor_ros.nodes.settings.cloud import CloudLabellingNodeSettings
from segfloor_ros.nodes.settings.floor import FloorSegmentationNodeSettings
from segfloor_ros.nodes.settings.grid import OccupancyGridNodeSettings
from segfloor_ros.nodes.settings.masks import SegfloorMasksNodeSettings
from segfloor_ros.nodes.settings.robot import SimulatedRobotNodeSettings
from segfloor_ros.nodes.settings.shared import ROS_PARAMETERS, NodeSettings
from segfloor_ros.nodes.settings.slam import StereoSlamNodeSettings
from segfloor_ros.nodes.yaml_files import read_yaml, yaml_value

STAGE_SETTINGS: dict[str, type[StageSettings]] = typing.get_type_hints(Configuration)

ROBOT_STAGES = [name for name, cls in STAGE_SETTINGS.items() if issubclass(cls, RobotSettings)]


def resolve(
    params_file: Path | None = None,
    assignments: Iterable[str] = (),
    **stage_changes: Mapping[str, Any],
) -> Configuration:
    """Build the configuration: defaults < `params_file` < `assignments` (`stage.name=value`) <
    changes.

    A value of the robot holds for all stages that know it; `--set` takes it without a stage, too.
    Raises SettingsError naming the parameter, the value and what is accepted.
    """
    assigned: dict[str, dict[str, Any]] = {}
    for assignment in assignments:
        stage, name, value = _parse_assignment(assignment)
        assigned.setdefault(stage, {})[name] = value
    layers: list[tuple[str, Mapping[str, Mapping[str, Any]]]] = [
        ('--set', _with_one_robot(assigned, '--set')),
        ('', stage_changes),
    ]
    if params_file is not None:
        where = str(params_file)
        layers.insert(0, (where, _with_one_robot(read_params_file(params_file), where)))
    stages: dict[str, Any] = {name: settings() for name, settings in STAGE_SETTINGS.items()}
    for where, values in layers:
        with about(where):
            for stage, changes in values.items():
                stages[stage] = stages[stage].replaced(**changes)
    return Configuration(**stages)


def read_params_file(path: Path) -> dict[str, dict[str, Any]]:
    """Return the values of a ROS 2 parameter file by stage.

    `/**` applies to every stage that has the parameter; names of nodes outside this package are
    passed over. Raises SettingsError when the file is missing or not of that form.
    """
    expected = 'node names with ros__parameters below them'
    document = read_yaml(path, expected, SettingsError)
    values: dict[str, dict[str, Any]] = {}
    # What is said of one node wins over what is said of all, as in ROS.
    of_all_first = sorted(document.items(), key=lambda item: not str(item[0]).endswith('**'))
    for node, content in of_all_first:
        parameters = content.get('ros__parameters') if isinstance(content, dict) else None
        if not isinstance(parameters, dict):
            raise SettingsError(f'{path}: {node} has no ros__parameters')
        parameters = {k: v for k, v in parameters.items() if k not in ROS_PARAMETERS}
        merge(values, _by_stage(str(node), parameters, path))
    return values


def unread_sections(arguments: Sequence[str], full_name: str) -> list[str]:
    """Return a line for each section in the parameter files of a command line that is meant for a
    node, by the last word of its name, but that ROS does not give to it. full_name: of the node.
    """
    files = [Path(file) for word, file in pairwise(arguments) if word == '--params-file']
    lines = []
    for file in files:
        try:
            sections = list(_sections(read_yaml(file, 'names of nodes', SettingsError), ''))
        except SettingsError:
            continue  # what ROS makes of it, it says
        name = full_name.rpartition('/')[2]
        near = [s for s in sections if s.rpartition('/')[2] == name and not _is_for(s, full_name)]
        if near and not any(_is_for(s, full_name) for s in sections if not s.endswith('*')):
            lines.append(
                f'{file} has parameters of {near[0].lstrip("/")}, but this node is {full_name}: '
                f'they are not read; name the section {full_name}, or /**/{name} for any namespace'
            )
    return lines


def _sections(document: Mapping[str, Any], above: str) -> Iterator[str]:
    """Yield the full names of the nodes in a parameter file, which may lie in one another."""
    for key, content in document.items():
        name = f'{above}/{key.strip("/")}'
        if isinstance(content, dict):
            if 'ros__parameters' in content:
                yield name
            others = {k: v for k, v in content.items() if k != 'ros__parameters'}
            yield from _sections(others, name)


def _is_for(section: str, full_name: str) -> bool:
    """Whether ROS gives a section to a node; `*` is one word of its name and `**` any number."""
    words = {'**': '(/[^/]+)*', '*': '/[^/]+'}
    pattern = ''.join(words.get(w, f'/{re.escape(w)}') for w in section.split('/')[1:])
    return re.fullmatch(pattern, full_name) is not None


def _by_stage(node: str, parameters: dict[str, Any], path: Path) -> dict[str, dict[str, Any]]:
    stage = node.rsplit('/', 1)[-1]
    stages = [known for known in STAGE_SETTINGS if stage in (known, '**')]
    values: dict[str, dict[str, Any]] = {}
    for name, value in parameters.items():
        owners = [known for known in stages if STAGE_SETTINGS[known].has(name)]
        # What only a node has (frames, rates) is no concern of its stage.
        if stages and not owners and not any(is_node_parameter(known, name) for known in stages):
            if stage == '**':
                gone = suggestion(name, []) if name in GONE else ''
                raise SettingsError(f'{path}: no stage has a parameter {name}{gone}')
            owners = stages
        for owner in owners:
            values.setdefault(owner, {})[name] = value
    return values


def _parse_assignment(assignment: str) -> tuple[str, str, Any]:
    """Return stage, name and value; the robot's parameters need no stage."""
    key, separator, text = assignment.partition('=')
    stage, dot, name = key.strip().partition('.')
    if not separator or not (dot or stage in ROBOT_PARAMETERS):
        raise SettingsError(f'--set {shortened(assignment)}: expected stage.parameter=value')
    try:
        value = yaml_value(text)
    except ValueError as error:
        what = f'{shortened(text)} is no value in YAML: {error}'
        raise SettingsError(f'--set {key}: {what}') from None
    if not dot:
        return ROBOT_STAGES[0], stage, value
    if stage not in STAGE_SETTINGS:
        near = suggestion(stage, list(STAGE_SETTINGS))
        raise SettingsError(f'--set: unknown stage {shortened(stage)}{near}')
    return stage, name, value


def _with_one_robot(values: dict[str, dict[str, Any]], where: str) -> dict[str, dict[str, Any]]:
    """Return values by stage with those of the robot in all stages that know it. Raises
    SettingsError where two of them differ.
    """
    result = {stage: dict(parameters) for stage, parameters in values.items()}
    for name in ROBOT_PARAMETERS:
        given = {stage: values[stage][name] for stage in values if name in values[stage]}
        given = {stage: value for stage, value in given.items() if stage in ROBOT_STAGES}
        for stage, value in given.items():
            first = next(iter(given))
            if value != given[first]:
                raise SettingsError(
                    f'{where}: {first}.{name} = {given[first]!r}, but {stage}.{name} = {value!r}: '
                    'there is one robot; set it once, in a file under /**'
                )
            for owner in ROBOT_STAGES:
                result.setdefault(owner, {})[name] = value
    return result


NODE_SETTINGS: dict[str, type[NodeSettings]] = {
    cls.stage_name(): cls
    for cls in (
        StereoCameraNodeSettings,
        StereoSlamNodeSettings,
        FloorSegmentationNodeSettings,
        CloudLabellingNodeSettings,
        OccupancyGridNodeSettings,
        SimulatedRobotNodeSettings,
        SegfloorMasksNodeSettings,
    )
}
"""The settings of the nodes by name."""


def is_node_parameter(node: str, name: str) -> bool:
    """Return whether a node has a parameter of this name."""
    return NODE_SETTINGS[node].has(name)
