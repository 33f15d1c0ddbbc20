"""The command works with what package.xml installs, and loads what a command needs when it runs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from stereo_drive import room_drive, write_kitti

from segfloor_ros import __version__
from segfloor_ros.apps.cli.main import COMMANDS
from segfloor_ros.apps.cli.main import EXTRAS as PACKAGES

EXTRAS = (
    'evo', 'junitparser', 'rosbags', 'mujoco', 'rerun', 'onnxruntime', 'distributed', 'fsspec',
)  # fmt: skip
"""Not installed by rosdep."""
LARGE = ('numpy', 'cv2', 'scipy', 'yaml', 'matplotlib', 'rclpy')
"""Not needed by what says what there is."""

START = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in {missing}:
            raise ModuleNotFoundError(f'No module named {{name!r}}', name=name)

sys.meta_path.insert(0, Missing())
from segfloor_ros.apps.cli import start
helped = []
for words in {lines}:
    sys.argv = ['segfloor', *words]
    try:
        start()
    except SystemExit as ended:
        if ended.code:
            raise
    helped.append(words[0])
print('every help', *helped)
"""


def without(
    missing: tuple[str, ...], *words: object, each_with: str = ''
) -> subprocess.CompletedProcess[str]:
    """Run a command where some packages are not installed, or, in one process, each of several
    with an option.
    """
    given = [str(word) for word in words]
    lines = [[word, each_with] for word in given] if each_with else [given]
    script = START.format(missing=set(missing), lines=lines)
    command = [sys.executable, '-c', script]
    root = str(Path(__file__).resolve().parents[3])
    environment = {**os.environ, 'PYTHONPATH': root}
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)


def test_the_version_needs_nothing_at_all() -> None:
    done = without((*EXTRAS, *LARGE, 'typer', 'rich'), '--version')
    expected = f'segfloor_ros {__version__}'
    assert (done.returncode, done.stdout.splitlines()[0], done.stderr) == (0, expected, '')


def test_the_help_loads_no_large_library() -> None:
    done = without((*EXTRAS, *LARGE), '--help')
    assert done.returncode == 0, done.stderr
    assert all(f' {name} ' in done.stdout for name in COMMANDS)


def test_every_command_has_a_help_without_extras() -> None:
    done = without(EXTRAS, *COMMANDS, each_with='--help')
    assert done.returncode == 0, done.stderr
    assert done.stdout.split('every help')[-1].split() == [*COMMANDS]


def test_a_recording_is_mapped_without_extras(tmp_path) -> None:
    frames, _ = room_drive(4)
    drive = write_kitti(tmp_path / 'room', frames)
    done = without(EXTRAS, 'run', drive, '--no-map', '--out', tmp_path / 'out')
    assert done.returncode == 0, done.stderr
    assert (tmp_path / 'out' / 'trajectory.txt').exists()


@pytest.mark.slow
def test_the_demo_runs_and_scores_the_map_without_extras(tmp_path):
    done = without(tuple(PACKAGES), 'demo', '--lockstep', '--out', tmp_path / 'demo')
    assert done.returncode == 0, done.stderr
    assert "path: its error is measured after pip install 'segfloor_ros[evaluate]'" in done.stdout
    assert 'segfloor_ros[evaluate]' in (tmp_path / 'demo' / 'report.html').read_text()


@pytest.mark.parametrize(
    ('words', 'package', 'installed'),
    [
        (('check', 'suite.yaml', '--out', 'out'), 'junitparser', 'junitparser'),
        *(
            pytest.param(words, package, f"'segfloor_ros[{extra}]'", marks=pytest.mark.slow)
            for words, package, extra in (
                (('evaluate', 'trajectory', 'a.txt', 'b.txt'), 'evo', 'evaluate'),
                (('view', 'room'), 'rerun', 'view'),
            )
        ),
        (('simulate', 'lane', '--out', 'out'), 'MuJoCo', "'segfloor_ros[sim]'"),
    ],
)
def test_a_command_names_in_one_line_what_to_install(words, package, installed, tmp_path) -> None:
    write_kitti(tmp_path / 'room', room_drive(2)[0])
    words = [str(tmp_path / word) if word in ('out', 'room') else word for word in words]
    done = without(EXTRAS, *words)
    assert done.returncode == 2
    assert done.stderr.startswith('segfloor: ') and done.stderr.count('\n') == 1
    assert package in done.stderr and f'pip install {installed}' in done.stderr
