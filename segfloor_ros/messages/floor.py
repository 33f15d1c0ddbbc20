"""The floor seen in a keyframe: disparity image, mask and scan."""

from __future__ import annotations

import array

import numpy as np
from sensor_msgs.msg import LaserScan
from stereo_msgs.msg import DisparityImage

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.errors import InputError
from segfloor_ros.floor.observation import FloorObservation, FloorScan, free_ranges
from segfloor_ros.messages.headers import make_header
from segfloor_ros.messages.images import image_message


def disparity_message(
    stamp_ns: int, frame_id: str, camera: StereoCamera, floor: FloorObservation
) -> DisparityImage:
    """Return the disparity image: Z = f * t / d; 0 where there is no match."""
    message = DisparityImage(
        header=make_header(stamp_ns, frame_id),
        image=image_message(stamp_ns, frame_id, floor.disparity_px, '32FC1'),
        f=float(camera.fx),
        t=float(camera.baseline_m),
        min_disparity=float(floor.min_disparity_px),
        max_disparity=float(floor.max_disparity_px),
        delta_d=1.0 / 16.0,
    )
    message.valid_window.width, message.valid_window.height = camera.width, camera.height
    return message


def scan_message(stamp_ns: int, frame_id: str, scan: FloorScan) -> LaserScan:
    """Return the floor scan in the base's plane: how far the floor was seen, per bearing. The
    distances of upright things go into `intensities`, which stay empty where they are not known;
    `range_max` is the range whose error is 0.3 m, one sigma.
    """
    ranges = np.ascontiguousarray(scan.ranges_m, np.float32)
    obstacles = scan.obstacle_m if scan.obstacle_m is not None else np.zeros(0, np.float32)
    steps = max(len(ranges) - 1, 0)
    return LaserScan(
        header=make_header(stamp_ns, frame_id),
        angle_min=float(scan.angle_min_rad),
        angle_max=float(scan.angle_min_rad + steps * scan.angle_increment_rad),
        angle_increment=float(scan.angle_increment_rad),
        range_min=0.0,
        range_max=float(scan.range_max_m),
        ranges=array.array('f', ranges.tobytes()),
        intensities=array.array('f', np.ascontiguousarray(obstacles, np.float32).tobytes()),
    )


def free_scan_message(stamp_ns: int, frame_id: str, scan: FloorScan) -> LaserScan:
    """Return how far the floor is free per bearing, in the base's plane, for a costmap to clear:
    see `free_ranges`.
    """
    message = scan_message(stamp_ns, frame_id, scan)
    message.ranges = array.array('f', free_ranges(scan).tobytes())
    message.intensities = array.array('f')
    return message


def scan_arrays(message: LaserScan, topic: str) -> FloorScan:
    """Return the floor scan of a message. Raises InputError, naming the topic."""
    if not message.range_max > 0:
        raise InputError(f'{topic}: range_max of the scan is {message.range_max:g} m')
    if not np.isfinite([message.angle_min, message.angle_increment]).all():
        raise InputError(f'{topic}: the angles of the scan are not finite')
    ranges = np.frombuffer(message.ranges, np.float32).copy()
    obstacles = np.frombuffer(message.intensities, np.float32).copy()
    if len(obstacles) not in (0, len(ranges)):
        raise InputError(f'{topic}: {len(ranges)} ranges, but {len(obstacles)} intensities')
    return FloorScan(
        float(message.angle_min),
        float(message.angle_increment),
        ranges,
        obstacles if len(obstacles) else None,
        float(message.range_max),
    )
