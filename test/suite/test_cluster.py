"""A suite on worker processes of Dask."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from segfloor_ros.suite.result_files import digest_of

distributed = pytest.importorskip('distributed')

SAME = ('map.pgm', 'map.yaml', 'trajectory.txt', 'labelled_cloud.ply', 'floor_masks')
NAMES = ('one', 'two', 'three')
SUITE = 'recordings:\n' + ''.join(
    # Each differs a little, so that none is taken for another one.
    f'  - {{{{input: {{room}}, name: {name}, set: [stereo_slam.num_features={600 + 50 * i}]}}}}\n'
    for i, name in enumerate(NAMES)
)


def start_check(room: Path, folder: Path, *options: str) -> subprocess.Popen[str]:
    suite = folder / 'suite.yaml'
    suite.write_text(SUITE.format(room=room))
    command = [sys.executable, '-m', 'segfloor_ros.cli.main', 'check', str(suite), '--no-cache',
               '--cache', str(folder / 'cache'), *options]  # fmt: skip
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def mapping(process: psutil.Process) -> bool:
    """Whether a worker has a program that maps."""
    return any('segfloor_ros.cli.main' in ' '.join(c.cmdline()) for c in process.children())


@pytest.fixture(scope='module')
def alone(room, tmp_path_factory) -> Path:
    """The suite's results by one process."""
    folder = tmp_path_factory.mktemp('alone')
    finish(start_check(room, folder, '--out', str(folder)))
    return folder


def finish(check: subprocess.Popen[str]) -> None:
    _, errors = check.communicate(timeout=240)
    assert check.returncode == 0, errors


def assert_same_maps(one: Path, other: Path) -> None:
    for name in NAMES:
        for file in SAME:
            assert digest_of(one / name / file) == digest_of(other / name / file), (name, file)


@pytest.mark.slow
def test_two_processes_make_the_maps_of_one(room, alone, tmp_path):
    finish(start_check(room, tmp_path, '--out', str(tmp_path / 'two'), '--jobs', '2'))
    assert_same_maps(alone, tmp_path / 'two')


@pytest.mark.slow
def test_a_killed_worker_changes_nothing(room, alone, tmp_path):
    # Without nannies nobody starts the killed worker again: the other one must do its recording.
    with distributed.LocalCluster(
        n_workers=0, dashboard_address='127.0.0.1:0', silence_logs='CRITICAL'
    ) as cluster:
        worker = [sys.executable, '-m', 'distributed.cli.dask_worker', cluster.scheduler_address,
                  '--nthreads', '1', '--no-nanny', '--no-dashboard']  # fmt: skip
        workers = [
            psutil.Popen(worker, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            for _ in range(2)
        ]
        try:
            with distributed.Client(cluster) as client:
                client.wait_for_workers(2)
            checked = start_check(
                room, tmp_path, '--out', str(tmp_path / 'two'),
                '--scheduler', cluster.scheduler_address,
            )  # fmt: skip
            while checked.poll() is None and not all(mapping(w) for w in workers):
                time.sleep(0.05)
            assert checked.poll() is None
            workers[0].kill()
            finish(checked)
        finally:
            for process in workers:
                process.kill()
                process.wait()
    assert_same_maps(alone, tmp_path / 'two')


def test_a_scheduler_that_is_not_there_is_one_line(room, tmp_path):
    check = start_check(room, tmp_path, '--out', str(tmp_path / 'out'), '--scheduler', 'nowhere')
    _, errors = check.communicate(timeout=120)
    assert check.returncode == 2
    assert errors.startswith('segfloor: --scheduler nowhere: cannot be reached')
    assert errors.count('\n') == 1
