"""The nodes split over two hosts that a thin, lossy link joins."""

import contextlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import thin_link
from stereo_drive import lockstep_map, room_drive, write_kitti

from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.programs import program_of
from segfloor_ros.core.camera.images import grey_image
from segfloor_ros.core.camera.pixels import JPEG_QUALITY
from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.nodes.messages.camera_infos import compressed_message
from segfloor_ros.nodes.messages.topics import CAMERA, FLOOR, NODES, SLAM

TEST = Path(__file__).resolve().parents[1]
PROFILES = TEST.parent / 'params' / 'fastdds_thin_link.xml'
FRAMES = 30
PATIENCE_S = 120.0
PARAMETERS = {
    'rate': 1.0,
    'lossless': 'true',
    'start_paused': 'true',
    'background': 'false',
    'resume_within_s': 0.0,
}

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(thin_link.why_not()), reason=thin_link.why_not()),
]


@pytest.fixture(scope='module')
def frames() -> list[StereoFrame]:
    return room_drive(FRAMES, step_m=0.04)[0]


@pytest.fixture(scope='module')
def drive(frames, tmp_path_factory) -> Path:
    return write_kitti(tmp_path_factory.mktemp('recording') / 'drive', frames)


def local_map(frames: list[StereoFrame], folder: Path) -> OccupancyGrid:
    """Return the map of one process that sees what the link lets through."""
    return lockstep_map(write_kitti(folder / 'seen', frames))


def as_jpeg(frame: StereoFrame) -> StereoFrame:
    """Return a frame as it comes out of compressed topics."""
    left, right = (
        grey_image(compressed_message(frame.stamp_ns, 'left', image, JPEG_QUALITY), 'left')
        for image in (frame.left, frame.right)
    )
    return replace(frame, left=left, right=right)


@contextlib.contextmanager
def processes():
    """Yields a function that starts processes; all of them end with the block."""
    started: list[subprocess.Popen[str]] = []

    def start(command: list[str], log, **environment: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            command,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, **environment},
            text=True,
        )
        started.append(process)
        return process

    try:
        yield start
    finally:
        for process in started:
            process.kill()
        for process in started:
            process.wait()


@contextlib.contextmanager
def joined_hosts(start):
    """Yields the names of two hosts that are joined."""
    hosts = [f'segfloor{os.getpid()}{end}' for end in 'ab']
    try:
        link = start(
            [sys.executable, str(TEST / 'thin_link.py'), *hosts, str(PATIENCE_S)], subprocess.PIPE
        )
        assert link.stdout is not None
        assert link.stdout.readline() == 'joined\n'
        yield hosts
    finally:
        for host in hosts:
            subprocess.run(['ip', 'netns', 'delete', host], check=False)


@pytest.mark.parametrize(
    ('on_robot', 'parameters'),
    [((CAMERA, SLAM, FLOOR), {}), ((CAMERA,), {'image_transport': 'compressed'})],
    ids=['keyframes-between', 'compressed-images-between'],
)
def test_the_map_of_two_hosts_is_that_of_one(frames, drive, tmp_path, on_robot, parameters) -> None:
    file, logs = tmp_path / 'map.yaml', []
    given = {**PARAMETERS, **parameters, 'input': drive, 'map_file': file}
    options = [word for name, value in given.items() for word in ('-p', f'{name}:={value}')]
    ros = {'ROS_DOMAIN_ID': '7', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET',
           'FASTRTPS_DEFAULT_PROFILES_FILE': str(PROFILES),
           'XDG_RUNTIME_DIR': str(tmp_path)}  # fmt: skip
    with processes() as start, joined_hosts(start) as (robot, base):
        for host in (robot, base):
            (tmp_path / host).mkdir()
        for node in NODES:
            command = [sys.executable, '-m', program_of(node), '--ros-args', *options]
            host = robot if node in on_robot else base
            logs.append(tmp_path / f'{node}.log')
            with logs[-1].open('w') as log:
                start(thin_link.inside(host, tmp_path / host, command), log, **ros)
        watch = [sys.executable, str(TEST / 'host_watch.py')]
        follower = start(thin_link.inside(base, tmp_path / base, watch), subprocess.PIPE, **ros)
        out, _ = follower.communicate(timeout=PATIENCE_S)
        assert follower.returncode == 0, out + ''.join(log.read_text() for log in logs)
    found = load_map(file)
    seen = list(map(as_jpeg, frames)) if parameters else frames
    assert share_of_same_cells(found, local_map(seen, tmp_path)) >= 0.98


def share_of_same_cells(a: OccupancyGrid, b: OccupancyGrid) -> float:
    """Return on how many of the cells that either map knows both say the same."""
    low = np.minimum(corner(a), corner(b))
    high = np.maximum(corner(a) + a.cells.shape[::-1], corner(b) + b.cells.shape[::-1])
    both = np.full((2, *(high - low)[::-1]), -1, np.int8)
    for whole, grid in zip(both, (a, b), strict=True):
        x, y = corner(grid) - low
        rows, columns = grid.cells.shape
        whole[y : y + rows, x : x + columns] = grid.cells
    known = (both >= 0).any(axis=0)
    return float((both[0] == both[1])[known].mean())


def corner(grid: OccupancyGrid) -> np.ndarray:
    """Return the place of the lower left cell, in cells."""
    return np.rint(np.array(grid.origin_xy_m) / grid.resolution_m).astype(int)
