"""The command works with what package.xml installs, and loads what a command needs when it runs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from stereo_drive import room_drive, write_kitti

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
sys.argv = {words}
from segfloor_ros.apps.cli import start
start()
"""


def without(missing: tuple[str, ...], *words: object) -> subprocess.CompletedProcess[str]:
    """Run a command where some packages are not installed."""
    script = START.format(missing=set(missing), words=['segfloor', *map(str, words)])
    command = [sys.executable, '-c', script]
    root = str(Path(__file__).resolve().parents[3])
    environment = {**os.environ, 'PYTHONPATH': root}
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)


def test_the_version_needs_nothing_at_all() -> None:
    done = without((*EXTRAS, *LARGE, 'typer', 'rich'), '--version')
    assert (done.returncode, done.stdout[:13], done.stderr) == (0, 'segfloor_ros ', '')


def test_the_help_loads_no_large_library() -> None:
    done = without((*EXTRAS, *LARGE), '--help')
    assert done.returncode == 0, done.stderr
    assert all(f' {name} ' in done.stdout for name in COMMANDS)


@pytest.mark.parametrize('name', COMMANDS)
def test_every_command_has_a_help_without_extras(name) -> None:
    done = without(EXTRAS, name, '--help')
    assert done.returncode == 0, done.stderr


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
        (('evaluate', 'trajectory', 'a.txt', 'b.txt'), 'evo', "'segfloor_ros[evaluate]'"),
        (('view', 'room'), 'rerun', "'segfloor_ros[view]'"),
        (('simulate', 'corridor1', '--out', 'out'), 'MuJoCo', "'segfloor_ros[sim]'"),
    ],
)
def test_a_command_names_in_one_line_what_to_install(words, package, installed, tmp_path) -> None:
    write_kitti(tmp_path / 'room', room_drive(2)[0])
    words = [str(tmp_path / word) if word in ('out', 'room') else word for word in words]
    done = without(EXTRAS, *words)
    assert done.returncode == 2
    assert done.stderr.startswith('segfloor: ') and done.stderr.count('\n') == 1
    assert package in done.stderr and f'pip install {installed}' in done.stderr
