"""Damaged inputs of every kind through the real commands: what falls?

    python -m tools.fuzz --cases 3000 --seed 4              a table, and each case that failed
    python -m tools.fuzz --only 'mcap,bits,17' --keep DIR   one case again, kept for a look

A case is a kind of input, a damage and a number. It fails where the command crashes, shows a
traceback, hangs, takes all memory, lets a library write to standard error, or ends without one line
that names the damaged file, or the input that it is part of. Each runs in a process of its own,
forked from one that has imported everything.
"""

from __future__ import annotations

import contextlib
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NoReturn

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from segfloor_ros.apps.cli.main import main as segfloor
from segfloor_ros.core.standard_error import own_standard_error
from tools.fuzz_damages import DAMAGES
from tools.fuzz_inputs import KINDS, files_of, words_of

CPU_S, WALL_S = 20, 60
MEMORY = 1 << 30
"""More than the process had to begin with."""

OK, REFUSED, NO_MAP = 'ok', 'refused', 'no map'
TRACEBACK, HANG, MEMORY_OUT, CRASH = 'traceback', 'hang', 'memory', 'crash'
FOREIGN, UNNAMED = 'foreign lines', 'unnamed'
GOOD = (OK, REFUSED, NO_MAP)
OUTCOMES = (*GOOD, TRACEBACK, HANG, MEMORY_OUT, CRASH, FOREIGN, UNNAMED)
EARLY = (
    'segfloor_ros.apps.evaluation.report', 'segfloor_ros.apps.evaluation.trajectory',
    'segfloor_ros.apps.suite.result_files', 'segfloor_ros.apps.simulation.simulation',
    'segfloor_ros.apps.simulation.simulation', 'segfloor_ros.apps.simulation.scene_file',
    'rosbags.rosbag1', 'rosbags.rosbag2', 'rosbags.typesys', 'scipy.spatial.transform',
)  # fmt: skip
"""What commands import late."""


@dataclass(frozen=True)
class Case:
    """A kind of input, a damage and what the random choices begin with."""

    kind: str
    damage: str
    number: int

    def __str__(self) -> str:
        return f'{self.kind},{self.damage},{self.number}'


@dataclass(frozen=True)
class Ended:
    """How a command ended: what it was, status (negative: a signal), standard error, seconds of the
    processor, MB more than at the beginning; the file that was damaged.
    """

    case: Case
    outcome: str
    status: int
    errors: str
    cpu_s: float
    memory_mb: float
    file: str


def chosen_cases(count: int, seed: int, kinds: Sequence[str], damages: Sequence[str]) -> list[Case]:
    """Return cases: every kind with every damage in turn, in random order."""
    rng = np.random.default_rng(seed)
    pairs = [(kind, damage) for kind in kinds for damage in damages]
    cases: list[Case] = []
    while len(cases) < count:
        order = rng.permutation(len(pairs))
        cases += [Case(*pairs[int(at)], int(rng.integers(1 << 30))) for at in order]
    return cases[:count]


def run_cases(cases: Sequence[Case], jobs: int, keep: Path | None = None) -> Iterator[Ended]:
    """Yield how cases ended, as they do; `jobs` at a time."""
    for module in EARLY:
        with contextlib.suppress(ImportError):
            __import__(module)
    with tempfile.TemporaryDirectory('', 'segfloor-fuzz-', ignore_cleanup_errors=True) as temporary:
        inputs = Path(temporary) / 'inputs'
        _make_inputs(inputs, {case.kind for case in cases})
        running: dict[int, _Running] = {}
        waiting = list(enumerate(cases))[::-1]
        while waiting or running:
            while waiting and len(running) < jobs:
                number, case = waiting.pop()
                folder = (keep or Path(temporary)) / f'case{number}'
                begun = _Running(case, inputs, folder)
                running[begun.process] = begun
            for process, begun in list(running.items()):
                ended = begun.ended()
                if ended is not None:
                    del running[process]
                    if keep is None:
                        shutil.rmtree(begun.folder, ignore_errors=True)
                    yield ended
            time.sleep(0.005)


def _make_inputs(folder: Path, kinds: set[str]) -> None:
    """Make the inputs in a process of its own: a fork does without the threads of OpenCV."""
    process = os.fork()
    if process == 0:
        try:
            for make in {KINDS[kind].make for kind in kinds}:
                (folder / make.__name__).mkdir(parents=True)
                with contextlib.redirect_stdout(None):
                    make(folder / make.__name__)
            os._exit(0)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
    if os.waitpid(process, 0)[1]:
        raise RuntimeError('the inputs cannot be made')


class _Running:
    """A case whose command runs."""

    def __init__(self, case: Case, inputs: Path, folder: Path) -> None:
        self.case, self.folder = case, folder
        kind = KINDS[case.kind]
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(inputs / kind.make.__name__, folder / 'case', symlinks=True)
        begun = zlib.crc32(f'{case.kind} {case.damage}'.encode()), case.number
        rng = np.random.default_rng(begun)
        files = files_of(kind, folder / 'case')
        self.file = files[int(rng.integers(len(files)))]
        DAMAGES[case.damage](rng, self.file)
        words = (
            words_of(kind, folder / 'case')
            if self.file.name != 'word' or readable(self.file)
            else [w for w in kind.command if w not in ('--set', '{word}')]
        )
        words = [w.replace('{}', str(folder / 'case')) for w in words]
        self._errors = folder / 'stderr.txt'
        self._start_s = time.monotonic()
        sys.stdout.flush()
        self.process = os.fork()
        if self.process == 0:
            _command(words, folder)

    def ended(self) -> Ended | None:
        """Return how the command ended, None while it runs; one that takes too long is killed."""
        process, status, usage = os.wait4(self.process, os.WNOHANG)
        late = time.monotonic() - self._start_s > WALL_S
        if process == 0 and late:
            os.killpg(self.process, signal.SIGKILL)
            process, status, usage = os.wait4(self.process, 0)
        if process == 0:
            return None
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process, signal.SIGKILL)
        code = os.waitstatus_to_exitcode(status)
        errors = self._errors.read_text(errors='replace')
        cpu_s = usage.ru_utime + usage.ru_stime
        memory_mb = usage.ru_maxrss / 1e3 - _resident_mb()
        outcome = self._outcome(code, errors, late or cpu_s > CPU_S, memory_mb)
        name = str(self.file.relative_to(self.folder / 'case'))
        return Ended(self.case, outcome, code, errors, cpu_s, memory_mb, name)

    def _outcome(self, code: int, errors: str, slow: bool, memory_mb: float) -> str:
        lines = [line for line in errors.splitlines() if line.strip()]
        if slow or code == -signal.SIGXCPU:
            return HANG
        if re.search('(?m)^MemoryError|bad_alloc', errors) or memory_mb > MEMORY / 1e6:
            return MEMORY_OUT
        if code < 0:
            return CRASH
        if 'Traceback' in errors or code not in (0, 1, 2):
            return TRACEBACK
        if not all(line.startswith('segfloor: ') for line in lines):
            return FOREIGN
        is_verdict = code == 1 and KINDS[self.case.kind].command[0] == 'check'
        if code and not is_verdict and not any(map(self._names_input, lines)):
            return UNNAMED
        return (OK, NO_MAP, REFUSED)[code]

    def _names_input(self, line: str) -> bool:
        parts = self.file.relative_to(self.folder / 'case').parts
        return any(part in line for part in (*parts, *(['--set'] if parts == ('word',) else [])))


def readable(path: Path) -> bool:
    """Whether a path is a file whose end comes."""
    return path.is_file() and os.access(path, os.R_OK) and path.stat().st_size < 1 << 20


def _resident_mb() -> float:
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def _command(words: Sequence[str], folder: Path) -> NoReturn:
    """Be the command `segfloor` with these words."""
    status = 99
    try:
        os.setsid()
        os.chdir(folder)
        for descriptor, name in ((1, 'stdout.txt'), (2, 'stderr.txt')):
            file = os.open(name, os.O_WRONLY | os.O_CREAT)
            os.dup2(file, descriptor)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        sys.stdout = os.fdopen(1, 'w', closefd=False)
        sys.stderr = os.fdopen(2, 'w', buffering=1, closefd=False)
        size = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + 3 * MEMORY, size + 3 * MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S + 1))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        sys.argv = ['segfloor', *words]
        own_standard_error()
        try:
            segfloor()
            status = 0
        except SystemExit as ended:
            status = ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 1
        threading._shutdown()  # type: ignore[attr-defined]
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


def table_of(ended: Sequence[Ended]) -> Table:
    """Return the number of cases by kind and outcome."""
    table = Table('kind', *OUTCOMES, 'cases', 'longest s')
    for kind in [*dict.fromkeys(e.case.kind for e in ended), '']:
        own = [e for e in ended if kind in ('', e.case.kind)]
        counts = Counter(e.outcome for e in own)
        numbers = [str(counts[name] or '') for name in OUTCOMES]
        longest = max(e.cpu_s for e in own)
        table.add_row(kind or 'all', *numbers, str(len(own)), f'{longest:.1f}')
    return table


def fuzz(
    cases: Annotated[int, typer.Option(min=1, help='How many.')] = 300,
    seed: Annotated[int, typer.Option(min=0, help='Of the choice of cases.')] = 1,
    kinds: Annotated[str, typer.Option(help='Only these, with commas.')] = '',
    damages: Annotated[str, typer.Option(help='Only these, with commas.')] = '',
    only: Annotated[str, typer.Option(help='One case: kind,damage,number.')] = '',
    jobs: Annotated[int, typer.Option(min=1, help='Commands at a time.')] = 2,
    keep: Annotated[Path | None, typer.Option(help='Folder for the damaged inputs.')] = None,
) -> None:
    """Run damaged inputs through the commands. Status 1: a case failed."""
    chosen = chosen_cases(
        cases,
        seed,
        kinds.split(',') if kinds else [*KINDS],
        damages.split(',') if damages else [*DAMAGES],
    )
    if only:
        kind, damage, number = only.split(',')
        chosen = [Case(kind, damage, int(number))]
    ended = []
    for case in run_cases(chosen, jobs, keep.absolute() if keep else None):
        ended.append(case)
        if case.outcome not in GOOD or only:
            print(f'{case.outcome}: python -m tools.fuzz --only {str(case.case)!r}   {case.file}, '
                  f'status {case.status}, {case.cpu_s:.1f} s, {case.memory_mb:.0f} MB')  # fmt: skip
            print(*(f'    {line[:300]}' for line in case.errors.splitlines()[-6:]), sep='\n')
            sys.stdout.flush()
    console = Console(width=150, markup=False)
    console.print(table_of(ended))
    if any(case.outcome not in GOOD for case in ended):
        raise typer.Exit(1)


if __name__ == '__main__':
    typer.run(fuzz)
