"""What README and docs/robot.md name, on a robot that has the packages of package.xml alone."""

import importlib.metadata
import os
import re
import subprocess
import venv
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from stereo_drive import room_drive, write_kitti
from test_package import IMPORT_OF_KEY, OF_EXTRAS, REPOSITORY, manifest

pytestmark = pytest.mark.slow

PAGES = ('README.md', 'docs/robot.md')

NODES = ('stereo_camera', 'stereo_slam', 'floor_segmentation', 'cloud_labelling', 'occupancy_grid')

NAMED = re.compile(r'\bsegfloor ([a-z]+)\b')

EXTRA = re.compile(r'pip install .segfloor_ros\[[a-z]+\]')

DISTRIBUTIONS = {'cv2': 'opencv-python-headless', 'yaml': 'pyyaml'}
"""Names on the package index that differ from those of the modules."""

ROS = {'ros-jazzy-rclpy', 'ros-rmw-fastrtps-cpp', 'ros-jazzy-common-interfaces'}
"""The wheels in place of the packages of a ROS installation."""

START = 'import sys; sys.argv[0] = "segfloor"; from segfloor_ros.apps.cli import start; start()'


def with_requirements(names: set[str]) -> set[str]:
    """Return installed distributions and all that they require without their extras."""
    found: set[str] = set()
    while names:
        name = names.pop()
        try:
            requires = importlib.metadata.requires(name) or ()
        except importlib.metadata.PackageNotFoundError:  # of another platform or version
            continue
        found.add(name)
        plain = [line for line in requires if 'extra ==' not in line]
        names |= {re.split(r'[^A-Za-z0-9._-]', line)[0] for line in plain} - found
    return found


def top_level(name: str) -> Iterator[Path]:
    """Yield files and folders of a distribution in site-packages."""
    files = importlib.metadata.files(name) or ()
    tops = {file.parts[0] for file in files} - {'..', '__pycache__'}
    yield from (Path(str(importlib.metadata.distribution(name).locate_file(top))) for top in tops)


@pytest.fixture(scope='module')
def robot(tmp_path_factory) -> Path:
    """Return the Python of a virtual environment with what rosdep installs of Python, by links."""
    folder = tmp_path_factory.mktemp('robot') / 'venv'
    venv.create(folder, symlinks=True)
    (site,) = folder.glob('lib/python*/site-packages')
    keys = [element.text or '' for element in manifest() if element.tag == 'exec_depend']
    modules = [IMPORT_OF_KEY[key] for key in keys if key in IMPORT_OF_KEY]
    of_python = {DISTRIBUTIONS.get(module, module) for module in modules}
    for name in with_requirements(of_python | ROS):
        for path in top_level(name):
            if path.exists() and not (site / path.name).exists():
                (site / path.name).symlink_to(path)
    return folder / 'bin' / 'python'


@pytest.fixture(scope='module')
def drive(tmp_path_factory) -> Path:
    return write_kitti(tmp_path_factory.mktemp('recording') / 'drive', room_drive(6)[0])


def on_robot(python: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, 'PYTHONPATH': str(REPOSITORY)}
    command = [str(python), '-c', START, *words]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=300, env=environment, cwd=folder
    )


def test_it_lacks_what_only_extras_bring(robot, tmp_path) -> None:
    find = f'from importlib.util import find_spec as f; print([n for n in {OF_EXTRAS} if f(n)])'
    done = subprocess.run([robot, '-c', find], capture_output=True, text=True, cwd=tmp_path)
    assert done.stdout.strip() == '[]', done.stderr


WORDS = {
    'info': ('DRIVE',),
    'run': ('DRIVE', '--out', 'result', '--report'),
    'convert': ('DRIVE', 'drive.mcap'),
    'demo': ('--real', '--out', 'real'),
    'record': ('drive.mcap', '--seconds', '1'),
    'calibrate': ('--check', 'DRIVE'),
    'benchmark': ('DRIVE', '--frames', '4'),
}
"""How each command is called that these pages name."""


def test_every_command_that_a_page_names_is_tried() -> None:
    named = {word for page in PAGES for word in NAMED.findall((REPOSITORY / page).read_text())}
    assert named == WORDS.keys()


@pytest.mark.parametrize('command', WORDS)
def test_a_command_works_or_its_extra_is_named(robot, drive, tmp_path, command) -> None:
    words = [str(drive) if word == 'DRIVE' else word for word in WORDS[command]]
    done = on_robot(robot, tmp_path, command, *words)
    assert 'Traceback' not in done.stderr
    if done.returncode == 0:
        return
    *_, line = done.stderr.strip().splitlines()
    assert 'pip install' in line, line
    if 'rosbag2_py of a ROS installation' in line:  # no wheel has it, package.xml does
        assert 'rosbag2_py' in [element.text for element in manifest()]
        return
    for page in PAGES:
        lines = (REPOSITORY / page).read_text().splitlines()
        for number, text in enumerate(lines):
            if command in NAMED.findall(text):
                assert EXTRA.search('\n'.join(lines[number : number + 4])), f'{page}: {text}'


@pytest.mark.skipif(find_spec('rclpy') is None, reason='needs ROS 2')
@pytest.mark.parametrize('node', [*NODES, 'segfloor_pipeline'])
def test_every_node_starts(robot, tmp_path, node) -> None:
    script = f'import sys; from segfloor_ros.apps.programs import {node} as run; run()'
    environment = {**os.environ, 'PYTHONPATH': str(REPOSITORY)}
    for word, status, shown in (('--help', 0, 'parameters of '), ('now', 2, 'unknown argument')):
        done = subprocess.run(
            [robot, '-c', script, word],
            capture_output=True, text=True, timeout=120, env=environment, cwd=tmp_path,
        )  # fmt: skip
        assert (done.returncode, done.stderr.count('Traceback')) == (status, 0), done.stderr
        assert shown in done.stdout + done.stderr
