"""The topics between the nodes: name, type, quality of service, who publishes and who listens.

The nodes, the documentation and the replay take them from here. Names are relative, so that
namespaces and remapping apply. Every message about one keyframe carries that keyframe's stamp.

Everything between the nodes of this package is reliable: best effort loses large messages. Only
what other drivers publish may be taken best effort. A stamp is a whole number of nanoseconds
everywhere outside messages.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib import resources
from pathlib import Path as FilePath
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import (
    PointStamped,
    PoseWithCovarianceStamped,
    TransformStamped,
    TwistStamped,
)
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import (
    CameraInfo,
    CompressedImage,
    Image,
    Imu,
    LaserScan,
    PointCloud2,
    TimeReference,
)
from std_msgs.msg import Header, String, UInt8MultiArray
from stereo_msgs.msg import DisparityImage

from segfloor_ros.nodes.messages.making import make_header, to_ns, to_time  # noqa: F401

PROFILES = FilePath(str(resources.files('segfloor_ros.nodes') / 'fastdds.xml'))
"""Shared memory for stereo images and prompt repetition of what was lost, for Fast DDS, the
default middleware of ROS 2 Jazzy. Other middlewares do not read it.
"""

NAMED_BY = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_OTHERS = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTDDS_BUILTIN_TRANSPORTS')
_IN_FOLDER = ('DEFAULT_FASTRTPS_PROFILES.xml', 'DEFAULT_FASTDDS_PROFILES.xml')

CAMERA, SLAM = 'stereo_camera', 'stereo_slam'
FLOOR, CLOUD, GRID = 'floor_segmentation', 'cloud_labelling', 'occupancy_grid'
BEHIND = (FLOOR, CLOUD, GRID)
NODES = (CAMERA, SLAM, *BEHIND)
"""The nodes in the order of the data flow."""

ROBOT = 'simulated_robot'
"""In place of the camera, and of who else publishes what a robot measures."""

MASKS = 'segfloor_masks'
"""A network beside the nodes, where there is one."""

OTHERS = ''
"""In place of a publisher: nodes outside of this package."""

MOVING_MASK, SEMANTIC_MASK = 'keyframe/moving_mask', 'keyframe/semantic_mask'
MAP_START = 'keyframe/map_start'
MAP_LOADED, MAP_PART = 'map_file/loaded', 'map_file/part'
FRAME_DONE, KEYFRAME_DONE = 'frame_done', 'keyframe/done'
CORRECTED = '/corrected'
"""Ends the names of the topics on which poses come again that were provisional: the stamps of
`odometry` and `pose` grow."""

PACED_BY = (FRAME_DONE, 'keyframe/odometry', KEYFRAME_DONE)
"""Topics that a lossless camera listens to: how far frames and keyframes are."""

PATIENCE_S = 10.0
"""What is under way between nodes and has not come for so long, is lost: a frame, a keyframe, the
part of a map, the answer of a service. A stamp older than this is that of a recording. Nodes that
are started together have found each other by then.
"""


FRESH_S = 0.5
"""No robot steers by what is older: points are published again, a sensor is not waited for."""


def _reliable(
    depth: int = 1, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE
) -> QoSProfile:
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability)


IMAGES = _reliable(30)
"""Camera images and their calibrations."""

SENSORS = _reliable(400)
"""Wheel odometry and IMU."""

FRAMES = _reliable(5)
"""Small images of every frame and the time of a recording, of which only the latest count."""

KEYFRAMES = _reliable(100)
"""Poses, and everything about a keyframe; deep enough for a burst after the camera's mount was
measured. As tf2 does, for moving frames, too."""

LATCHED = _reliable(durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""The last value also for those who come later: the map, the camera's mount (REP-2003)."""

LATCHED_BY_MANY = _reliable(KEYFRAMES.depth, DurabilityPolicy.TRANSIENT_LOCAL)
"""What listens to the last values of many nodes, e.g. to the fixed frames of tf."""

RECENT = _reliable(12, DurabilityPolicy.TRANSIENT_LOCAL)
"""What publishers keep of keyframes for a node that is started again: that takes up to 2 s, what
SLAM keeps of it is up to 1 s older, and at most four keyframes come in a second.
"""


def best_effort(profile: QoSProfile) -> QoSProfile:
    """Return a profile for drivers that publish best effort; messages may be lost."""
    return QoSProfile(depth=profile.depth, reliability=ReliabilityPolicy.BEST_EFFORT)


def describe_policies(profile: QoSProfile) -> str:
    """Return what both sides must agree on in words, e.g. `reliable, volatile`."""
    words = (profile.reliability.name, profile.durability.name)
    return ', '.join(word.lower().replace('_', ' ') for word in words)


@dataclass(frozen=True)
class Topic:
    """One topic. instead_of: the topic that it replaces by parameter, where it does. is_optional:
    its subscribers do without it where nobody publishes it. on_demand_by: who subscribes only while
    somebody needs what it makes of it. also_by: further publishers.
    """

    name: str
    type: type[Any]
    profile: QoSProfile
    publisher: str
    subscribers: tuple[str, ...] = ()
    instead_of: str = ''
    is_optional: bool = False
    on_demand_by: tuple[str, ...] = ()
    also_by: tuple[str, ...] = ()

    @property
    def offered(self) -> QoSProfile:
        """The profile of its publishers; `profile` is that of its subscribers."""
        if self.profile is LATCHED_BY_MANY:
            return LATCHED
        is_joined = self.profile is KEYFRAMES and not {*BEHIND}.isdisjoint(self.subscribers)
        return RECENT if is_joined else self.profile

    @property
    def type_name(self) -> str:
        """The type as in `ros2 topic info`, e.g. `sensor_msgs/msg/Image`."""
        return f'{self.type.__module__.split(".")[0]}/msg/{self.type.__name__}'


SIDES = ('left', 'right')
FRAME_PARTS = tuple(
    f'frame/{side}/{what}' for side in SIDES for what in ('image_rect', 'camera_info')
)
KEYFRAME_PARTS = tuple(f'key{part}' for part in FRAME_PARTS)


def _images(side: str) -> list[Topic]:
    """Return the topics of one camera; those for thin links are named as image_transport does."""
    raw, rectified = f'{side}/image_raw', f'{side}/image_rect'
    packed = '/compressed'
    looks = (SLAM, MASKS)
    return [
        Topic(raw, Image, IMAGES, CAMERA, looks if side == 'left' else (SLAM,), also_by=(ROBOT,)),
        Topic(raw + packed, CompressedImage, IMAGES, CAMERA, (SLAM,), instead_of=raw),
        Topic(rectified, Image, IMAGES, OTHERS, (SLAM,), instead_of=raw),
        Topic(rectified + packed, CompressedImage, IMAGES, OTHERS, (SLAM,), instead_of=rectified),
        Topic(f'{side}/camera_info', CameraInfo, IMAGES, CAMERA, (SLAM,), also_by=(ROBOT,)),
    ]


def _rectified_pair(
    names: tuple[str, ...],
    profile: QoSProfile,
    of_right: tuple[str, ...] = (),
    of_left: tuple[str, ...] = (),
    **facts: Any,
) -> list[Topic]:
    """Return the topics of rectified images and their calibrations. of_right, of_left: who
    subscribes to those of a side.
    """
    kinds = {name: CameraInfo if name.endswith('camera_info') else Image for name in names}
    return [
        Topic(name, kind, profile, SLAM, of_left if '/left/' in name else of_right, **facts)
        for name, kind in kinds.items()
    ]


_ALL = [
    *(topic for side in SIDES for topic in _images(side)),
    Topic('wheel_odometry', Odometry, SENSORS, OTHERS, (SLAM,), is_optional=True, also_by=(ROBOT,)),
    Topic(
        'depth/image_raw',
        Image,
        IMAGES,
        OTHERS,
        (SLAM,),
        instead_of='right/image_raw',
        also_by=(ROBOT,),
    ),
    Topic('imu', Imu, SENSORS, OTHERS, (SLAM,), is_optional=True, also_by=(ROBOT,)),
    Topic('cmd_vel', TwistStamped, KEYFRAMES, OTHERS, (ROBOT,)),
    Topic('ground_truth', Odometry, KEYFRAMES, ROBOT),
    Topic('contact', PointStamped, KEYFRAMES, ROBOT),
    Topic('odometry', Odometry, KEYFRAMES, SLAM, is_optional=True, on_demand_by=(CLOUD,)),
    Topic('initialpose', PoseWithCovarianceStamped, KEYFRAMES, OTHERS, (SLAM,), is_optional=True),
    Topic('pose', PoseWithCovarianceStamped, KEYFRAMES, SLAM),
    Topic('odometry' + CORRECTED, Odometry, KEYFRAMES, SLAM),
    Topic('pose' + CORRECTED, PoseWithCovarianceStamped, KEYFRAMES, SLAM),
    Topic(
        'dynamic_mask',
        Image,
        best_effort(IMAGES),
        OTHERS,
        (SLAM,),
        is_optional=True,
        also_by=(CAMERA, MASKS),
    ),
    Topic('semantic_labels', Image, IMAGES, MASKS),
    Topic('semantic_classes', String, LATCHED, MASKS),
    Topic('semantic_map', OccupancyGrid, LATCHED, MASKS),
    Topic('moving_points', PointCloud2, KEYFRAMES, SLAM),
    Topic(MOVING_MASK, Image, KEYFRAMES, SLAM, (FLOOR,), is_optional=True),
    Topic(SEMANTIC_MASK, Image, KEYFRAMES, MASKS, (FLOOR,), is_optional=True),
    Topic(FRAME_DONE, Header, KEYFRAMES, SLAM),
    Topic('camera_mount', TransformStamped, LATCHED, SLAM, (FLOOR, MASKS)),
    Topic('keyframe/odometry', Odometry, KEYFRAMES, SLAM, BEHIND),
    Topic(MAP_START, TimeReference, KEYFRAMES, SLAM, BEHIND, is_optional=True),
    Topic(MAP_LOADED, UInt8MultiArray, LATCHED, SLAM, BEHIND, is_optional=True),
    Topic(
        MAP_PART, UInt8MultiArray, LATCHED_BY_MANY, FLOOR, (SLAM,), is_optional=True, also_by=BEHIND
    ),
    *_rectified_pair(KEYFRAME_PARTS, KEYFRAMES, of_right=(FLOOR,), of_left=(FLOOR, MASKS)),
    *_rectified_pair(FRAME_PARTS, FRAMES, is_optional=True, on_demand_by=(FLOOR,)),
    Topic('keyframe/features', PointCloud2, KEYFRAMES, SLAM, (CLOUD, GRID, MASKS)),
    Topic('keyframe/path', Path, KEYFRAMES, SLAM, (GRID, MASKS)),
    Topic('map_points', PointCloud2, KEYFRAMES, SLAM, (CLOUD,)),
    Topic('keyframe/disparity', DisparityImage, KEYFRAMES, FLOOR, (MASKS,)),
    Topic('keyframe/floor_mask', Image, KEYFRAMES, FLOOR, (CLOUD, MASKS)),
    Topic('keyframe/floor_overlay', Image, KEYFRAMES, FLOOR),
    Topic('keyframe/v_disparity', Image, KEYFRAMES, FLOOR),
    Topic('keyframe/floor_scan', LaserScan, KEYFRAMES, FLOOR, (GRID, MASKS)),
    Topic('scan', LaserScan, KEYFRAMES, FLOOR),
    Topic('obstacle_scan', LaserScan, KEYFRAMES, FLOOR),
    Topic('labelled_points', PointCloud2, KEYFRAMES, CLOUD, (GRID,)),
    Topic('floor_points', PointCloud2, KEYFRAMES, CLOUD),
    Topic('obstacle_points', PointCloud2, KEYFRAMES, CLOUD),
    Topic(KEYFRAME_DONE, Header, KEYFRAMES, GRID, also_by=(FLOOR, CLOUD)),
    Topic('map', OccupancyGrid, LATCHED, GRID, (MASKS,)),
]
TOPICS: dict[str, Topic] = {topic.name: topic for topic in _ALL}
"""All topics by name, in the order of the data flow."""

DIAGNOSTICS = Topic('/diagnostics', DiagnosticArray, KEYFRAMES, OTHERS)
"""Published by every node."""


def published_by(node: str, alternatives: bool = False) -> list[Topic]:
    """Return the topics of a node's publishers, without diagnostics; alternatives: also those that
    replace others by parameter.
    """
    mine = [topic for topic in TOPICS.values() if node in (topic.publisher, *topic.also_by)]
    return [topic for topic in mine if alternatives or not topic.instead_of]


def subscribed_by(node: str, alternatives: bool = False) -> list[Topic]:
    """Return the topics a node subscribes to, without diagnostics; alternatives: also those that
    replace others by parameter, and those on demand.
    """
    by_default = [t for t in TOPICS.values() if node in t.subscribers and not t.instead_of]
    every = [t for t in TOPICS.values() if node in (*t.subscribers, *t.on_demand_by)]
    return every if alternatives else by_default


def stamp_of(message: Any) -> int:
    """Return the stamp of a message or of a header in ns; 0 for what carries none."""
    header = message if isinstance(message, Header) else getattr(message, 'header', None)
    return 0 if header is None else to_ns(header.stamp)


def prepare_middleware() -> None:
    """Let Fast DDS take `PROFILES` in this process, unless the user has chosen otherwise. Before
    `rclpy.init`.
    """
    is_chosen = any(os.environ.get(name) for name in (NAMED_BY, *_OTHERS))
    if not is_chosen and not any(FilePath(name).exists() for name in _IN_FOLDER):
        os.environ[NAMED_BY] = str(PROFILES)
