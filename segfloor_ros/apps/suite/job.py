"""One recording of a suite: mapped in a process of its own, measured, and packed for the suite's
folder; and who does such jobs: processes of this machine, or the workers of a Dask cluster. A job
runs where its worker is and needs nothing but the recording.

A process of this machine does one job and hands back its outcome through a pipe: nothing listens
that another user could reach. It ends with the process that started it, and leaves no file.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import functools
import hashlib
import logging
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Iterable, Mapping
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

from segfloor_ros import __version__
from segfloor_ros.apps.profiling import ReferenceWorkload
from segfloor_ros.apps.suite.description import REPLAY, RESULTS, SCENE, Entry
from segfloor_ros.apps.suite.measures import Outcome, measure_run, start_pose_of
from segfloor_ros.apps.suite.result_files import Cache, digest_of, local_copy, pack, unpack
from segfloor_ros.core.errors import SegfloorError, SettingsError, without_credentials
from segfloor_ros.core.files.writing import scratch_folder
from segfloor_ros.core.processes import (
    end_with_parent,
    how_it_ended,
    interrupts_deferred,
    start_apart,
)
from segfloor_ros.core.standard_error import own_standard_error

LOG = 'log.txt'

SAVED_MAP = 'saved.map'
"""In the results folder of a recording that another one continues."""

CONNECT_S = 10

log = logging.getLogger(__name__)


class ProgramError(SegfloorError):
    """The program crashed, hung or found no map."""


def run_segfloor(words: list[str], log: Path, timeout_s: float) -> None:
    """Run the command `segfloor` and end it where it takes too long. Raises ProgramError."""
    process = None
    try:
        with log.open('wb') as output, interrupts_deferred():
            process = subprocess.Popen(
                [sys.executable, '-m', 'segfloor_ros.apps.cli.main', *words],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=functools.partial(end_with_parent, os.getpid()),
            )
        status = process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        raise ProgramError(f'no map within {timeout_s:g} s') from None
    finally:
        if process is not None:
            _end(process)
    if status:
        lines = log.read_text(errors='replace').strip().splitlines()
        last = lines[-1].removeprefix('segfloor: ') if lines else ''
        raise ProgramError(f'{last or "ended without a word"} ({how_it_ended(status)})')


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a program; the nodes of a replay end with it, and nobody wants what it would write."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


class JobError(SegfloorError):
    """A recording cannot be mapped."""


@dataclasses.dataclass(frozen=True)
class Job:
    """What a worker needs to know. params: the text of the parameter file. cache: folder for copies
    of recordings, renderings and, where `reuse`, results. is_continued: another recording continues
    its map. origin: digest of the job whose map it continues.
    """

    entry: Entry
    params: str
    cache: str
    reuse: bool
    is_continued: bool = False
    origin: str = ''

    def digest(self) -> str:
        """Return a hash of all that decides the result but the content of files."""
        return self._digest(timeout_s=0.0)

    def content_digest(self, files: Iterable[Path]) -> str:
        """Return a hash of all that decides the result, wherever the files lie."""
        rest = self._digest(timeout_s=0.0, name='', input='', truth='', reference_map='')
        return _digest_of_text(' '.join([rest, *(digest_of(path) for path in files)]))

    def _digest(self, **without: Any) -> str:
        without |= {'bounds': (), 'slacks': {}, 'published': {}, 'params': ''}
        entry = dataclasses.replace(self.entry, **without)
        kind = (self.is_continued, self.origin)
        return _digest_of_text(repr((package_digest(), entry, self.params, kind)))


def do_job(job: Job, origin: Outcome | None = None) -> Outcome:
    """Map and measure one recording. What goes wrong with it is in the outcome. origin: of the
    recording whose map is continued.
    """
    start_s = time.monotonic()
    try:
        outcome = _map_and_measure(job, origin)
    except SegfloorError as error:
        outcome = Outcome(job.entry.name, {}, str(error))
    except Exception as error:
        # Whatever it is, the other recordings go on.
        problem = without_credentials(f'{type(error).__name__}: {error}')
        outcome = Outcome(job.entry.name, {}, problem)
    return dataclasses.replace(
        outcome,
        seconds=time.monotonic() - start_s,
        worker=f'{socket.gethostname()}:{os.getpid()}',
        package=package_digest(),
    )


@functools.cache
def package_digest() -> str:
    """Return the version of this package: of the code as it is, so that changes count."""
    return f'{__version__}-{digest_of(Path(__file__).resolve().parents[2])}'


def _map_and_measure(job: Job, origin: Outcome | None) -> Outcome:
    entry, folder = job.entry, Path(job.cache)
    recording = _recording(entry, folder)
    truth = _truth(entry, recording, folder)
    start_pose = origin.start_pose if origin is not None else start_pose_of(truth)
    reference_map = (
        local_copy(entry.reference_map, folder / 'recordings') if entry.reference_map else None
    )
    if entry.source == RESULTS:
        measured = measure_run(recording, truth, reference_map, start_pose)
        return Outcome(entry.name, measured, archive=pack(recording))
    with scratch_folder(Path(tempfile.gettempdir()), 'segfloor-check-') as temporary:
        loaded = _map_to_load(origin, temporary)
        named = [recording, truth, reference_map, loaded, *_files_of(entry.assignments)]
        files = dict.fromkeys(path for path in named if path is not None)
        cache, key = Cache(folder / 'results'), job.content_digest(files) if job.reuse else ''
        if job.reuse and (kept := cache.get(key)) is not None:
            return Outcome(entry.name, kept[0], '', kept[1], start_pose, reused=True)
        reference = ReferenceWorkload()
        reference.time()
        out = _run(job, recording, loaded, temporary)
        reference.time()
        measured = measure_run(out, truth, reference_map, start_pose, reference.median_ms)
        archive = pack(out)
    if job.reuse:
        cache.put(key, measured, archive)
    return Outcome(entry.name, measured, '', archive, start_pose)


def _map_to_load(origin: Outcome | None, folder: Path) -> Path | None:
    """Return the map that is continued, as a file. Raises JobError where there is none."""
    if origin is None:
        return None
    if origin.problem:
        raise JobError(f'there is no map of {origin.name} to continue')
    unpack(origin.archive, folder / 'origin')
    return folder / 'origin' / SAVED_MAP


def _recording(entry: Entry, folder: Path) -> Path:
    if entry.source != SCENE:
        return local_copy(entry.input, folder / 'recordings')
    # Imported here: the simulator takes time that other commands should not wait for.
    from segfloor_ros.apps.simulation.scene_file import open_scene
    from segfloor_ros.apps.simulation.simulation import RecordingOptions, render_once

    scene = open_scene(entry.input, entry.scene_assignments)
    recording = folder / 'renderings' / _digest_of_text(repr((__version__, scene)))
    recording.parent.mkdir(parents=True, exist_ok=True)
    with recording.with_suffix('.lock').open('a') as lock:
        # Another worker may want the same drive.
        fcntl.flock(lock, fcntl.LOCK_EX)
        render_once(scene, recording, RecordingOptions())
    return recording


def _truth(entry: Entry, recording: Path, folder: Path) -> Path | None:
    """Return the truth that is named, else the recording's own."""
    if entry.truth:
        return local_copy(entry.truth, folder / 'recordings')
    if entry.source == RESULTS:
        return None
    names = ('map.yaml', 'poses.txt', 'floor')
    return recording if any((recording / name).exists() for name in names) else None


def _files_of(assignments: Iterable[str]) -> list[Path]:
    """Return the files and folders that parameters name, e.g. masks."""
    values = (assignment.partition('=')[2] for assignment in assignments)
    return [Path(value) for value in values if '/' in value and Path(value).exists()]


def _run(job: Job, recording: Path, loaded: Path | None, temporary: Path) -> Path:
    """Map the recording with the command line, and return the results folder."""
    entry, out, log, saved = job.entry, *(temporary / n for n in ('out', LOG, SAVED_MAP))
    words = [entry.mode, str(recording), '--out', str(out), '--report']
    words += ['--rate', str(entry.rate)] if entry.mode == REPLAY else []
    words += ['--no-map'] if entry.no_map else []
    words += ['--load-map', str(loaded)] if loaded is not None else []
    words += ['--save-map', str(saved)] if job.is_continued else []
    if job.params:
        (temporary / 'params.yaml').write_text(job.params)
        words += ['--params', str(temporary / 'params.yaml')]
    words += [word for assignment in entry.assignments for word in ('--set', assignment)]
    run_segfloor(words, log, entry.timeout_s)
    log.replace(out / LOG)
    if job.is_continued:
        saved.replace(out / SAVED_MAP)
    return out


def _digest_of_text(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:32]


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
                    origin = done.get(job.entry.continue_from)
                    with interrupts_deferred():
                        pipe, process = start_apart(_work, job, origin, Path(folder), os.getpid())
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


def _receive(pipe: Connection, job: Job, process: SpawnProcess) -> Outcome:
    try:
        outcome: Outcome = pipe.recv()
    except EOFError:
        process.join()
        cause = how_it_ended(process.exitcode or 0)
        outcome = Outcome(job.entry.name, {}, f'its worker ended ({cause})')
    pipe.close()
    process.join()
    return outcome


def _work(pipe: Connection, job: Job, origin: Outcome | None, folder: Path, check: int) -> None:
    """Do one job. Told to end, or left alone, end what was started and remove its files."""
    # An interrupt from the terminal ends the check, which then ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _ended)
    end_with_parent(check)
    own_standard_error()
    try:
        with tempfile.TemporaryDirectory(dir=folder) as own:
            tempfile.tempdir = own
            pipe.send(do_job(job, origin))
    finally:
        if os.getppid() != check:
            # The last one of the workers of a killed check succeeds.
            with contextlib.suppress(OSError):
                folder.rmdir()


def _ended(number: int, frame: object) -> None:
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
