"""The settings of all stages together: defaults < parameter file < command line.

A parameter file is a plain ROS 2 parameter file; the nodes and the `segfloor` command read the
same one. The robot is one for all stages, whichever of them it was set for.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.cloud.settings import CloudLabellingSettings
from segfloor_ros.errors import SettingsError
from segfloor_ros.files.yaml_files import read_yaml, shortened, yaml_value
from segfloor_ros.floor.settings import FloorSegmentationSettings
from segfloor_ros.grid.settings import OccupancyGridSettings
from segfloor_ros.node_settings import is_node_parameter
from segfloor_ros.settings import GONE, RobotSettings, StageSettings, suggestion
from segfloor_ros.slam.settings import StereoSlamSettings

# Parameters of every ROS node: allowed in a parameter file, no concern of the stages.
ROS_PARAMETERS = ('use_sim_time', 'qos_overrides', 'start_type_description_service')


@dataclasses.dataclass(frozen=True)
class Configuration:
    """The settings of the five stages, each under its node's name."""

    stereo_camera: StereoCameraSettings
    stereo_slam: StereoSlamSettings
    floor_segmentation: FloorSegmentationSettings
    cloud_labelling: CloudLabellingSettings
    occupancy_grid: OccupancyGridSettings

    def stages(self) -> dict[str, StageSettings]:
        """Return the settings by stage name, in the order of the data flow."""
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}

    def as_ros_parameters(self) -> dict[str, Any]:
        """Return the nested mapping of a ROS 2 parameter file with every value as resolved."""
        return {
            name: {'ros__parameters': dataclasses.asdict(stage)}
            for name, stage in self.stages().items()
        }


STAGE_SETTINGS: dict[str, type[StageSettings]] = typing.get_type_hints(Configuration)

ROBOT_STAGES = [name for name, cls in STAGE_SETTINGS.items() if issubclass(cls, RobotSettings)]
ROBOT_PARAMETERS = [spec.name for spec in RobotSettings.specs()]


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
    values: dict[str, dict[str, Any]] = {name: {} for name in STAGE_SETTINGS}
    if params_file is not None:
        _merge(values, _checked(read_params_file(params_file), str(params_file)))
    assigned: dict[str, dict[str, Any]] = {}
    for assignment in assignments:
        stage, name, value = _parse_assignment(assignment)
        assigned.setdefault(stage, {})[name] = value
    _merge(values, _checked(assigned, '--set'))
    _merge(values, stage_changes)
    stages: dict[str, Any] = {
        name: STAGE_SETTINGS[name].from_mapping(changes) for name, changes in values.items()
    }
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
        _merge(values, _by_stage(str(node), parameters, path))
    return values


def _by_stage(node: str, parameters: dict[str, Any], path: Path) -> dict[str, dict[str, Any]]:
    stage = node.rsplit('/', 1)[-1]
    if stage in STAGE_SETTINGS:
        # What only the node has (frames, rates) is no concern of the stage.
        known = {spec.name for spec in STAGE_SETTINGS[stage].specs()}
        return {
            stage: {
                k: v for k, v in parameters.items() if k in known or not is_node_parameter(stage, k)
            }
        }
    if stage != '**':
        return {}
    values: dict[str, dict[str, Any]] = {}
    for name, value in parameters.items():
        owners = [
            stage
            for stage, cls in STAGE_SETTINGS.items()
            if any(spec.name == name for spec in cls.specs())
        ]
        if not owners and not any(is_node_parameter(stage, name) for stage in STAGE_SETTINGS):
            gone = suggestion(name, []) if name in GONE else ''
            raise SettingsError(f'{path}: no stage has a parameter {name}{gone}')
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


def _checked(values: dict[str, dict[str, Any]], where: str) -> dict[str, dict[str, Any]]:
    """Return values by stage with those of the robot in all stages. Raises SettingsError saying
    where a bad one is from.
    """
    result = _with_one_robot(values, where)
    try:
        for name, changes in result.items():
            STAGE_SETTINGS[name].from_mapping(changes)
    except SettingsError as error:
        raise SettingsError(f'{where}: {error}') from None
    return result


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


def _merge(values: dict[str, dict[str, Any]], changes: Mapping[str, Mapping[str, Any]]) -> None:
    for stage, parameters in changes.items():
        values.setdefault(stage, {}).update(parameters)
