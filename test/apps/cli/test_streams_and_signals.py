"""The command line with impossible names, outputs and signals: one line, and no traceback."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command_line import segfloor, segfloor_process
from stereo_drive import room_drive, write_kitti

START = 'from segfloor_ros.apps.cli import start; start()'
ENVIRONMENT = {**os.environ, 'PYTHONPATH': str(Path(__file__).resolve().parents[3])}


@pytest.fixture(scope='module')
def drive(tmp_path_factory) -> Path:
    return write_kitti(tmp_path_factory.mktemp('recording') / 'drive', room_drive(8)[0])


def shell(words: str, **variables: object) -> subprocess.CompletedProcess[str]:
    """Run a line of a shell, with the command line as $segfloor."""
    environment = {**ENVIRONMENT, 'PYTHON': sys.executable, 'START': START}
    environment |= {name: str(value) for name, value in variables.items()}
    line = f'segfloor() {{ "$PYTHON" -c "$START" "$@"; }}; {words}'
    return subprocess.run(['bash', '-c', line], capture_output=True, text=True, env=environment)


@pytest.mark.parametrize('name', ['~nosuchuser/x', 'a' * 300])
def test_an_impossible_name_is_one_line(drive, tmp_path, name):
    suite = tmp_path / 'suite.yaml'
    suite.write_text(f'recordings:\n  - input: {name}\n')
    out = tmp_path / 'out'
    for words in (
        ['info', name], ['run', name, '--out', out], ['run', drive, '--out', out, '--masks', name],
        ['check', suite, '--out', out], ['convert', name, tmp_path / 'out.mcap'],
        ['map', 'info', name], ['evaluate', 'map', name, name], ['view', name],
        ['run', drive, '--out', out, '--load-map', name],
        ['run', drive, '--out', out, '--params', f'{name}.yaml'],
    ):  # fmt: skip
        done = segfloor(*words)
        assert done.returncode == 2, words
        assert len(done.stderr.strip().splitlines()) == 1, done.stderr
        assert name[:40] in done.stderr


@pytest.mark.slow
def test_an_output_that_is_full_or_closed_is_no_traceback(drive):
    full = shell('segfloor info "$DRIVE" > /dev/full', DRIVE=drive)
    assert full.returncode == 1
    assert full.stderr.strip() == 'segfloor: standard output: No space left on device'
    for words in ('>&-', '2>&-', '<&- >&- 2>&-'):
        done = shell(f'segfloor info "$DRIVE" {words}', DRIVE=drive)
        assert (done.returncode, done.stderr.strip()) == (0, ''), words
    assert 'Traceback' not in shell('segfloor info "$DRIVE" | true', DRIVE=drive).stderr


@pytest.mark.slow
def test_a_closed_output_does_not_end_up_in_a_result(drive, tmp_path):
    """The next file that is opened takes the number of the closed one."""
    out = tmp_path / 'out'
    done = shell('segfloor run "$DRIVE" --out "$OUT" >&- 2>&-', DRIVE=drive, OUT=out)
    assert done.returncode == 0
    assert segfloor('evaluate', 'map', out, out).returncode == 0
    for path in out.rglob('*.txt'):
        np.loadtxt(path)


@pytest.mark.slow
def test_names_pass_no_control_characters_on_and_need_not_be_text(drive, tmp_path):
    name = os.fsdecode(b'dr\xff\x1b[31mive')
    strange = tmp_path / name
    strange.symlink_to(drive)
    out = tmp_path / os.fsdecode(b'out\xfe\x1b[2J')
    for words in (
        ['info', strange], ['run', strange, '--out', out, '--report'],
        ['evaluate', 'map', out, out], ['run', strange / 'nowhere', '--out', out],
    ):  # fmt: skip
        done = segfloor_process(*words)
        assert 'Traceback' not in done.stderr
        assert '\x1b' not in done.stdout + done.stderr, words
    page = (out / 'report.html').read_bytes()
    assert b'\x1b' not in page and b'ive' in page
    page.decode()


SLOW_IMPORT = (
    'import sys, time, types\n'
    'class Slow:\n'
    '    def find_spec(self, name, path=None, target=None):\n'
    '        if name == "cv2":\n'
    '            print("importing", flush=True)\n'
    '            try:\n'
    '                time.sleep(60)\n'
    '            except BaseException as error:\n'
    '                raise ImportError("broken off") from error\n'
    'sys.meta_path.insert(0, Slow())\n'
)


@pytest.mark.parametrize(
    'number',
    [
        signal.SIGINT,
        *(pytest.param(n, marks=pytest.mark.slow) for n in (signal.SIGTERM, signal.SIGHUP)),
    ],
)
@pytest.mark.parametrize(
    ('start', 'status'),
    [(START, None), ('from segfloor_ros.apps.programs import stereo_slam; stereo_slam()', 0)],
)
def test_a_signal_while_modules_are_imported_ends_in_silence(
    drive, tmp_path, start, status, number
):
    words = [sys.executable, '-c', SLOW_IMPORT + start, 'run', str(drive), '--out', 'x']
    process = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT,
        cwd=tmp_path,
    )  # fmt: skip
    assert process.stdout.readline() == 'importing\n'
    process.send_signal(number)
    _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (128 + number if status is None else status, '')


@pytest.mark.slow
def test_a_suite_that_is_terminated_ends_in_silence(drive, tmp_path):
    suite = tmp_path / 'suite.yaml'
    suite.write_text(f'recordings:\n  - input: {drive}\n')
    words = ['check', str(suite), '--out', str(tmp_path / 'out'), '--no-cache', '--jobs', '2']
    process = subprocess.Popen(
        [sys.executable, '-c', START, *words], stderr=subprocess.PIPE, text=True, env=ENVIRONMENT
    )
    while not (tmp_path / 'out').exists() and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (128 + signal.SIGTERM, '')


@pytest.mark.slow
def test_threads_of_the_environment_do_not_change_a_result(drive, tmp_path):
    for threads in ('1', '7'):
        done = shell('segfloor run "$DRIVE" --out "$OUT"', DRIVE=drive, OUT=tmp_path / threads,
                     OPENBLAS_NUM_THREADS=threads, OMP_NUM_THREADS=threads)  # fmt: skip
        assert done.returncode == 0, done.stderr
    for name in ('trajectory.txt', 'labelled_cloud.ply', 'map.pgm'):
        assert (tmp_path / '1' / name).read_bytes() == (tmp_path / '7' / name).read_bytes()
