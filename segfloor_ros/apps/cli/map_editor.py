"""A page on which a map is corrected: erase, draw walls, draw keepout zones, undo.

In: an occupancy grid. Out: the corrected grid and a keepout mask of Nav2, as strokes were drawn in
a browser on this machine.
"""

from __future__ import annotations

import base64
import json
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.images import png_bytes
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, OccupancyGrid

LOCALHOST = '127.0.0.1'
PAGE = Path(__file__).with_name('map_editor.html')
TOOLS = {'erase': FREE, 'wall': OCCUPIED, 'keepout': OCCUPIED}
"""What the cells below a stroke become; keepout zones are in a mask of their own."""
MOST_STROKES, MOST_POINTS, MOST_BYTES = 10_000, 10_000, 20_000_000
MOST_M = 1e5
"""Farther away nothing is drawn, and no brush is wider."""

FARTHEST = 32_767
"""Cells: OpenCV draws no lines that go farther."""

Save = Callable[[OccupancyGrid, OccupancyGrid | None], str]
"""Told the corrected map and the keepout mask, if there is one; returns a line for the page."""


@dataclass(frozen=True)
class Stroke:
    """What was drawn: with which tool, points (N, 2) in `map` in m, and the width of the brush. The
    points of a keepout zone are its corners.
    """

    tool: str
    xy_m: Array
    width_m: float


def strokes_of(document: Any) -> list[Stroke]:
    """Return the strokes that a page has sent. Raises InputError."""
    try:
        found = [
            Stroke(str(one['tool']), np.array(one['points'], float), float(one['width_m']))
            for one in document['strokes']
        ]
    except (KeyError, TypeError, ValueError):
        raise InputError('strokes: expected a list of tool, points and width_m') from None
    for stroke in found:
        xy = stroke.xy_m
        is_known = stroke.tool in TOOLS and xy.ndim == 2 and xy.shape[1:] == (2,)
        if not is_known or len(xy) > MOST_POINTS or not np.abs([*xy.flat, 0]).max() < MOST_M:
            raise InputError(f'strokes: {stroke.tool[:20]} with impossible points')
        if not 0 < stroke.width_m < MOST_M:
            raise InputError(f'strokes: width_m {stroke.width_m} is impossible')
    if len(found) > MOST_STROKES:
        raise InputError(f'strokes: more than {MOST_STROKES}')
    return found


def edited(
    grid: OccupancyGrid, strokes: Sequence[Stroke]
) -> tuple[OccupancyGrid, OccupancyGrid | None]:
    """Return the corrected map, and the keepout mask (0 and 100) if there is any zone."""
    cells, zones = grid.states, np.zeros(grid.cells.shape, np.int8)
    for stroke in strokes:
        target = zones if stroke.tool == 'keepout' else cells
        target[_below(grid, stroke)] = TOOLS[stroke.tool]
    place = grid.resolution_m, grid.origin_xy_m
    mask = OccupancyGrid(zones, *place) if zones.any() else None
    return OccupancyGrid(cells, *place), mask


def _below(grid: OccupancyGrid, stroke: Stroke) -> NDArray[np.bool_]:
    """Return which cells (rows, columns) a stroke covers."""
    drawn = np.zeros(grid.cells.shape, np.uint8)
    if len(stroke.xy_m) == 0:
        return drawn > 0
    columns_rows = grid.cells_of(stroke.xy_m)[:, None, ::-1]
    corners = columns_rows.clip(-FARTHEST, FARTHEST).astype(np.int32)
    if stroke.tool == 'keepout':
        cv2.fillPoly(drawn, [corners], 1)
        return drawn > 0
    cv2.polylines(drawn, [np.concatenate([corners, corners[-1:]])], False, 1)
    return grid.away_m(drawn > 0) <= stroke.width_m / 2


def editor_server(
    grid: OccupancyGrid, title: str, save: Save, port: int = 0
) -> tuple[ThreadingHTTPServer, str]:
    """Return a server of the page, on this machine alone, and its address. The address holds a
    secret: other pages of the browser, and who does not know it, cannot save.
    """
    secret = secrets.token_urlsafe(16)
    handler = partial(_Handler, page_of(grid, title), f'/{secret}/', partial(_saved, grid, save))
    server = ThreadingHTTPServer((LOCALHOST, port), handler)
    return server, f'http://{LOCALHOST}:{server.server_port}/{secret}/'


def page_of(grid: OccupancyGrid, title: str) -> bytes:
    """Return the page, with the map in it."""
    (x, y), (rows, columns) = grid.origin_xy_m, grid.cells.shape
    facts = {
        'title': title,
        'picture': base64.b64encode(png_bytes(np.ascontiguousarray(grid.picture))).decode(),
        'resolution_m': grid.resolution_m,
        'origin_xy_m': [x, y],
        'rows': rows,
        'columns': columns,
    }
    text = json.dumps(facts).replace('<', '\\u003c')  # a title must not end the script
    return PAGE.read_text(encoding='utf-8').replace('"FACTS"', text).encode()


def _saved(grid: OccupancyGrid, save: Save, body: bytes) -> str:
    try:
        document = json.loads(body)
    except ValueError:
        raise InputError('not JSON') from None
    return save(*edited(grid, strokes_of(document)))


class _Handler(BaseHTTPRequestHandler):
    def __init__(
        self, page: bytes, path: str, answer: Callable[[bytes], str], *connection: Any
    ) -> None:
        self._page, self._path, self._answer_to = page, path, answer
        super().__init__(*connection)

    def do_GET(self) -> None:
        if self.path != self._path:
            return self.send_error(HTTPStatus.NOT_FOUND)
        self._send(HTTPStatus.OK, 'text/html; charset=utf-8', self._page)

    def do_POST(self) -> None:
        length = self.headers.get('Content-Length', '')
        if self.path != f'{self._path}save' or not length.isdecimal():
            return self.send_error(HTTPStatus.NOT_FOUND)
        if int(length) > MOST_BYTES:
            return self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        try:
            status, line = HTTPStatus.OK, self._answer_to(self.rfile.read(int(length)))
        except (InputError, OverflowError, RecursionError) as error:
            status, line = HTTPStatus.BAD_REQUEST, str(error)
        self._send(status, 'text/plain; charset=utf-8', line.encode())

    def _send(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header('Content-Type', kind)
        self.send_header('Content-Length', str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        """Log nothing: requests are no news."""
