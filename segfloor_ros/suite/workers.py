"""Who does the jobs of a suite: processes of this machine, or the workers of a Dask cluster.

A process of this machine does one job and hands back its outcome through a pipe: nothing listens
that another user could reach. It ends with the process that started it, and leaves no file.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import sys
import tempfile
from collections.abc import Generator, Mapping
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

from segfloor_ros.errors import SettingsError
from segfloor_ros.processes import end_with_parent
from segfloor_ros.suite.job import Job, Outcome, do_job

CONNECT_S = 10

log = logging.getLogger(__name__)


def outcomes(
    jobs: list[Job], kept: Mapping[str, Outcome], processes: int = 1, scheduler: str = ''
) -> Generator[Outcome]:
    """Yield what comes of the jobs, as they finish. A job that continues a map comes after the one
    that makes it. kept: outcomes by name of jobs that were done before. scheduler: address of a
    Dask scheduler, whose workers do the jobs; else so many processes of this machine. Raises
    SettingsError.
    """
    if scheduler:
        return _distributed(scheduler, jobs, kept)
    return _local(processes, jobs, kept)


def _local(processes: int, jobs: list[Job], kept: Mapping[str, Outcome]) -> Generator[Outcome]:
    done, waiting = dict(kept), list(jobs)
    running: dict[Connection, tuple[Job, SpawnProcess]] = {}
    with tempfile.TemporaryDirectory(prefix='segfloor-check-') as folder:
        try:
            while waiting or running:
                todo = {job.entry.name for job in [*waiting, *(j for j, _ in running.values())]}
                ready = [job for job in waiting if job.entry.continue_from not in todo]
                for job in ready[: processes - len(running)]:
                    waiting.remove(job)
                    pipe, process = _start(job, done.get(job.entry.continue_from), Path(folder))
                    running[pipe] = job, process
                finished = wait(list(running))
                for pipe in [pipe for pipe in running if pipe in finished]:
                    outcome = _receive(pipe, *running.pop(pipe))
                    done[outcome.name] = outcome
                    yield outcome
        finally:
            for _, process in running.values():
                process.terminate()
            for _, process in running.values():
                process.join()


def _start(job: Job, origin: Outcome | None, folder: Path) -> tuple[Connection, SpawnProcess]:
    # Spawned: a fork would copy the locks of the threads of OpenCV and BLAS.
    context = multiprocessing.get_context('spawn')
    pipe, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(theirs, job, origin, folder, os.getpid()))
    process.start()
    theirs.close()
    return pipe, process


def _receive(pipe: Connection, job: Job, process: SpawnProcess) -> Outcome:
    try:
        outcome: Outcome = pipe.recv()
    except EOFError:
        process.join()
        status = process.exitcode or 0
        cause = f'signal {signal.Signals(-status).name}' if status < 0 else f'status {status}'
        outcome = Outcome(job.entry.name, {}, f'its worker ended ({cause})')
    pipe.close()
    process.join()
    return outcome


def _work(pipe: Connection, job: Job, origin: Outcome | None, folder: Path, check: int) -> None:
    """Do one job. Told to end, or left alone, end what was started and remove its files."""
    # An interrupt from the terminal ends the check, which then ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _end)
    end_with_parent(check)
    try:
        with tempfile.TemporaryDirectory(dir=folder) as own:
            tempfile.tempdir = own
            pipe.send(do_job(job, origin))
    finally:
        if os.getppid() != check:
            # The last one of the workers of a killed check succeeds.
            with contextlib.suppress(OSError):
                folder.rmdir()


def _end(number: int, frame: object) -> None:
    signal.signal(number, signal.SIG_IGN)
    sys.exit(128 + number)


def _distributed(
    scheduler: str, jobs: list[Job], kept: Mapping[str, Outcome]
) -> Generator[Outcome]:
    """A worker that dies has its job done again by another one (Dask sees to that, a few times)."""
    with _client(scheduler) as client:
        from distributed import as_completed

        futures: dict[str, Any] = {}
        for job in jobs:
            origin = job.entry.continue_from
            futures[job.entry.name] = client.submit(
                do_job, job, futures.get(origin, kept.get(origin)), pure=False
            )
        names = {future.key: name for name, future in futures.items()}
        finished = as_completed(list(futures.values()))
        futures.clear()
        for future in finished:
            if future.status == 'finished':
                outcome = future.result()
            else:
                outcome = Outcome(names[future.key], {}, problem=f'{future.exception()}')
            # The cluster need not keep what is here now, unless a job that waits needs it.
            future.release()
            yield outcome


def _client(scheduler: str) -> Any:
    """Return a connection to a Dask scheduler. Raises SettingsError."""
    # Read when Dask is imported, here and in the workers: what matters is in the outcomes.
    os.environ.setdefault('DASK_LOGGING__DISTRIBUTED', 'critical')
    try:
        import distributed
    except ImportError:
        raise SettingsError("--scheduler needs Dask: pip install 'segfloor_ros[cluster]'") from None
    try:
        client = distributed.Client(scheduler, timeout=CONNECT_S)
    except (OSError, ValueError, TypeError) as error:
        raise SettingsError(f'--scheduler {scheduler}: cannot be reached ({error})') from None
    if not scheduler.startswith('tls://'):
        log.warning(
            '--scheduler without tls://: who reaches it can run programs as its user (docs/ci.md)'
        )
    return client
