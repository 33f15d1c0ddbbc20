"""Results are written in one step, and nothing of others is replaced, removed or followed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.results import (
    MARKER,
    add_files,
    check_target,
    check_writable,
    folder_in_the_making,
    move_into_place,
    own_files,
    replacing,
    scratch_folder,
)


def write(target: Path, files: dict[str, str]) -> None:
    with folder_in_the_making(target) as made:
        for name, text in files.items():
            (made / name).parent.mkdir(parents=True, exist_ok=True)
            (made / name).write_text(text)
        move_into_place(made, target)


def content(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): path.read_text()
        for path in folder.rglob('*')
        if path.is_file() and path.name != MARKER
    }


def test_a_result_takes_the_place_of_the_last_one_and_leaves_nothing_beside(tmp_path):
    out = tmp_path / 'deep' / 'out'
    write(out, {'map.pgm': '1', 'floor_masks/0.png': '1', 'floor_masks/1.png': '1'})
    write(out, {'map.pgm': '2', 'floor_masks/0.png': '2'})
    assert content(out) == {'map.pgm': '2', 'floor_masks/0.png': '2'}
    assert own_files(out) == {'map.pgm', 'floor_masks/0.png'}
    assert list(out.parent.iterdir()) == [out]
    assert out.stat().st_mode & 0o777 == 0o777 & ~_umask()


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask


def test_the_last_result_is_swapped_for_the_new_one_in_one_step(tmp_path):
    out = tmp_path / 'out'
    write(out, {'map.pgm': '1'})
    before = out.stat().st_ino
    with folder_in_the_making(out) as made:
        (made / 'map.pgm').write_text('2')
        new = made.stat().st_ino
        assert content(out) == {'map.pgm': '1'}
        move_into_place(made, out)
        assert (out.stat().st_ino, made.stat().st_ino) == (new, before)


@pytest.mark.parametrize('first', [{}, {'map.pgm': '1', 'floor_masks/0.png': '1'}])
def test_files_of_others_stay_where_they_are(tmp_path, first):
    out = tmp_path / 'out'
    if first:
        write(out, first)
    theirs = {'notes.txt': 'mine', 'floor_masks/mine.png': 'mine', 'other/a/b': 'mine'}
    for name, text in theirs.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(text)
    inode = out.stat().st_ino
    write(out, {'map.pgm': '2', 'moving_masks/0.png': '2'})
    assert content(out) == {'map.pgm': '2', 'moving_masks/0.png': '2', **theirs}
    assert out.stat().st_ino == inode
    assert [path.name for path in tmp_path.iterdir()] == ['out']
    assert not list(out.glob('.segfloor-*'))


def test_what_is_in_the_way_is_named_and_stays(tmp_path):
    out = tmp_path / 'out'
    (out / 'floor_masks').mkdir(parents=True)
    (out / 'floor_masks' / '0.png').write_text('mine')
    with pytest.raises(InputError, match=r'out: holds floor_masks, which segfloor did not write'):
        check_target(out, ['map.pgm', 'floor_masks'])
    check_target(out, ['map.pgm'])
    with pytest.raises(InputError, match=r'holds floor_masks/0\.png'):
        write(out, {'map.pgm': '1', 'floor_masks/0.png': '1'})
    assert content(out) == {'floor_masks/0.png': 'mine'}
    with pytest.raises(InputError, match=r'holds floor_masks/0\.png'):
        add_files(out, {'floor_masks/0.png': b'1'})
    add_files(out, {'report.html': b'1'})
    add_files(out, {'report.html': b'2'})
    assert own_files(out) == {'report.html'}
    assert content(out) == {'floor_masks/0.png': 'mine', 'report.html': '2'}


def test_no_link_is_followed(tmp_path):
    """Not that of a folder, of a file, or of a folder of pictures within results."""
    elsewhere = tmp_path / 'elsewhere'
    elsewhere.mkdir()
    (elsewhere / 'map.pgm').write_text('mine')
    linked, out = tmp_path / 'linked', tmp_path / 'out'
    linked.symlink_to(elsewhere)
    with pytest.raises(InputError, match=r'linked: is a link'):
        check_target(linked, ['map.pgm'])
    with pytest.raises(InputError, match=r'linked: is a link'):
        write(linked, {'map.pgm': '1'})
    write(out, {'map.pgm': '1', 'floor_masks/map.pgm': '1'})
    (out / 'floor_masks' / 'map.pgm').unlink()
    (out / 'floor_masks').rmdir()
    (out / 'floor_masks').symlink_to(elsewhere)
    with pytest.raises(InputError, match=r'out: holds floor_masks'):
        check_target(out, ['floor_masks'])
    write(out, {'map.pgm': '2'})  # what was floor_masks/map.pgm is not removed through the link
    (out / 'map.pgm').unlink()
    (out / 'map.pgm').symlink_to(elsewhere / 'map.pgm')
    with pytest.raises(InputError, match=r'holds map\.pgm'):
        write(out, {'map.pgm': '3'})
    with pytest.raises(OSError, match='link'), replacing(out / 'map.pgm'):
        pass
    with pytest.raises(InputError, match='link'):
        check_writable(out / 'map.pgm', '--save-map')
    assert content(elsewhere) == {'map.pgm': 'mine'}


def test_an_input_is_no_place_for_results(tmp_path):
    recording = tmp_path / 'data' / 'drive'
    recording.mkdir(parents=True)
    for out in (recording, recording / 'out', tmp_path / 'data', tmp_path / 'data' / '..' / 'data'):
        with pytest.raises(InputError, match=r'is, holds or lies in .*drive, which is read'):
            check_target(out, [], [recording])
    check_target(tmp_path / 'data' / 'out', [], ['', 's3://bucket/drive', recording])


def test_a_marker_cannot_name_files_elsewhere(tmp_path):
    (tmp_path / 'mine').write_text('mine')
    out = tmp_path / 'out'
    write(out, {'map.pgm': '1'})
    (out / MARKER).write_text(f'map.pgm\n../mine\n{tmp_path}/mine\n')
    write(out, {'map.pgm': '2'})
    assert (tmp_path / 'mine').read_text() == 'mine'


def test_results_of_releases_without_a_marker_are_known(tmp_path):
    out = tmp_path / 'out'
    (out / 'floor_masks').mkdir(parents=True)
    (out / 'summary.json').write_text('{"tracked_frames": 3, "map_updates": 1}')
    for name in ('map.pgm', 'floor_masks/0.png', 'notes.txt'):
        (out / name).write_text('old')
    check_target(out, ['map.pgm', 'floor_masks', 'summary.json'])
    write(out, {'map.pgm': 'new'})
    assert content(out) == {'map.pgm': 'new', 'notes.txt': 'old'}


def test_where_nothing_can_be_written_is_said_first(tmp_path):
    (tmp_path / 'file').write_text('')
    for bad in (tmp_path / 'file' / 'out', Path('/proc/out')):
        with pytest.raises(InputError, match='cannot be written'), folder_in_the_making(bad):
            pass
        with pytest.raises(InputError, match='cannot be written'):
            check_writable(bad / 'a.map', '--save-map')


@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_a_program_that_is_killed_leaves_no_folder_behind(tmp_path, number):
    program = (
        'import sys, time, pathlib; from segfloor_ros.core.files.results import scratch_folder\n'
        'with scratch_folder(pathlib.Path(sys.argv[1])) as folder:\n'
        '    (folder / "picture").write_text("1"); print(flush=True); time.sleep(60)'
    )
    words = [sys.executable, '-c', program, str(tmp_path)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        process.stdout.readline()
        assert [path.name[:10] for path in tmp_path.iterdir()] == ['.segfloor-']
        process.send_signal(number)
    end_s = time.monotonic() + 10
    while list(tmp_path.iterdir()) and time.monotonic() < end_s:
        time.sleep(0.02)
    assert list(tmp_path.iterdir()) == []


def test_a_scratch_folder_is_private_and_goes(tmp_path):
    with scratch_folder(tmp_path) as folder:
        assert folder.stat().st_mode & 0o777 == 0o700
    assert list(tmp_path.iterdir()) == []
