"""`segfloor map edit`: what is drawn on the page, and what the command makes of it."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.request

import numpy as np
import pytest
from command_line import segfloor

from segfloor_ros.apps.cli.map_editor import PAGE, Stroke, edited, page_of, strokes_of
from segfloor_ros.apps.map_files import load_map
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.nodes.map_files import save_map

F, X, U = 0, 100, -1


def drawn_map() -> OccupancyGrid:
    """A map of 4 by 5 cells of 0.5 m, its lower left corner at (-1, 2); row 0 is the lowest."""
    rows = [[F, F, F, F, X], [F, X, F, F, X], [F, F, F, F, X], [U, U, U, U, U]]
    return OccupancyGrid(np.array(rows, np.int8), 0.5, (-1.0, 2.0))


def stroke(tool: str, *points: tuple[float, float], width_m: float = 0.5) -> Stroke:
    return Stroke(tool, np.array(points), width_m)


def test_strokes_change_the_cells_below_them_in_their_order() -> None:
    strokes = [
        stroke('erase', (-0.25, 2.75)),  # the single obstacle, row 1, column 1
        stroke('wall', (-0.75, 3.75), (0.75, 3.75)),  # row 3, columns 0 to 3
        stroke('erase', (0.25, 3.75)),  # a gap in it, column 2
    ]
    corrected, zones = edited(drawn_map(), strokes)
    assert corrected.cells.tolist() == [
        [F, F, F, F, X],
        [F, F, F, F, X],
        [F, F, F, F, X],
        [X, X, F, X, U],
    ]
    assert (corrected.resolution_m, corrected.origin_xy_m) == (0.5, (-1.0, 2.0))
    assert zones is None


def test_a_keepout_zone_is_filled_in_a_mask_and_leaves_the_map() -> None:
    corners = (-0.75, 2.25), (0.25, 2.25), (0.25, 3.25), (-0.75, 3.25)
    corrected, zones = edited(drawn_map(), [stroke('keepout', *corners)])
    assert corrected.cells.tolist() == drawn_map().cells.tolist()
    assert zones is not None
    assert zones.cells.tolist() == [
        [X, X, X, F, F],
        [X, X, X, F, F],
        [X, X, X, F, F],
        [F, F, F, F, F],
    ]


def test_a_brush_is_as_wide_as_it_says_and_what_lies_beyond_the_map_is_left_out() -> None:
    corrected, _ = edited(drawn_map(), [stroke('wall', (-9.0, 3.0), (9.0, 3.0), width_m=1.5)])
    assert corrected.cells.tolist() == [[F, F, F, F, X], *[[X] * 5] * 3]
    far = [stroke('wall', (5e4, 5e4)), stroke('keepout', (5e4, 0.0), (5e4, 9.0), (4e4, 9.0))]
    assert edited(drawn_map(), far)[0].cells.tolist() == drawn_map().cells.tolist()


@pytest.mark.parametrize(
    'document',
    [
        [],
        {},
        {'strokes': 3},
        {'strokes': [{'tool': 'wall', 'points': [[0, 0]]}]},
        {'strokes': [{'tool': 'paint', 'points': [[0, 0]], 'width_m': 1}]},
        {'strokes': [{'tool': 'wall', 'points': [0, 0], 'width_m': 1}]},
        {'strokes': [{'tool': 'wall', 'points': [[0, float('nan')]], 'width_m': 1}]},
        {'strokes': [{'tool': 'wall', 'points': [[0, 1e9]], 'width_m': 1}]},
        {'strokes': [{'tool': 'wall', 'points': [[0, 0]], 'width_m': -1}]},
        {'strokes': [{'tool': 'wall', 'points': [[0, 0]], 'width_m': float('inf')}]},
    ],
)
def test_impossible_strokes_are_refused(document) -> None:
    with pytest.raises(InputError, match='strokes'):
        strokes_of(document)


@pytest.fixture
def page(tmp_path):
    """The command on a map, and the address that it prints."""
    save_map(drawn_map(), tmp_path / 'map.yaml')
    command = [sys.executable, '-m', 'segfloor_ros.apps.cli.main', 'map', 'edit']
    names = [str(tmp_path / name) for name in ('map.yaml', 'corrected.yaml')]
    process = subprocess.Popen([*command, *names], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield process.stdout.readline().removeprefix('page: ').strip(), process
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
        assert process.returncode == 0


def answer(address: str, body: bytes | None = None) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(urllib.request.Request(address, body), timeout=30) as found:
            return found.status, found.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def test_what_the_page_saves_is_written_beside_the_map(page, tmp_path) -> None:
    address, _ = page
    assert re.fullmatch(r'http://127\.0\.0\.1:\d+/[\w-]{16,}/', address)
    before = (tmp_path / 'map.pgm').read_bytes()
    status, text = answer(address)
    assert status == 200 and 'Draw keepout' in text and str(tmp_path / 'map.yaml') in text
    wall = {'tool': 'wall', 'points': [[-0.75, 3.75]], 'width_m': 0.2}
    zone = {'tool': 'keepout', 'points': [[-0.75, 2.25], [0.25, 2.25]], 'width_m': 0.2}
    for strokes in ([wall], [wall, zone]):  # saved again, the command replaces its own files
        status, line = answer(f'{address}save', json.dumps({'strokes': strokes}).encode())
        assert status == 200 and line.startswith(f'saved: {tmp_path / "corrected.yaml"}')
    assert 'type: 0' in line
    assert load_map(tmp_path / 'corrected.yaml').cells[3].tolist() == [X, U, U, U, U]
    assert load_map(tmp_path / 'corrected_keepout.yaml').cells[0].tolist() == [X, X, X, F, F]
    assert (tmp_path / 'map.pgm').read_bytes() == before
    # A zone that is taken back leaves the mask, too.
    _, line = answer(f'{address}save', json.dumps({'strokes': [wall]}).encode())
    assert 'no zone is left in the keepout mask' in line
    assert (load_map(tmp_path / 'corrected_keepout.yaml').cells == F).all()


def test_only_who_has_the_address_can_save_and_nonsense_is_refused(page, tmp_path) -> None:
    address, _ = page
    root = address.rsplit('/', 2)[0]
    assert [answer(f'{root}{path}')[0] for path in ('/', '/x/')] == [404, 404]
    assert answer(f'{root}/x/save', b'{"strokes": []}')[0] == 404
    assert answer(f'{address}save', b'no json') == (400, 'not JSON')
    far = [{'tool': 'wall', 'points': [[int('9' * 400), 0]], 'width_m': 0.2}]
    for body in (b'{}', b'[' * 100_000, json.dumps({'strokes': far}).encode()):
        assert answer(f'{address}save', body)[0] == 400
    assert not (tmp_path / 'corrected.yaml').exists()


def test_the_map_itself_and_files_of_others_are_not_replaced(tmp_path) -> None:
    save_map(drawn_map(), tmp_path / 'map.yaml')
    (tmp_path / 'notes_keepout.yaml').write_text('mine')
    for name in ('map.yaml', 'notes.yaml'):
        done = segfloor('map', 'edit', tmp_path / 'map.yaml', tmp_path / name)
        assert done.returncode == 2 and done.stderr.count('\n') == 1, done.stderr
    assert (tmp_path / 'notes_keepout.yaml').read_text() == 'mine'


NODE = """
const elements = {};
const element = () => new Proxy({listeners: {}, dataset: {}, classList: {toggle() {}},
  getBoundingClientRect: () => ({left: 10, top: 20}), setPointerCapture() {},
  getContext: () => new Proxy({}, {get: () => () => {}, set: () => true})}, {});
globalThis.document = {
  getElementById: id => elements[id] ??= element(), querySelectorAll: () => []};
globalThis.Image = class {};
elements.width = Object.assign(element(), {value: '0.2'});
elements.zoom = Object.assign(element(), {value: '2'});
const sent = [];
globalThis.fetch = async (path, {body}) => {
  sent.push(JSON.parse(body));
  return {text: () => 'ok'};
};
SCRIPT
const map = elements.map;
const drag = (...at) => {
  map.onpointerdown({clientX: at[0][0], clientY: at[0][1], pointerId: 1});
  for (const [x, y] of at.slice(1)) map.onpointermove({clientX: x, clientY: y});
  map.onpointerup();
};
choose('wall');
drag([10, 20], [20, 28]);
drag([12, 22]);
elements.undo.onclick();
elements.save.onclick().then(() => console.log(JSON.stringify([sent, elements.line.textContent])));
"""


@pytest.mark.skipif(shutil.which('node') is None, reason='node is not installed')
def test_the_page_sends_what_was_dragged_in_metres_without_what_was_undone() -> None:
    """At two pixels a cell the upper left corner of the picture is (-1, 4), and up is up."""
    text = page_of(drawn_map(), '</script>').decode()
    (script,) = re.findall('<script>(.*?)</script>', text, re.DOTALL)
    program = NODE.replace('SCRIPT', script)
    done = subprocess.run(['node', '-e', program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    sent, line = json.loads(done.stdout)
    corner = [-1.0, 4.0]
    drawn = {'tool': 'wall', 'width_m': 0.2, 'points': [corner, corner, [1.5, 2.0]]}
    assert sent == [{'strokes': [drawn]}]
    assert line == 'ok'


def test_the_page_comes_with_the_package() -> None:
    assert PAGE.name in (PAGE.parents[3] / 'setup.py').read_text()
