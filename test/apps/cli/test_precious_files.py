"""No command replaces, changes or removes a file of the user: every command that writes, onto files
of every kind, by every form of collision.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
from chessboards import write_boards
from command_line import segfloor
from stereo_drive import room_drive, write_kitti
from stereo_room import MOUNT

from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.nodes.map_files import save_map

KNOWN_MOUNT = [
    word
    for name in ('height_m', 'pitch_rad', 'roll_rad')
    for word in ('--set', f'stereo_slam.camera_{name}={getattr(MOUNT, name)}')
]

PRECIOUS = {
    'notes.txt': b'written by segfloor? no, by me',
    'photo.png': cv2.imencode('.png', np.zeros((9, 9), np.uint8))[1].tobytes(),
    'map.yaml': b'image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n',
    'map.pgm': b'P5\n2 2\n255\n1234',
    'map_labels.yaml': b'image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n',
    'bag.mcap': b'\x89MCAP0\r\nmine',
    'theirs.map': b'PK\x03\x04 header.json, but no map',
    'view.rrd': b'RRF2 of another program',
    'page.html': b'<!DOCTYPE html>\n<p>mine</p>',
    'summary.json': b'{"tracked_frames": 1, "map_updates": 1}',
    'rendered_from.txt': b'mine',
    'baseline.json': b'{"recordings": 3}',
    'plot.svg': b'<?xml version="1.0"?><svg/>',
    'left.yaml': b'image_width: 3\n',
    'calibration.html': b'<!DOCTYPE html>\n<p>mine</p>',
    'junit.xml': b'<testsuites/>',
    'empty': b'',
}


@pytest.fixture(scope='module')
def made(tmp_path_factory) -> Path:
    """A folder with a recording, a saved map, results, labels and a suite."""
    folder = tmp_path_factory.mktemp('made')
    frames, _ = room_drive(20)
    write_kitti(folder / 'drive', frames)
    done = segfloor('run', folder / 'drive', '--out', folder / 'result', '--save-map',
                    folder / 'home.map', *KNOWN_MOUNT)  # fmt: skip
    assert done.returncode == 0, done.stderr
    shutil.copy(folder / 'home.map', folder / 'other.map')
    grid = OccupancyGrid(np.zeros((4, 5), np.int8), 0.05, (0.0, 0.0))
    save_map(grid, folder / 'labels.yaml', 'raw', {'classes': ['grass']})
    (folder / 'suite.yaml').write_text(f'recordings:\n  - input: {folder / "drive"}\n')
    return folder


@pytest.fixture
def precious(tmp_path) -> Path:
    """A folder of files of every kind, with a folder, links, a pipe and a second name."""
    folder = tmp_path / 'precious'
    folder.mkdir()
    for name, content in PRECIOUS.items():
        (folder / name).write_bytes(content)
    (folder / 'folder').mkdir()
    (folder / 'folder' / 'deep.txt').write_bytes(b'mine')
    (folder / 'link').symlink_to(folder / 'notes.txt')
    (folder / 'dangling').symlink_to(folder / 'nowhere')
    (folder / 'linked').symlink_to(folder / 'folder')
    os.mkfifo(folder / 'pipe')
    os.link(folder / 'photo.png', folder / 'again.png')
    return folder


def state_of(folder: Path) -> dict[str, object]:
    """Return what is in a folder: kinds, inodes, links and contents."""
    found: dict[str, object] = {}
    for path in sorted(folder.rglob('*')):
        facts, name = path.lstat(), str(path.relative_to(folder))
        content: object = os.readlink(path) if path.is_symlink() else None
        if path.is_file() and not path.is_symlink():
            content = hashlib.sha256(path.read_bytes()).hexdigest()
        found[name] = facts.st_mode, facts.st_ino, facts.st_size, content
    return found


FILES = [*PRECIOUS, 'folder', 'link', 'dangling', 'linked', 'pipe', 'again.png', 'notes.txt/below']

# {} is what is attacked. Each ends in status 2 and one line, before a frame is processed.
TO_FILES = {
    'run --save-map': 'run {made}/drive --out {new} --save-map {}',
    'run --view': 'run {made}/drive --out {new} --view={}',
    'convert': 'convert {made}/drive {}',
    'record': 'record {} --seconds 1',
    'map merge': 'map merge {made}/home.map {made}/other.map {}',
    'map diff': 'map diff {made}/home.map {made}/other.map {}',
    'map export': 'map export {made}/home.map {}',
    'map filter': 'map filter {made}/labels.yaml {} --keepout grass',
    'evaluate map --overlay': 'evaluate map {made}/result {made}/result --overlay {}',
    'evaluate trajectory --plot': 'evaluate trajectory {path} {path} --plot {}',
    'check --write-baseline': 'check {made}/suite.yaml --out {new} --write-baseline {}',
    'view --out': 'view {made}/result --out {}',
}
TO_FOLDERS = {
    'run': 'run {made}/drive --out {}',
    'replay': 'replay {made}/drive --out {}',
    'simulate': 'simulate corridor1 --out {}',
    'explore': 'explore complex_room --out {}',
    'check': 'check {made}/suite.yaml --out {}',
    'demo': 'demo --lockstep --out {}',
}


def command(words: str, target: Path | str, made: Path, tmp_path: Path) -> list[str]:
    path = made / 'result' / 'trajectory.txt'
    filled = {'made': str(made), 'new': str(tmp_path / 'new'), 'path': str(path)}
    return [w.replace('{}', str(target)).format(**filled) for w in words.split()]


def assert_refused(words: list[str], said: str = '') -> None:
    done = segfloor(*words)
    assert done.returncode == 2, (words, done.stdout, done.stderr)
    assert len(done.stderr.strip().splitlines()) == 1, (words, done.stderr)
    assert said in done.stderr, (words, done.stderr)


@pytest.mark.parametrize('words', TO_FILES.values(), ids=TO_FILES)
def test_no_file_of_the_user_is_written_to(words, made, precious, tmp_path):
    before, inputs = state_of(precious), state_of(made)
    for name in FILES:
        assert_refused(command(words, precious / name, made, tmp_path))
        assert state_of(precious) == before, name
    assert state_of(made) == inputs
    assert not (tmp_path / 'new').exists()


@pytest.mark.parametrize('words', TO_FOLDERS.values(), ids=TO_FOLDERS)
def test_no_folder_of_the_user_is_written_to(words, made, precious, tmp_path):
    (tmp_path / 'summary').mkdir()
    (tmp_path / 'summary' / 'summary.json').write_bytes(PRECIOUS['summary.json'])
    (tmp_path / 'summary' / 'map.pgm').write_bytes(b'mine')
    before, inputs = state_of(tmp_path), state_of(made)
    for target in (
        precious, precious / 'folder', precious / 'linked', precious / 'notes.txt',
        precious / 'dangling', precious / 'pipe', precious / 'notes.txt' / 'below',
        tmp_path / 'summary', precious / '..' / 'precious', Path('/dev/null'),
    ):  # fmt: skip
        assert_refused(command(words, target, made, tmp_path))
        assert state_of(tmp_path) == before, target
    assert state_of(made) == inputs


@pytest.mark.parametrize(
    'words',
    [
        'run {made}/drive --out {made}/drive',
        'run {made}/drive --out {made}/drive/image_0',
        'run {made}/drive --out {made}/drive/out',
        'run {made}/drive --out {made}',
        'run {made}/drive --out {new} --load-map {made}/home.map --save-map {made}/home.map',
        'run {made}/drive --out {new} --load-map {made}/home.map --save-map {tmp}/second_name.map',
        'map merge {made}/home.map {made}/other.map {made}/home.map',
        'map merge {made}/home.map {made}/other.map {made}/other.map',
        'map merge {made}/home.map {made}/other.map {tmp}/second_name.map',
        'map filter {made}/labels.yaml {made}/labels.yaml --keepout grass',
        'convert {made}/drive {made}/drive',
        'simulate corridor1 --out {made}/result',
    ],
)
def test_no_input_is_written_to(words, made, tmp_path):
    """Told by inode: home.map has a second name here."""
    os.link(made / 'home.map', tmp_path / 'second_name.map')
    try:
        before = state_of(made)
        filled = {'made': made, 'new': tmp_path / 'new', 'tmp': tmp_path}
        assert_refused(words.format(**filled).split())
        assert state_of(made) == before
    finally:
        (tmp_path / 'second_name.map').unlink()


def test_what_segfloor_wrote_is_replaced_and_what_was_changed_since_is_not(made, tmp_path):
    out, saved = tmp_path / 'out', tmp_path / 'my.map'
    words = ['run', made / 'drive', '--out', out, '--save-map', saved, *KNOWN_MOUNT]
    for _ in range(2):
        done = segfloor(*words)
        assert done.returncode == 0, done.stderr
    (out / 'notes.txt').write_text('mine')
    assert segfloor(*words).returncode == 0
    assert (out / 'notes.txt').read_text() == 'mine'
    assert segfloor(*words).returncode == 0
    for command_line, name in (
        (['map', 'export', saved], 'map.yaml'),
        (['map', 'diff', saved, made / 'home.map'], 'changes.png'),
        (['evaluate', 'map', out, out, '--overlay'], 'overlay.png'),
        (['evaluate', 'trajectory', *2 * [out / 'trajectory.txt'], '--plot'], 'plot.svg'),
        *([(['view', made / 'result', '--out'], 'view.rrd')] if find_spec('rerun') else []),
    ):
        for _ in range(2):
            done = segfloor(*command_line, tmp_path / name)
            assert done.returncode == 0, done.stderr
    edited = (out / 'map.pgm').read_bytes()[:-1] + b'\x00'
    (out / 'map.pgm').write_bytes(edited)
    assert_refused([*map(str, words)], 'holds map.pgm, which segfloor did not write, or which was')
    assert (out / 'map.pgm').read_bytes() == edited


def test_the_longest_names_are_tried_before_the_first_frame(made, tmp_path):
    longest = 'm' * 251 + '.map'
    done = segfloor('run', made / 'drive', '--out', tmp_path / ('o' * 255), '--save-map',
                    tmp_path / longest, *KNOWN_MOUNT)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {'o' * 255, longest}
    for words in (
        ['run', made / 'drive', '--out', tmp_path / ('o' * 256)],
        ['run', made / 'drive', '--out', tmp_path / 'new', '--save-map', tmp_path / f'a{longest}'],
        ['convert', made / 'drive', tmp_path / ('b' * 251 + '.mcap')],
        ['map', 'export', made / 'home.map', tmp_path / ('e' * 251 + '.yaml')],
    ):
        assert_refused([*map(str, words)], 'File name too long')
    assert {path.name for path in tmp_path.iterdir()} == {'o' * 255, longest}


def test_calibration_files_of_the_user_stay(tmp_path):
    """In the folder of pictures, or another one, which may hold other files."""
    pictures = write_boards(tmp_path / 'pictures', 2)
    (tmp_path / 'out').mkdir()
    (tmp_path / 'out' / 'notes.txt').write_text('mine')
    for target in (pictures, tmp_path / 'out'):
        for name in ('left.yaml', 'right.yaml', 'calibration.html'):
            (target / name).write_text('mine')
            before = state_of(tmp_path)
            words = ('calibrate', pictures, '--square', '0.03', '--out', target)
            assert_refused([*map(str, words)])
            assert state_of(tmp_path) == before
            (target / name).unlink()


def test_a_view_may_lie_in_the_folder_of_results(made, tmp_path):
    pytest.importorskip('rerun')
    out = tmp_path / 'out'
    for _ in range(2):
        done = segfloor('run', made / 'drive', '--out', out, f'--view={out / "drive.rrd"}',
                        *KNOWN_MOUNT)  # fmt: skip
        assert done.returncode == 0, done.stderr
    assert (out / 'drive.rrd').stat().st_size > 1000
