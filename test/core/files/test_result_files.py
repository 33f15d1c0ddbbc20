"""Results are written in one step, and nothing of others is replaced, removed or followed."""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.writing import (
    MARKER,
    YAML,
    add_files,
    check_output,
    check_target,
    folder_in_the_making,
    move_into_place,
    output_file,
    own_files,
    scratch_folder,
    write_output,
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
    assert own_files(out).keys() == {'map.pgm', 'floor_masks/0.png'}
    assert list(out.parent.iterdir()) == [out]
    assert out.stat().st_mode & 0o777 == 0o777 & ~_umask()


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask


def test_an_input_is_no_place_for_results(tmp_path):
    recording = tmp_path / 'data' / 'drive'
    recording.mkdir(parents=True)
    for out in (recording, recording / 'out', tmp_path / 'data', tmp_path / 'data' / '..' / 'data'):
        with pytest.raises(InputError, match=r'is, holds or lies in .*drive, which is read'):
            check_target(out, [], [recording])
    check_target(tmp_path / 'data' / 'out', [], ['', 's3://bucket/drive', recording])
    with pytest.raises(InputError, match='which is read'):  # though it is not there yet
        check_target(tmp_path / 'new', [], [tmp_path / 'new' / 'drive'])


def test_a_scratch_folder_is_private_and_goes(tmp_path):
    with scratch_folder(tmp_path) as folder:
        assert folder.stat().st_mode & 0o777 == 0o700
    assert list(tmp_path.iterdir()) == []


def test_files_of_others_stay_where_they_are(tmp_path):
    out = tmp_path / 'out'
    write(out, {'map.pgm': '1', 'floor_masks/0.png': '1'})
    theirs = {'notes.txt': 'mine', 'floor_masks/mine.png': 'mine', 'other/a/b': 'mine'}
    for name, text in theirs.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(text)
    write(out, {'map.pgm': '2', 'moving_masks/0.png': '2'})
    assert content(out) == {'map.pgm': '2', 'moving_masks/0.png': '2', **theirs}
    assert [path.name for path in tmp_path.iterdir()] == ['out']
    assert not list(out.glob('.segfloor-*'))


def test_what_is_in_the_way_is_named_and_stays(tmp_path):
    out = tmp_path / 'out'
    write(out, {'map.pgm': '1'})
    (out / 'floor_masks').mkdir()
    (out / 'floor_masks' / '0.png').write_text('mine')
    with pytest.raises(InputError, match=r'out: holds floor_masks, which segfloor did not write'):
        check_target(out, ['map.pgm', 'floor_masks'])
    with pytest.raises(InputError, match=r'holds floor_masks/0\.png'):
        write(out, {'map.pgm': '2', 'floor_masks/0.png': '2'})
    with pytest.raises(InputError, match=r'holds floor_masks/0\.png'):
        add_files(out, {'floor_masks/0.png': b'2'})
    assert content(out) == {'map.pgm': '1', 'floor_masks/0.png': 'mine'}
    with pytest.raises(InputError, match=r'holds map\.pgm of another command'):
        check_target(out, ['calib.txt'])


def test_a_marker_proves_nothing_for_a_file_with_other_content(tmp_path):
    """Neither the name alone, as in an older marker, nor what was changed since."""
    out = tmp_path / 'out'
    write(out, {'map.pgm': '1', 'map.yaml': '1'})
    (out / 'map.pgm').write_text('mine')
    assert own_files(out).keys() == {'map.yaml'}
    with pytest.raises(InputError, match=r'holds map\.pgm, .* or which was changed since'):
        write(out, {'map.pgm': '2'})
    (out / MARKER).write_text('map.pgm\n  map.yaml\n../mine\n')
    assert own_files(out) == {}
    with pytest.raises(InputError, match='which segfloor did not write'):
        write(out, {'map.yaml': '2'})
    assert content(out) == {'map.pgm': 'mine', 'map.yaml': '1'}


@pytest.mark.parametrize('step', range(1, 9))
def test_a_program_that_ends_while_files_are_moved_leaves_whole_files_of_its_own(
    tmp_path, monkeypatch, step
):
    """Whichever move it is, the next run knows the files that are there, and replaces them."""
    out, left = tmp_path / 'out', [step]
    write(out, {'a': '1', 'b': '1', 'c': '1'})
    replace = Path.replace

    def end_at(path, target):
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt
        return replace(path, target)

    with monkeypatch.context() as patched, contextlib.suppress(KeyboardInterrupt):
        patched.setattr(Path, 'replace', end_at)
        write(out, {'a': '2', 'b': '2', 'd': '2'})
    assert set(content(out)) <= {'a', 'b', 'c', 'd'}
    assert own_files(out).keys() == content(out).keys()
    write(out, {'a': '3'})
    assert content(out) == {'a': '3'}


def test_where_nothing_can_be_written_is_said_first(tmp_path):
    (tmp_path / 'file').write_text('')
    for bad in (tmp_path / 'file' / 'out', Path('/proc/out')):
        with pytest.raises(InputError, match='cannot be written'), folder_in_the_making(bad):
            pass
        with pytest.raises(InputError, match='cannot be written'):
            check_output(bad / 'a.yaml', YAML)


def test_a_folder_that_nothing_came_of_is_as_it_was(tmp_path):
    (tmp_path / 'empty').mkdir()
    for out in (tmp_path / 'empty', tmp_path / 'new'):
        with pytest.raises(ZeroDivisionError), folder_in_the_making(out) as made:
            (made / 'map.pgm').write_text('1')
            1 / 0  # noqa: B018
    assert list(tmp_path.iterdir()) == [tmp_path / 'empty']
    assert list((tmp_path / 'empty').iterdir()) == []


def test_a_file_that_appears_meanwhile_is_not_replaced(tmp_path):
    path = tmp_path / 'map.yaml'
    with pytest.raises(InputError, match='segfloor wrote'), output_file(path, YAML) as file:
        file.write(b'# written by segfloor')
        path.write_text('mine')
    assert path.read_text() == 'mine'
    assert list(tmp_path.iterdir()) == [path]


PROGRAM = """
import sys, time, pathlib
from segfloor_ros.core.files.writing import YAML, output_file, scratch_folder
out = pathlib.Path(sys.argv[1])
with scratch_folder(out) as folder, output_file(out / 'map.yaml', YAML):
    (folder / 'picture').write_text('1')
    print(flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGINT])
def test_what_a_killed_program_leaves_is_removed_by_the_next_one(tmp_path, monkeypatch, number):
    """But not what another program is at, nor what has taken the place of what was left."""
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    folders = [tmp_path / name for name in ('killed', 'works')]
    for folder in folders:
        folder.mkdir()
    words = [sys.executable, '-c', PROGRAM]
    programs = [
        subprocess.Popen([*words, str(f)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        for f in folders
    ]
    try:
        for program, folder in zip(programs, folders, strict=True):
            program.stdout.readline()
            assert len(list(folder.glob('.segfloor-*'))) == 2
        programs[0].send_signal(number)
        programs[0].communicate(timeout=10)
        (kept,) = [tmp_path / 'killed' / '.segfloor-mine']
        kept.mkdir()
        notes = tmp_path / 'cache' / 'segfloor' / 'temporary'
        foreign = {'a.json': '["x", 1, 2]', 'b': '"text"', 'c': 'no JSON', 'd': '{"e": 1}'}
        for name, text in foreign.items():
            (notes / name).write_text(text)
        write_output(tmp_path / 'next.yaml', YAML, b'# written by segfloor')
        assert list((tmp_path / 'killed').iterdir()) == [kept]
        assert foreign.keys() < {path.name for path in notes.iterdir()}
        assert len(list((tmp_path / 'works').glob('.segfloor-*'))) == 2
    finally:
        for program in programs:
            program.kill()
            program.communicate()
