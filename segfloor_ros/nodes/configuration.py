"""Where settings come from: defaults < parameter file < command line.

A parameter file is a plain ROS 2 parameter file; the nodes and the `segfloor` command read the
same one. The robot is one for all stages, whichever of them it was set for. The parameters of the
nodes are the settings of their stages, and what only nodes have: frames, rates, quality of service.
"""

from __future__ import annotations

import math
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from segfloor_ros.core.camera.recording import StereoCameraSettings
from segfloor_ros.core.cloud import CloudLabellingSettings
from segfloor_ros.core.configuration import Configuration, merge
from segfloor_ros.core.errors import SettingsError, about
from segfloor_ros.core.files.whole import shortened
from segfloor_ros.core.floor.settings import FloorSegmentationSettings
from segfloor_ros.core.grid.occupancy import OccupancyGridSettings
from segfloor_ros.core.settings import GONE, RobotSettings, StageSettings, setting, suggestion
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.nodes.yaml_files import read_yaml, yaml_value

# Parameters of every ROS node: allowed in a parameter file, no concern of the stages.
ROS_PARAMETERS = ('use_sim_time', 'qos_overrides', 'start_type_description_service')


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


@dataclass(frozen=True)
class NodeSettings(StageSettings):
    """What every node has."""

    autostart: bool = setting(
        True, 'Configure and activate at the start; off: wait for a lifecycle manager.'
    )
    resume_within_s: float = setting(
        30.0,
        'A node that was killed resumes with what it knew if it is started again within this time; '
        '0: it starts with an empty map.',
        within=(0.0, 3600.0),
    )

    @classmethod
    def stage_name(cls) -> str:
        """Return the node's name: `StereoSlamNodeSettings` → `stereo_slam`."""
        return super().stage_name().removesuffix('_node')


@dataclass(frozen=True)
class StereoCameraNodeSettings(StereoCameraSettings, NodeSettings):
    """How a recording is played."""

    rate: float = setting(
        1.0,
        'Speed of a recording against real time; 0: as fast as the chain takes it, without loss.',
        within=(0.0, 100.0),
    )
    lossless: bool = setting(
        False,
        'Slow down rather than lose a frame when the nodes cannot follow; always so at rate 0.',
    )
    image_transport: str = setting(
        'raw',
        'Publish the images raw or compressed, the latter on left/image_raw/compressed and '
        'right/image_raw/compressed, for links that raw images would fill.',
        choices=('raw', 'compressed'),
    )
    compression: str = setting(
        'jpeg',
        'How images are compressed: jpeg, small, or png, without loss.',
        choices=('jpeg', 'png'),
    )
    jpeg_quality: int = setting(
        90,
        'Quality of the JPEG images; above 90 they grow much faster than they improve.',
        within=(1, 100),
    )
    publish_clock: bool = setting(
        False,
        'Publish the stamps of a recording as /clock, for nodes with use_sim_time; no other node '
        'may do so.',
    )
    start_paused: bool = setting(False, 'Wait for the service ~/pause before the first frame.')
    left_frame: str = setting('left_camera_optical_frame', 'Optical frame of the left camera.')
    right_frame: str = setting('right_camera_optical_frame', 'Optical frame of the right camera.')


@dataclass(frozen=True)
class StereoSlamNodeSettings(StereoSlamSettings, NodeSettings):
    """Frames, images and tf."""

    map_frame: str = setting('map', 'Frame of the map.')
    odom_frame: str = setting('odom', 'Continuous frame of the odometry.')
    base_frame: str = setting('base_link', 'Frame of the robot, on the floor.')
    publish_tf: bool = setting(
        True, 'Broadcast tf: map to odom, odom to base_link, and the mount where tf lacks it.'
    )
    publish_odom_tf: bool = setting(
        True,
        'Broadcast odom to base_link; off where another node does, e.g. one that fuses the wheels: '
        'map to odom then corrects that one.',
    )
    tf_wait_s: float = setting(
        5.0,
        'How long after the start to wait for the mount of the camera on tf before measuring it, '
        'where another node publishes tf.',
        within=(0.0, 60.0),
    )
    load_map: str = setting(
        '',
        'Saved map to go on with, at the start, at a reset and by ~/load_map; empty: an empty map.',
        live=True,
    )
    localize: bool = setting(
        False, 'Poses in the map of load_map only: nothing is added to it.', live=True
    )
    path_only: bool = setting(
        False,
        'Poses alone: no floor is looked for; where the mount of the camera is not known, the base '
        'is taken to be where the camera is.',
    )
    save_map: str = setting('', 'File that ~/save_map writes the whole map to.', live=True)
    background: bool = setting(
        True,
        'Adjust the map beside tracking, so that no frame waits for it; off: results do not '
        'depend on timing.',
    )
    image_kind: str = setting(
        'auto',
        'Take raw images, which are rectified here, or rectified ones (left/image_rect and '
        'right/image_rect); auto: what is published, raw ones first.',
        choices=('auto', 'raw', 'rect'),
    )
    use_depth: bool = setting(
        False,
        'Take depth/image_raw in place of the right images; off: only where nobody publishes '
        'those.',
    )
    image_transport: str = setting(
        'auto',
        'Take images as they are or compressed, the latter on the topics with /compressed behind '
        'their names; auto: what is published, uncompressed ones first.',
        choices=('auto', 'raw', 'compressed'),
    )
    image_reliability: str = setting(
        'auto',
        'Quality of service of the image subscriptions; auto: reliable, and best effort where a '
        'driver offers no more.',
        choices=('auto', 'reliable', 'best_effort'),
    )
    sync_tolerance_s: float = setting(
        0.005,
        'Largest difference of stamps of a left and a right image of one pair.',
        within=(0.0, 0.5),
    )
    mask_timeout_s: float = setting(
        0.2,
        'A mask on dynamic_mask is used for later frames, too, until it is so old or a newer one '
        'comes; 0: only for the frame of its stamp.',
        within=(0.0, 10.0),
    )
    max_waiting_frames: int = setting(
        3,
        'When more pairs than these wait, the oldest are skipped, so that poses stay fresh where '
        'tracking is slower than the camera; while it is not, twice as many may wait for a '
        'keyframe. A lossless stereo_camera sends no more at a time.',
        within=(3, 100),
        live=True,
    )
    bit_depth: int = setting(
        0,
        'Bits used in the pixels of 16-bit images; 0 takes it from the brightest so far.',
        unit='bits',
        within=(0, 16),
    )

    @property
    def gives_mount(self) -> bool:
        """Whether any of height, pitch and roll of the camera is given; then tf is not asked."""
        given = (self.camera_height_m, self.camera_pitch_rad, self.camera_roll_rad)
        return not all(math.isnan(value) for value in given)


@dataclass(frozen=True)
class FloorSegmentationNodeSettings(FloorSegmentationSettings, NodeSettings):
    """Nothing beyond what every node has."""


@dataclass(frozen=True)
class CloudLabellingNodeSettings(CloudLabellingSettings, NodeSettings):
    """Nothing beyond what every node has."""


@dataclass(frozen=True)
class OccupancyGridNodeSettings(OccupancyGridSettings, NodeSettings):
    """When the map is published and where it is saved."""

    publish_period_s: float = setting(
        1.0,
        'The map is published at most this often; a change is never held back for longer.',
        within=(0.0, 60.0),
        live=True,
    )
    map_file: str = setting(
        'map.yaml',
        'File that the service save_map writes, with the image beside it; .yaml is appended where '
        'it lacks.',
        live=True,
    )


@dataclass(frozen=True)
class SimulatedRobotNodeSettings(NodeSettings):
    """Which robot drives where, and when its time goes on."""

    scene: str = setting(
        'hall', 'Name of a shipped scene, a scene file, or a map_server map (YAML) to drive in.'
    )
    scene_values: str = setting(
        '',
        'Values of the scene, e.g. camera.height_m=0.4, quoted and separated as words of a shell.',
    )
    robot: str = setting(
        'turtlebot3_burger', 'The robot, as published.', choices=('turtlebot3_burger', 'husky')
    )
    depth: bool = setting(False, 'A depth camera: depth/image_raw in place of the right images.')
    rate: float = setting(
        1.0,
        'Speed of its time against real time, less where the rendering takes longer; 0: in step '
        'with who drives it, each frame once a command with the stamp of the one before has come.',
        within=(0.0, 100.0),
    )
    stamped_commands: bool = setting(
        True, 'Take cmd_vel as TwistStamped, as in step with who drives it is needed; off: Twist.'
    )
    command_timeout_s: float = setting(
        0.5, 'The robot stops when no command has come for so long.', within=(0.05, 60.0)
    )
    start_paused: bool = setting(False, 'Wait for the service ~/pause before the first frame.')
    left_frame: str = setting('left_camera_optical_frame', 'Optical frame of the left camera.')
    right_frame: str = setting('right_camera_optical_frame', 'Optical frame of the right camera.')


@dataclass(frozen=True)
class SegfloorMasksNodeSettings(RobotSettings, NodeSettings):
    """Which network looks at the images, and what concerns the robot."""

    network: str = setting(
        '', 'Segmentation network, FILE.onnx with FILE.yaml beside it, which says how it is used.'
    )


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
