"""Floor scans as ROS has them."""

from __future__ import annotations

import array
import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import LaserScan

from segfloor_ros.core.contracts import CELL_M, RANGE_MAX_ERROR_M, FloorScan
from segfloor_ros.core.errors import InputError
from segfloor_ros.nodes.messages.making import make_header


def free_ranges(scan: FloorScan) -> NDArray[np.float32]:
    """Return how far the floor is surely free per bearing, (N,) in metres, as REP-117 has it: inf
    where it is free as far as the camera can tell, -inf where something stands right in front, NaN
    where nothing is known.

    Where a ray ends at something upright, one sigma of its range and a cell's width are taken off.
    """
    ranges = scan.ranges_m.astype(np.float64)
    obstacle = scan.obstacle_m
    if obstacle is not None:
        touches = np.isfinite(obstacle) & (ranges > 0)
        ranges -= np.where(touches, scan.error_per_m * ranges**2 + CELL_M, 0.0)
    beyond = scan.ranges_m >= scan.range_max_m
    ranges[beyond] = np.inf
    ranges[scan.ranges_m == 0] = -np.inf
    ranges[(ranges <= 0) & np.isfinite(ranges)] = -np.inf
    return ranges.astype(np.float32)


def near_obstacles(scan: FloorScan) -> tuple[NDArray[np.float32], float]:
    """Return how far away something stands or walks per bearing, (N,) in metres, inf where nothing
    is known to, and how far that is told: as far as its error, one sigma, is half a cell.
    """
    reach_m = scan.range_max_m * math.sqrt(CELL_M / 2 / RANGE_MAX_ERROR_M)
    nearest = np.full(len(scan.ranges_m), np.inf, np.float32)
    if scan.obstacle_m is not None:
        near = scan.obstacle_m < reach_m
        nearest[near] = scan.obstacle_m[near]
    return nearest, reach_m


def scan_message(stamp_ns: int, frame_id: str, scan: FloorScan) -> LaserScan:
    """Return the floor scan in the base's plane: how far the floor was seen, per bearing. The
    distances of upright things go into `intensities`, which stay empty where they are not known;
    those of what is of a class that moves follow them, where a network has looked. `range_max` is
    the range whose error is 0.3 m, one sigma.
    """
    ranges = np.ascontiguousarray(scan.ranges_m, np.float32)
    known = [one for one in (scan.obstacle_m, scan.movable_m) if one is not None]
    standing = np.concatenate([np.zeros(0, np.float32), *known])
    steps = max(len(ranges) - 1, 0)
    return LaserScan(
        header=make_header(stamp_ns, frame_id),
        angle_min=float(scan.angle_min_rad),
        angle_max=float(scan.angle_min_rad + steps * scan.angle_increment_rad),
        angle_increment=float(scan.angle_increment_rad),
        range_min=0.0,
        range_max=float(scan.range_max_m),
        ranges=array.array('f', ranges.tobytes()),
        intensities=array.array('f', standing.tobytes()),
    )


def free_scan_message(stamp_ns: int, frame_id: str, scan: FloorScan) -> LaserScan:
    """Return how far the floor is free per bearing, in the base's plane, for a costmap to clear:
    see `free_ranges`.
    """
    free = replace(scan, ranges_m=free_ranges(scan), obstacle_m=None, movable_m=None)
    return scan_message(stamp_ns, frame_id, free)


def obstacle_scan_message(stamp_ns: int, frame_id: str, scan: FloorScan) -> LaserScan:
    """Return what is near per bearing, in the base's plane, for a collision monitor: see
    `near_obstacles`.
    """
    ranges, reach_m = near_obstacles(scan)
    near = replace(scan, ranges_m=ranges, obstacle_m=None, range_max_m=reach_m, movable_m=None)
    return scan_message(stamp_ns, frame_id, near)


def scan_arrays(message: LaserScan, topic: str) -> FloorScan:
    """Return the floor scan of a message. Raises InputError, naming the topic."""
    if not message.range_max > 0:
        raise InputError(f'{topic}: range_max of the scan is {message.range_max:g} m')
    if not np.isfinite([message.angle_min, message.angle_increment]).all():
        raise InputError(f'{topic}: the angles of the scan are not finite')
    ranges = np.frombuffer(message.ranges, np.float32).copy()
    count, standing = len(ranges), np.frombuffer(message.intensities, np.float32).copy()
    if len(standing) not in (0, count, 2 * count):
        raise InputError(f'{topic}: {count} ranges, but {len(standing)} intensities')
    return FloorScan(
        float(message.angle_min),
        float(message.angle_increment),
        ranges,
        standing[:count] if len(standing) else None,
        float(message.range_max),
        standing[count:] if len(standing) > count else None,
    )
