"""A suite on worker processes, of this machine and of Dask."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import psutil
import pytest

from segfloor_ros.apps.suite.result_files import digest_of

distributed = pytest.importorskip('distributed')

SAME = ('map.pgm', 'map.yaml', 'trajectory.txt', 'labelled_cloud.ply', 'floor_masks')
NAMES = ('one', 'two', 'three')


def start_check(
    room: Path, folder: Path, *options: str, names: Sequence[str] = NAMES, **environment: str
) -> subprocess.Popen[str]:
    suite = folder / 'suite.yaml'
    # Each differs a little, so that none is taken for another one.
    items = ''.join(
        f'  - {{input: {room}, name: {name}, set: [stereo_slam.num_features={600 + 50 * i}]}}\n'
        for i, name in enumerate(names)
    )
    suite.write_text('recordings:\n' + items)
    command = [sys.executable, '-m', 'segfloor_ros.apps.cli.main', 'check', str(suite),
               '--no-cache', '--cache', str(folder / 'cache'), *options]  # fmt: skip
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | environment,
    )


def mapping(process: psutil.Process) -> bool:
    """Whether a worker has a program that maps."""
    return any('segfloor_ros.apps.cli.main' in ' '.join(c.cmdline()) for c in process.children())


@pytest.fixture(scope='module')
def alone(room, tmp_path_factory) -> Path:
    """The suite's results by one process."""
    folder = tmp_path_factory.mktemp('alone')
    finish(start_check(room, folder, '--out', str(folder / 'out')))
    return folder / 'out'


def finish(check: subprocess.Popen[str]) -> str:
    _, errors = check.communicate(timeout=240)
    assert check.returncode == 0, errors
    return errors


def assert_same_maps(one: Path, other: Path) -> None:
    for name in NAMES:
        for file in SAME:
            assert digest_of(one / name / file) == digest_of(other / name / file), (name, file)


@pytest.mark.slow
def test_two_processes_make_the_maps_of_one(room, alone, tmp_path):
    finish(start_check(room, tmp_path, '--out', str(tmp_path / 'two'), '--jobs', '2'))
    assert_same_maps(alone, tmp_path / 'two')


def mapping_together(check: subprocess.Popen[str], programs: int) -> list[psutil.Process]:
    """Return all processes of a check as soon as so many programs map."""
    process = psutil.Process(check.pid)
    while check.poll() is None:
        found = process.children(recursive=True)
        if sum(' run ' in ' '.join(p.cmdline()) for p in found if p.is_running()) == programs:
            return [process, *found]
        time.sleep(0.1)
    raise AssertionError(check.communicate())


@pytest.mark.slow
def test_nothing_of_a_check_listens(room, tmp_path):
    check = start_check(room, tmp_path, '--out', str(tmp_path / 'out'), '--jobs', '2')
    processes = mapping_together(check, 2)
    try:
        listening = [
            c
            for p in processes
            for c in p.net_connections('all')
            if c.status == psutil.CONN_LISTEN or (c.family.name == 'AF_UNIX' and c.laddr)
        ]
        # The check, its two workers and the two programs, at least.
        assert len(processes) >= 5
        assert listening == []
    finally:
        check.terminate()
        check.communicate(timeout=60)


@pytest.mark.slow
@pytest.mark.parametrize('jobs', ['1', '2'])
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_killed_check_leaves_nothing(room, tmp_path, number, jobs):
    (temporary := tmp_path / 'temporary').mkdir()
    check = start_check(
        room, tmp_path, '--out', str(tmp_path / 'out'), '--jobs', jobs, TMPDIR=str(temporary)
    )
    processes = mapping_together(check, int(jobs))
    assert list(temporary.iterdir())
    check.send_signal(number)
    check.communicate(timeout=60)
    assert check.returncode == (-number if number == signal.SIGKILL else 128 + number)
    _, left = psutil.wait_procs(processes, timeout=30)
    assert left == []
    assert list(temporary.iterdir()) == []


@pytest.mark.slow
def test_a_worker_that_dies_fails_its_recording_alone(room, tmp_path):
    options = '--out', str(tmp_path / 'out'), '--jobs', '2'
    check = start_check(room, tmp_path, *options, names=NAMES[:2])
    processes = mapping_together(check, 2)
    (program, *_) = [p for p in processes if ' run ' in ' '.join(p.cmdline())]
    program.parent().kill()
    _, errors = check.communicate(timeout=240)
    assert check.returncode == 1
    assert errors.count('its worker ended (signal SIGKILL)') == 1
    assert sum((tmp_path / 'out' / name / 'map.pgm').exists() for name in NAMES) == 1
    program.wait(30)


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
            warning = finish(checked)
            # One line of its own, nothing of the address.
            assert warning.startswith('segfloor: --scheduler without tls://')
            assert warning.count('\n') == 1
        finally:
            for process in workers:
                process.kill()
                process.wait()
    assert_same_maps(alone, tmp_path / 'two')


@pytest.mark.slow
def test_a_scheduler_that_is_not_there_is_one_line(room, tmp_path):
    check = start_check(room, tmp_path, '--out', str(tmp_path / 'out'), '--scheduler', 'nowhere')
    _, errors = check.communicate(timeout=120)
    assert check.returncode == 2
    assert errors.startswith('segfloor: --scheduler nowhere: cannot be reached')
    assert errors.count('\n') == 1


@pytest.mark.slow
@pytest.mark.parametrize('address', ['tcp://me:s3cret@localhost:1', 'me:s3cret@localhost:1'])
def test_credentials_of_a_scheduler_are_not_echoed(room, tmp_path, address):
    check = start_check(room, tmp_path, '--out', str(tmp_path / 'out'), '--scheduler', address)
    _, errors = check.communicate(timeout=120)
    assert check.returncode == 2
    assert 'localhost:1: cannot be reached' in errors
    assert 's3cret' not in errors
