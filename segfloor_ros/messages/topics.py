"""The topics between the nodes: name, type, quality of service, who publishes and who listens.

The nodes, the documentation and the replay take them from here. Names are relative, so that
namespaces and remapping apply. Every message about one keyframe carries that keyframe's stamp.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.qos import QoSProfile
from sensor_msgs.msg import (
    CameraInfo,
    CompressedImage,
    Image,
    Imu,
    LaserScan,
    PointCloud2,
    TimeReference,
)
from std_msgs.msg import Header, UInt8MultiArray
from stereo_msgs.msg import DisparityImage

from segfloor_ros.messages import qos

CAMERA, SLAM = 'stereo_camera', 'stereo_slam'
FLOOR, CLOUD, GRID = 'floor_segmentation', 'cloud_labelling', 'occupancy_grid'
NODES = (CAMERA, SLAM, FLOOR, CLOUD, GRID)
"""The nodes in the order of the data flow."""

OTHERS = ''
"""In place of a publisher: nodes outside of this package."""

MOVING_MASK = 'keyframe/moving_mask'
MAP_START = 'keyframe/map_start'
MAP_LOADED, MAP_WANTED, MAP_PART = 'map_file/loaded', 'map_file/wanted', 'map_file/part'
FRAME_DONE, KEYFRAME_DONE = 'frame_done', 'keyframe/done'
PACED_BY = (FRAME_DONE, 'keyframe/odometry', KEYFRAME_DONE)
"""Topics that a lossless camera listens to: how far frames and keyframes are."""


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
    return [
        Topic(raw, Image, qos.IMAGES, CAMERA, (SLAM,)),
        Topic(raw + packed, CompressedImage, qos.IMAGES, CAMERA, (SLAM,), instead_of=raw),
        Topic(rectified, Image, qos.IMAGES, OTHERS, (SLAM,), instead_of=raw),
        Topic(
            rectified + packed, CompressedImage, qos.IMAGES, OTHERS, (SLAM,), instead_of=rectified
        ),
        Topic(f'{side}/camera_info', CameraInfo, qos.IMAGES, CAMERA, (SLAM,)),
    ]


def _rectified_pair(names: tuple[str, ...], profile: QoSProfile, **facts: Any) -> list[Topic]:
    """Return the topics of rectified images and their calibrations."""
    kinds = {name: CameraInfo if name.endswith('camera_info') else Image for name in names}
    return [Topic(name, kind, profile, SLAM, **facts) for name, kind in kinds.items()]


_ALL = [
    *(topic for side in SIDES for topic in _images(side)),
    Topic('wheel_odometry', Odometry, qos.SENSORS_RELIABLE, OTHERS, (SLAM,), is_optional=True),
    Topic('depth/image_raw', Image, qos.IMAGES, OTHERS, (SLAM,), instead_of='right/image_raw'),
    Topic('imu', Imu, qos.SENSORS_RELIABLE, OTHERS, (SLAM,), is_optional=True),
    Topic('odometry', Odometry, qos.ODOMETRY, SLAM, is_optional=True, on_demand_by=(CLOUD,)),
    Topic(
        'initialpose', PoseWithCovarianceStamped, qos.ODOMETRY, OTHERS, (SLAM,), is_optional=True
    ),
    Topic('pose', PoseWithCovarianceStamped, qos.ODOMETRY, SLAM),
    Topic(
        'dynamic_mask',
        Image,
        qos.IMAGES_BEST_EFFORT,
        OTHERS,
        (SLAM,),
        is_optional=True,
        also_by=(CAMERA,),
    ),
    Topic('moving_points', PointCloud2, qos.ODOMETRY, SLAM),
    Topic(MOVING_MASK, Image, qos.KEYFRAMES, SLAM, (FLOOR,), is_optional=True),
    Topic(FRAME_DONE, Header, qos.ODOMETRY, SLAM),
    Topic('camera_mount', TransformStamped, qos.LATCHED, SLAM, (FLOOR,)),
    Topic('keyframe/odometry', Odometry, qos.KEYFRAMES, SLAM, (FLOOR, CLOUD, GRID)),
    Topic(MAP_START, TimeReference, qos.KEYFRAMES, SLAM, (FLOOR, CLOUD, GRID), is_optional=True),
    Topic(MAP_LOADED, UInt8MultiArray, qos.LATCHED, SLAM, (CLOUD, GRID), is_optional=True),
    Topic(MAP_WANTED, Header, qos.KEYFRAMES, SLAM, (CLOUD, GRID), is_optional=True),
    Topic(
        MAP_PART, UInt8MultiArray, qos.KEYFRAMES, CLOUD, (SLAM,), is_optional=True, also_by=(GRID,)
    ),
    *_rectified_pair(KEYFRAME_PARTS, qos.KEYFRAMES, subscribers=(FLOOR,)),
    *_rectified_pair(FRAME_PARTS, qos.FRAMES, is_optional=True, on_demand_by=(FLOOR,)),
    Topic('keyframe/features', PointCloud2, qos.KEYFRAMES, SLAM, (CLOUD, GRID)),
    Topic('keyframe/path', Path, qos.KEYFRAMES, SLAM, (GRID,)),
    Topic('map_points', PointCloud2, qos.KEYFRAMES, SLAM, (CLOUD,)),
    Topic('keyframe/disparity', DisparityImage, qos.KEYFRAMES, FLOOR),
    Topic('keyframe/floor_mask', Image, qos.KEYFRAMES, FLOOR, (CLOUD,)),
    Topic('keyframe/floor_overlay', Image, qos.KEYFRAMES, FLOOR),
    Topic('keyframe/v_disparity', Image, qos.KEYFRAMES, FLOOR),
    Topic('keyframe/floor_scan', LaserScan, qos.KEYFRAMES, FLOOR, (GRID,)),
    Topic('scan', LaserScan, qos.KEYFRAMES, FLOOR),
    Topic('labelled_points', PointCloud2, qos.KEYFRAMES, CLOUD, (GRID,)),
    Topic('floor_points', PointCloud2, qos.KEYFRAMES, CLOUD),
    Topic('obstacle_points', PointCloud2, qos.KEYFRAMES, CLOUD),
    Topic(KEYFRAME_DONE, Header, qos.KEYFRAMES, GRID, also_by=(FLOOR, CLOUD)),
    Topic('map', OccupancyGrid, qos.LATCHED, GRID),
]
TOPICS: dict[str, Topic] = {topic.name: topic for topic in _ALL}
"""All topics by name, in the order of the data flow."""

DIAGNOSTICS = Topic('/diagnostics', DiagnosticArray, qos.DIAGNOSTICS, OTHERS)
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
    mine = [topic for topic in TOPICS.values() if node in topic.subscribers]
    if not alternatives:
        return [topic for topic in mine if not topic.instead_of]
    return [t for t in TOPICS.values() if t in mine or node in t.on_demand_by]
