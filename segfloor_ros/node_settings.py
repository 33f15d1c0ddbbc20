"""The parameters of the ROS nodes: the settings of their stages, and what only nodes have: frames,
rates and topics' quality of service, declared in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.cloud.settings import CloudLabellingSettings
from segfloor_ros.floor.settings import FloorSegmentationSettings
from segfloor_ros.grid.settings import OccupancyGridSettings
from segfloor_ros.settings import StageSettings, setting
from segfloor_ros.slam.settings import StereoSlamSettings


@dataclass(frozen=True)
class NodeSettings(StageSettings):
    """What every node has."""

    autostart: bool = setting(
        True,
        'Configure and activate at the start; off: wait for a lifecycle manager.',
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
        False,
        'Poses in the map of load_map only: nothing is added to it.',
        live=True,
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
        'tracking is slower than the camera. A lossless stereo_camera sends no more at a time.',
        within=(3, 100),
        live=True,
    )
    bit_depth: int = setting(
        0,
        'Bits used in the pixels of 16-bit images; 0 takes it from the first pair.',
        unit='bits',
        within=(0, 16),
    )


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


NODE_SETTINGS: dict[str, type[NodeSettings]] = {
    cls.stage_name(): cls
    for cls in (
        StereoCameraNodeSettings,
        StereoSlamNodeSettings,
        FloorSegmentationNodeSettings,
        CloudLabellingNodeSettings,
        OccupancyGridNodeSettings,
    )
}
"""The settings of the five nodes by name."""


def is_node_parameter(node: str, name: str) -> bool:
    """Return whether a node has a parameter of this name."""
    return any(spec.name == name for spec in NODE_SETTINGS[node].specs())
