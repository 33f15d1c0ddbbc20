"""The occupancy grid as a message: row-major from the lower-left cell."""

from __future__ import annotations

import array

import numpy as np
from nav_msgs.msg import OccupancyGrid as OccupancyGridMessage

from segfloor_ros.grid.occupancy import OccupancyGrid
from segfloor_ros.messages.errors import MessageError
from segfloor_ros.messages.headers import make_header, to_time


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


def grid_arrays(message: OccupancyGridMessage, topic: str) -> OccupancyGrid:
    """Return the map of a message. Raises MessageError when its size contradicts its data."""
    rows, columns = int(message.info.height), int(message.info.width)
    cells = np.frombuffer(message.data, np.int8)
    if len(cells) != rows * columns:
        raise MessageError(f'{topic}: {len(cells)} cells do not make {columns} x {rows}')
    position = message.info.origin.position
    # The wire carries the resolution as float32; the nearest short decimal is what was meant.
    resolution_m = float(f'{message.info.resolution:.6g}')
    return OccupancyGrid(
        cells.reshape(rows, columns).copy(), resolution_m, (float(position.x), float(position.y))
    )
