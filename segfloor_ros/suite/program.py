"""The command `segfloor` as a program of its own, which may crash or hang."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from pathlib import Path

from segfloor_ros.errors import SegfloorError

STOP_S = 15.0
"""For a program to end that was told to; a replay ends its nodes first."""
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)


class ProgramError(SegfloorError):
    """The program crashed, hung or found no map."""


def run_segfloor(words: list[str], log: Path, timeout_s: float) -> None:
    """Run the command `segfloor` and end it where it takes too long. Raises ProgramError."""
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
        raise ProgramError(f'no map within {timeout_s:g} s') from None
    finally:
        _end(process)
    if status:
        lines = log.read_text(errors='replace').strip().splitlines()
        last = lines[-1].removeprefix('segfloor: ') if lines else ''
        cause = f'status {status}' if status > 0 else f'signal {signal.Signals(-status).name}'
        raise ProgramError(f'{last or "ended without a word"} ({cause})')


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
