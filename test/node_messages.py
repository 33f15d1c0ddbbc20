"""Messages of a camera and of one keyframe for the nodes, and how they are sent."""

from typing import Any

import numpy as np
from stereo_room import CAMERA, MOUNT

from segfloor_ros.core.contracts import (
    POINT_FLOOR,
    POINT_OBSTACLE,
    FloorScan,
    KeyframeFeatures,
    KeyframePath,
    LabelledPoints,
    SparseCloud,
    StereoFrame,
)
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.nodes.messages.camera_infos import camera_info_message, rectified_calibration
from segfloor_ros.nodes.messages.images import image_message
from segfloor_ros.nodes.messages.odometry import odometry_message
from segfloor_ros.nodes.messages.points import (
    features_message,
    labelled_message,
    sparse_cloud_message,
)
from segfloor_ros.nodes.messages.poses import PathMessages
from segfloor_ros.nodes.messages.scans import scan_message

CALIBRATION = rectified_calibration(CAMERA)
SIDES = ('left', 'right')
INPUTS = tuple(f'{side}/{what}' for side in SIDES for what in ('camera_info', 'image_raw'))
MOUNTED = (
    '-p', f'camera_height_m:={MOUNT.height_m}', '-p', f'camera_pitch_rad:={MOUNT.pitch_rad}',
    '-p', f'camera_roll_rad:={MOUNT.roll_rad}',
)  # fmt: skip
"""The mount of the camera as arguments of a node."""
STAMP_NS = 12_345_678_901
AT_ORIGIN = np.eye(4)
POINTS = SparseCloud(
    np.array([2, 5, 8], np.int32), np.array([[1, 0, 0], [2, 0, 1], [3, 1, 0]], np.float32)
)
FEATURES = KeyframeFeatures(
    np.array([[2.0, 9.0], [2.0, 1.0], [5.0, 5.0]], np.float32),
    np.array([2, 5, -1], np.int32),
    np.array([[1, 0, 0], [2, 0, 1], [np.nan] * 3], np.float32),
)
MASK = np.repeat(np.array([0] * 5 + [255] * 5, np.uint8)[:, None], 10, axis=1)
LABELLED = LabelledPoints(
    np.array([2, 5], np.int32),
    np.array([[1.0, 0, 0], [2, 0.3, 0.5]], np.float32),
    np.array([POINT_FLOOR, POINT_OBSTACLE], np.uint8),
    np.ones(2, np.float32),
)
SCAN = FloorScan(-0.5, 0.25, np.array([1.5, 1.5, 1.5, 1.5, 1.5], np.float32))


def stereo_messages(frame: StereoFrame, sides: tuple[str, ...] = SIDES) -> dict[str, Any]:
    """Return images and calibrations of a frame by topic; their frames are called as the sides."""
    messages: dict[str, Any] = {}
    for side in sides:
        at = frame.stamp_ns, side
        messages[f'{side}/camera_info'] = camera_info_message(*at, getattr(CALIBRATION, side))
        messages[f'{side}/image_raw'] = image_message(*at, getattr(frame, side))
    return messages


def cloud_messages(stamp_ns: int) -> dict[str, Any]:
    """Return what `cloud_labelling` needs of one keyframe."""
    return {
        'map_points': sparse_cloud_message(stamp_ns, 'map', POINTS),
        'keyframe/features': features_message(stamp_ns, 'map', FEATURES),
        'keyframe/odometry': pose_message_at(stamp_ns),
        'keyframe/floor_mask': image_message(stamp_ns, 'left', MASK),
    }


def grid_messages(stamp_ns: int) -> dict[str, Any]:
    """Return what `occupancy_grid` needs of one keyframe, the first one of a map."""
    path = KeyframePath(np.array([stamp_ns]), np.eye(4)[None])
    return {
        'labelled_points': labelled_message(stamp_ns, 'map', LABELLED),
        'keyframe/features': features_message(stamp_ns, 'map', FEATURES),
        'keyframe/path': PathMessages('map').next(stamp_ns, path),
        'keyframe/odometry': pose_message_at(stamp_ns),
        'keyframe/floor_scan': scan_message(stamp_ns, 'base_link', SCAN),
    }


def pose_message_at(stamp_ns: int, T_map_base: np.ndarray = AT_ORIGIN) -> Any:
    """Return the pose of a keyframe."""
    return odometry_message(stamp_ns, 'map', 'base_link', T_map_base, np.zeros((6, 6)))


def publish(graph, messages: dict[str, Any], publishers: dict[str, Any] | None = None):
    """Send messages by topic once all topics have listeners; returns the publishers by topic."""
    publishers = {} if publishers is None else publishers
    for name in messages.keys() - publishers.keys():
        publishers[name] = graph.publisher(name)
    graph.connected([publishers[name] for name in messages])
    for name, message in messages.items():
        publishers[name].publish(message)
    return publishers


def grid_arrays(message, topic: str) -> OccupancyGrid:
    """Return the map of a message; its size must be that of its data."""
    rows, columns = message.info.height, message.info.width
    cells = np.frombuffer(message.data, np.int8)
    assert len(cells) == rows * columns, topic
    position = message.info.origin.position
    # The wire carries the resolution as float32; the nearest short decimal is what was meant.
    resolution_m = float(f'{message.info.resolution:.6g}')
    return OccupancyGrid(
        cells.reshape(rows, columns).copy(), resolution_m, (position.x, position.y)
    )
