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
    """One topic. about: what its messages hold, with units and frames. instead_of: the topic that
    it replaces by parameter, where it does. is_optional: its subscribers do without it where nobody
    publishes it. on_demand_by: who subscribes only while somebody needs what it makes of it.
    also_by: further publishers.
    """

    name: str
    type: type[Any]
    profile: QoSProfile
    publisher: str
    subscribers: tuple[str, ...]
    about: str
    instead_of: str = ''
    is_optional: bool = False
    on_demand_by: tuple[str, ...] = ()
    also_by: tuple[str, ...] = ()

    @property
    def type_name(self) -> str:
        """The type as in `ros2 topic info`, e.g. `sensor_msgs/msg/Image`."""
        return f'{self.type.__module__.split(".")[0]}/msg/{self.type.__name__}'


def _images() -> list[Topic]:
    topics = []
    for side in ('left', 'right'):
        raw, rectified, info = f'{side}/image_raw', f'{side}/image_rect', f'{side}/camera_info'
        name = f'{side.capitalize()} image'
        topics += [
            Topic(raw, Image, qos.IMAGES, CAMERA, (SLAM,), f'{name}, raw.'),
            _compressed(raw, CAMERA, f'{name}, raw, as JPEG or PNG'),
            Topic(
                rectified,
                Image,
                qos.IMAGES,
                OTHERS,
                (SLAM,),
                f'{name}, rectified; taken instead of {raw} by parameter.',
                instead_of=raw,
            ),
            _compressed(rectified, OTHERS, f'{name}, rectified, as JPEG or PNG'),
            Topic(info, CameraInfo, qos.IMAGES, CAMERA, (SLAM,), f'Calibration for {raw}.'),
        ]
    return topics


def _compressed(image: str, publisher: str, what: str) -> Topic:
    """Return the topic of an image for thin links, named as image_transport does."""
    about = f'{what}; instead of {image} by parameter.'
    name = f'{image}/compressed'
    return Topic(name, CompressedImage, qos.IMAGES, publisher, (SLAM,), about, instead_of=image)


FRAME_PARTS = tuple(
    f'frame/{side}/{what}' for side in ('left', 'right') for what in ('image_rect', 'camera_info')
)


def _frame_images() -> list[Topic]:
    about = 'Every tracked frame, rectified, some 240 pixels wide; published while someone listens'
    return [
        Topic(
            name,
            CameraInfo if name.endswith('camera_info') else Image,
            qos.FRAMES,
            SLAM,
            (),
            f'Calibration for {name.replace("camera_info", "image_rect")}.'
            if name.endswith('camera_info')
            else f'{about}.',
            is_optional=True,
            on_demand_by=(FLOOR,),
        )
        for name in FRAME_PARTS
    ]


def _keyframe_images() -> list[Topic]:
    topics = []
    for side in ('left', 'right'):
        image, info = f'keyframe/{side}/image_rect', f'keyframe/{side}/camera_info'
        about = f'{side.capitalize()} image of the keyframe, rectified, mono8.'
        topics += [
            Topic(image, Image, qos.KEYFRAMES, SLAM, (FLOOR,), about),
            Topic(info, CameraInfo, qos.KEYFRAMES, SLAM, (FLOOR,), f'Calibration for {image}.'),
        ]
    return topics


_ALL = [
    *_images(),
    Topic(
        'wheel_odometry',
        Odometry,
        qos.SENSORS_RELIABLE,
        OTHERS,
        (SLAM,),
        'Where the wheels have base_link, in any frame of their own. stereo_camera publishes that '
        'of a recording.',
        is_optional=True,
    ),
    Topic(
        'depth/image_raw',
        Image,
        qos.IMAGES,
        OTHERS,
        (SLAM,),
        'Depth aligned with the left image, 16UC1 (mm) or 32FC1 (m); taken instead of right images '
        'by parameter, or where nobody publishes those.',
        instead_of='right/image_raw',
    ),
    Topic(
        'imu',
        Imu,
        qos.SENSORS_RELIABLE,
        OTHERS,
        (SLAM,),
        'Angular velocity and acceleration, in a frame that tf ties to the camera. stereo_camera '
        'publishes those of a recording.',
        is_optional=True,
    ),
    Topic(
        'odometry',
        Odometry,
        qos.ODOMETRY,
        SLAM,
        (),
        'Every tracked frame: base_link in odom (continuous), covariance, velocity. Silent while '
        'lost.',
        is_optional=True,
        on_demand_by=(CLOUD,),
    ),
    Topic(
        'initialpose',
        PoseWithCovarianceStamped,
        qos.ODOMETRY,
        OTHERS,
        (SLAM,),
        'About where base_link is in map, as RViz publishes it: the camera is looked for there.',
        is_optional=True,
    ),
    Topic(
        'pose',
        PoseWithCovarianceStamped,
        qos.ODOMETRY,
        SLAM,
        (),
        'Every tracked frame: base_link in map. Published while someone listens.',
    ),
    Topic(
        'dynamic_mask',
        Image,
        qos.IMAGES_BEST_EFFORT,
        OTHERS,
        (SLAM,),
        'mono8, 255 where something moves, of the left image that stereo_slam receives, with its '
        'stamp; from a segmentation network. Used when there, never waited for.',
        is_optional=True,
        also_by=(CAMERA,),
    ),
    Topic(
        'moving_points',
        PointCloud2,
        qos.ODOMETRY,
        SLAM,
        (),
        'What moves, every few frames: x y z in map (m), vx vy vz (m/s, NaN where not known). '
        'Empty where nothing does.',
    ),
    Topic(
        MOVING_MASK,
        Image,
        qos.KEYFRAMES,
        SLAM,
        (FLOOR,),
        'mono8 on the rectified left image of the keyframe: 255 where something moves.',
        is_optional=True,
    ),
    Topic(
        FRAME_DONE,
        Header,
        qos.ODOMETRY,
        SLAM,
        (),
        'The header of every frame that SLAM has done with: tracked, skipped or refused.',
    ),
    Topic(
        'camera_mount',
        TransformStamped,
        qos.LATCHED,
        SLAM,
        (FLOOR,),
        'Left optical frame in base_link: given, from tf, or measured from the floor.',
    ),
    Topic(
        'keyframe/odometry',
        Odometry,
        qos.KEYFRAMES,
        SLAM,
        (FLOOR, CLOUD, GRID),
        'base_link in map at the keyframe.',
    ),
    Topic(
        MAP_START,
        TimeReference,
        qos.KEYFRAMES,
        SLAM,
        (FLOOR, CLOUD, GRID),
        'The keyframe, and as time_ref when its map began: another time_ref is another map.',
        is_optional=True,
    ),
    Topic(
        MAP_LOADED,
        UInt8MultiArray,
        qos.LATCHED,
        SLAM,
        (CLOUD, GRID),
        'What the nodes behind need of a map that was loaded, as the bytes of a map file.',
        is_optional=True,
    ),
    Topic(
        MAP_WANTED,
        Header,
        qos.KEYFRAMES,
        SLAM,
        (CLOUD, GRID),
        'The header of the latest keyframe of a map that is to be saved.',
        is_optional=True,
    ),
    Topic(
        MAP_PART,
        UInt8MultiArray,
        qos.KEYFRAMES,
        CLOUD,
        (SLAM,),
        'What a node knows of the map at that keyframe, as the bytes of a map file.',
        is_optional=True,
        also_by=(GRID,),
    ),
    *_keyframe_images(),
    *_frame_images(),
    Topic(
        'keyframe/features',
        PointCloud2,
        qos.KEYFRAMES,
        SLAM,
        (CLOUD, GRID),
        'Features of the keyframe: x y z in map (m, NaN where unknown), u v (px), id (-1: none).',
    ),
    Topic(
        'keyframe/path',
        Path,
        qos.KEYFRAMES,
        SLAM,
        (GRID,),
        'base_link in map of all keyframes as now optimised; each pose with its own stamp.',
    ),
    Topic(
        'map_points',
        PointCloud2,
        qos.KEYFRAMES,
        SLAM,
        (CLOUD,),
        'The whole sparse map: x y z in map (m) and id; a removed point disappears.',
    ),
    Topic(
        'keyframe/disparity',
        DisparityImage,
        qos.KEYFRAMES,
        FLOOR,
        (),
        'Disparity of the keyframe, 0 where there is no match. Published while someone listens.',
    ),
    Topic(
        'keyframe/floor_mask',
        Image,
        qos.KEYFRAMES,
        FLOOR,
        (CLOUD,),
        'mono8 on the rectified left image: 255 floor, 127 no evidence, 0 not floor.',
    ),
    Topic(
        'keyframe/floor_overlay',
        Image,
        qos.KEYFRAMES,
        FLOOR,
        (),
        'bgr8, for people: the rectified left image tinted green for floor, blue for no evidence, '
        'red for not floor. Published while someone listens.',
    ),
    Topic(
        'keyframe/v_disparity',
        Image,
        qos.KEYFRAMES,
        FLOOR,
        (),
        'bgr8, for people: the filtered v-disparity (rows: of the de-rolled image; columns: '
        "half pixels) and the floor's profile in green. Published while someone listens.",
    ),
    Topic(
        'keyframe/floor_scan',
        LaserScan,
        qos.KEYFRAMES,
        FLOOR,
        (GRID,),
        "How far the floor was seen per bearing, in the base's plane (m); 0: blocked right in "
        'front, NaN: not seen. Intensities: distance of the nearest upright thing (m) or NaN.',
    ),
    Topic(
        'scan',
        LaserScan,
        qos.KEYFRAMES,
        FLOOR,
        (),
        "How far the floor is free per bearing at every tracked frame, in the base's plane (m), "
        'for a costmap to clear; inf: as far as can be told, -inf: blocked right in front, NaN: '
        'not seen. Published while someone listens.',
    ),
    Topic(
        'labelled_points',
        PointCloud2,
        qos.KEYFRAMES,
        CLOUD,
        (GRID,),
        'The sparse map with labels: x y z in map (m), id, confidence (0 to 1), label (0 unknown, '
        '1 floor, 2 obstacle).',
    ),
    Topic(
        'floor_points',
        PointCloud2,
        qos.KEYFRAMES,
        CLOUD,
        (),
        'The floor points alone: x y z id. Published while someone listens.',
    ),
    Topic(
        'obstacle_points',
        PointCloud2,
        qos.KEYFRAMES,
        CLOUD,
        (),
        'The obstacle points alone: x y z id. Published while someone listens: at every keyframe, '
        'and twice a second while the camera is tracked but makes none.',
    ),
    Topic(
        KEYFRAME_DONE,
        Header,
        qos.KEYFRAMES,
        GRID,
        (),
        'The header of every keyframe that goes no further: it is in the map, or a node could not '
        'process it.',
        also_by=(FLOOR, CLOUD),
    ),
    Topic(
        'map',
        OccupancyGrid,
        qos.LATCHED,
        GRID,
        (),
        'The map: 0 free to 100 occupied, -1 unknown; its stamp is that of the latest keyframe.',
    ),
]
TOPICS: dict[str, Topic] = {topic.name: topic for topic in _ALL}
"""All topics by name, in the order of the data flow."""

DIAGNOSTICS = Topic(
    '/diagnostics',
    DiagnosticArray,
    qos.DIAGNOSTICS,
    '',
    (),
    'Status of the node; the header carries the stamp of the frame or keyframe it is about.',
)
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
