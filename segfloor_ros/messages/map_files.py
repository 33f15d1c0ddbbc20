"""Maps as messages: the occupancy grid, row-major from the lower-left cell; saved maps, or parts of
one; and which map a keyframe belongs to.
"""

from __future__ import annotations

import array

import numpy as np
from nav_msgs.msg import OccupancyGrid as OccupancyGridMessage
from sensor_msgs.msg import TimeReference
from std_msgs.msg import MultiArrayDimension, MultiArrayLayout, UInt8MultiArray

from segfloor_ros.grid.map_file import OccupancyGrid
from segfloor_ros.map_file import FORMAT, MapFile, from_bytes, to_bytes
from segfloor_ros.messages.headers import make_header, to_ns, to_time

BEGUN, LOADED = 'stereo_slam', 'map file'


def grid_message(stamp_ns: int, frame_id: str, grid: OccupancyGrid) -> OccupancyGridMessage:
    """Return the map; its origin is the outer corner of cell (0, 0)."""
    message = OccupancyGridMessage(header=make_header(stamp_ns, frame_id))
    rows, columns = grid.cells.shape
    message.info.map_load_time = to_time(stamp_ns)
    message.info.resolution = float(grid.resolution_m)
    message.info.width, message.info.height = columns, rows
    message.info.origin.position.x = float(grid.origin_xy_m[0])
    message.info.origin.position.y = float(grid.origin_xy_m[1])
    message.data = array.array('b', np.ascontiguousarray(grid.cells, np.int8).tobytes())
    return message


def grid_of(message: OccupancyGridMessage) -> OccupancyGrid:
    """Return the map of a message."""
    info = message.info
    cells = np.array(message.data, np.int8).reshape(info.height, info.width)
    origin = info.origin.position
    return OccupancyGrid(cells, float(info.resolution), (origin.x, origin.y))


def map_file_message(saved: MapFile) -> UInt8MultiArray:
    """Return a map, or a part of one, as the bytes of its file, not compressed."""
    data = array.array('B', to_bytes(saved, compress=False))
    size = MultiArrayDimension(label=FORMAT, size=len(data), stride=len(data))
    return UInt8MultiArray(layout=MultiArrayLayout(dim=[size]), data=data)


def map_file_of(message: UInt8MultiArray, topic: str) -> MapFile:
    """Return the map of a message. Raises InputError, by the topic's name, for other bytes."""
    return from_bytes(bytes(message.data), topic)


def map_start_message(
    stamp_ns: int, frame_id: str, start_ns: int, is_loaded: bool = False
) -> TimeReference:
    """Return that the keyframe of a stamp belongs to the map that was begun at `start_ns`.
    is_loaded: with what a file told.
    """
    return TimeReference(
        header=make_header(stamp_ns, frame_id),
        time_ref=to_time(start_ns),
        source=LOADED if is_loaded else BEGUN,
    )


def map_start_ns(message: TimeReference) -> int:
    """Return when the keyframe's map was begun."""
    return to_ns(message.time_ref)


def is_of_loaded_map(message: TimeReference) -> bool:
    """Whether the keyframe's map goes on from a file."""
    return message.source == LOADED
