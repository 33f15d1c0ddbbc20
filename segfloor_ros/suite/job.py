"""One recording of a suite: mapped in a process of its own, measured, and packed for the suite's
folder. A job runs where its worker is and needs nothing but the recording.
"""

from __future__ import annotations

import ctypes
import dataclasses
import fcntl
import functools
import hashlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from segfloor_ros import __version__
from segfloor_ros.errors import SegfloorError
from segfloor_ros.evaluation.reference_workload import ReferenceWorkload
from segfloor_ros.simulation.any_scene import open_scene
from segfloor_ros.simulation.drive_files import RecordingOptions
from segfloor_ros.simulation.render_once import render_once
from segfloor_ros.suite.description import REPLAY, RESULTS, SCENE, Entry
from segfloor_ros.suite.measures import measure_run
from segfloor_ros.suite.recordings import digest_of, local_copy
from segfloor_ros.suite.result_files import Cache, pack

LOG = 'log.txt'
STOP_S = 15.0
"""For a program to end that was told to; a replay ends its nodes first."""
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)


class JobError(SegfloorError):
    """A recording could not be mapped or measured."""


@dataclasses.dataclass(frozen=True)
class Job:
    """What a worker needs to know. params: the text of the parameter file. cache: folder for copies
    of recordings, renderings and, where `reuse`, results.
    """

    entry: Entry
    params: str
    cache: str
    reuse: bool

    def digest(self) -> str:
        """Return a hash of all that decides the result but the content of files."""
        return self._digest(timeout_s=0.0)

    def content_digest(self, files: Iterable[Path]) -> str:
        """Return a hash of all that decides the result, wherever the files lie."""
        rest = self._digest(timeout_s=0.0, name='', input='', truth='', reference_map='')
        return _digest_of_text(' '.join([rest, *(digest_of(path) for path in files)]))

    def _digest(self, **without: Any) -> str:
        entry = dataclasses.replace(self.entry, bounds=(), slacks={}, params='', **without)
        return _digest_of_text(repr((package_digest(), entry, self.params)))


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What came of a job. problem: why there is no map, '' where there is one. archive: the results
    folder, packed. worker: host and process. reused: from the cache.
    """

    name: str
    measured: dict[str, float]
    problem: str = ''
    archive: bytes = b''
    seconds: float = 0.0
    worker: str = ''
    reused: bool = False
    package: str = ''


def do_job(job: Job) -> Outcome:
    """Map and measure one recording. What goes wrong with it is in the outcome."""
    start_s = time.monotonic()
    try:
        measured, archive, reused = _map_and_measure(job)
        problem = ''
    except SegfloorError as error:
        measured, archive, reused, problem = {}, b'', False, str(error)
    except Exception as error:
        # Whatever it is, the other recordings go on.
        measured, archive, reused, problem = {}, b'', False, f'{type(error).__name__}: {error}'
    return Outcome(
        job.entry.name,
        measured,
        problem,
        archive,
        time.monotonic() - start_s,
        f'{socket.gethostname()}:{os.getpid()}',
        reused,
        package_digest(),
    )


@functools.cache
def package_digest() -> str:
    """Return the version of this package: of the code as it is, so that changes count."""
    return f'{__version__}-{digest_of(Path(__file__).resolve().parents[1])}'


def _map_and_measure(job: Job) -> tuple[dict[str, float], bytes, bool]:
    entry, folder = job.entry, Path(job.cache)
    recording = _recording(entry, folder)
    truth = _truth(entry, recording, folder)
    reference_map = (
        local_copy(entry.reference_map, folder / 'recordings') if entry.reference_map else None
    )
    if entry.source == RESULTS:
        return measure_run(recording, truth, reference_map), pack(recording), False
    cache = Cache(folder / 'results')
    named = [recording, truth, reference_map, *_files_of(entry.assignments)]
    files = dict.fromkeys(path for path in named if path is not None)
    key = job.content_digest(files) if job.reuse else ''
    if job.reuse and (kept := cache.get(key)) is not None:
        return *kept, True
    with tempfile.TemporaryDirectory(prefix='segfloor-check-') as temporary:
        out = Path(temporary) / 'out'
        reference = ReferenceWorkload()
        reference.time()
        _run(job, recording, Path(temporary), out)
        reference.time()
        measured = measure_run(out, truth, reference_map, reference.median_ms)
        archive = pack(out)
    if job.reuse:
        cache.put(key, measured, archive)
    return measured, archive, False


def _recording(entry: Entry, folder: Path) -> Path:
    if entry.source != SCENE:
        return local_copy(entry.input, folder / 'recordings')
    scene = open_scene(entry.input, entry.scene_assignments)
    recording = folder / 'renderings' / _digest_of_text(repr((__version__, scene)))
    recording.parent.mkdir(parents=True, exist_ok=True)
    with recording.with_suffix('.lock').open('w') as lock:
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


def _run(job: Job, recording: Path, temporary: Path, out: Path) -> None:
    """Map the recording with the command line and write the report. Raises JobError."""
    entry = job.entry
    words = [entry.mode, str(recording), '--out', str(out), '--report']
    words += ['--rate', str(entry.rate)] if entry.mode == REPLAY else []
    if job.params:
        (temporary / 'params.yaml').write_text(job.params)
        words += ['--params', str(temporary / 'params.yaml')]
    words += [word for assignment in entry.assignments for word in ('--set', assignment)]
    log = temporary / LOG
    _call(words, log, entry.timeout_s)
    log.replace(out / LOG)


def _call(words: list[str], log: Path, timeout_s: float) -> None:
    """Run the command `segfloor` and end it where it takes too long. Raises JobError."""
    with log.open('wb') as output:
        process = subprocess.Popen(
            [sys.executable, '-m', 'segfloor_ros.cli.main', *words],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=_end_with_worker if sys.platform == 'linux' else None,
        )
    try:
        status = process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        raise JobError(f'no map within {timeout_s:g} s') from None
    finally:
        _end(process)
    if status:
        lines = log.read_text(errors='replace').strip().splitlines()
        last = lines[-1].removeprefix('segfloor: ') if lines else ''
        cause = f'status {status}' if status > 0 else f'signal {signal.Signals(-status).name}'
        raise JobError(f'{last or "ended without a word"} ({cause})')


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a program and what it has started."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        if process.poll() is not None:
            return
        os.killpg(process.pid, number)
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            continue


def _end_with_worker() -> None:
    """Have the kernel end this program when its worker dies (prctl(2)): its result is lost."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _digest_of_text(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:32]
