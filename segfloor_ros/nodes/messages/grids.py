"""The occupancy grid as a message."""

from __future__ import annotations

import array

import numpy as np
from nav_msgs.msg import OccupancyGrid as OccupancyGridMessage

from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.nodes.messages.making import make_header, to_time


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
