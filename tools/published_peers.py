"""The path alone, ours and that of programs built from their published sources: RTAB-Map,
stella_vslam, ORB-SLAM2 and ORB-SLAM3, each on a rectified recording in the layout of KITTI.

A folder has runners for some of them: `bin/rtabgrid slam DIR`, `bin/stella_kitti VOCABULARY DIR`,
`bin/orb_kitti VOCABULARY DIR` and `bin/orb3_kitti VOCABULARY DIR`, each with `--out PATH.txt`
(TUM), and their vocabularies in `vocab`. `tools/orb3_kitti.py` is the last of them, and says how
ORB-SLAM3 is installed; `tools.vocabulary_text` writes `vocab/orb.txt` and `vocab/orb3.txt`.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from segfloor_ros.apps.cli.terminal import Announce
from segfloor_ros.apps.evaluation.trajectory import match_files, score_trajectory
from segfloor_ros.core.errors import SegfloorError

OURS = 'segfloor_ros'
RUNNERS = {
    'RTAB-Map': ('rtabgrid', 'slam'),
    'stella_vslam': ('stella_kitti', 'vocab/orb.fbow'),
    'stella_vslam, no loops': ('stella_kitti', 'none'),
    'ORB-SLAM2': ('orb_kitti', 'vocab/orb.txt'),
    'ORB-SLAM3': ('orb3_kitti', 'vocab/orb3.txt'),
}
"""Program and first word, by system."""

MEASURE = """
import resource, subprocess, sys
status = subprocess.call(sys.argv[1:], stderr=subprocess.STDOUT)
usage = resource.getrusage(resource.RUSAGE_CHILDREN)
print(f'\\n{usage.ru_utime + usage.ru_stime} {usage.ru_maxrss / 1024}')
sys.exit(min(abs(status), 255))
"""
"""Runs a program from a small process: its peak memory begins with that of the process that starts
it."""


@dataclass(frozen=True)
class SlamRow:
    """A system on a recording. problem: what it said where it failed. path_error_m: RMSE after a
    rigid alignment, without scale, of the frames that have a pose. cpu_s, peak_mb: of the process.
    """

    drive: str
    system: str
    source: str = ''
    problem: str = ''
    tracked_percent: float | None = None
    path_error_m: float | None = None
    cpu_s: float | None = None
    peak_mb: float | None = None


def run_peers(
    drive: str, recording: Path, peers: Path, out: Path, announce: Announce
) -> list[SlamRow]:
    """Return the rows of ours and of all systems that have a runner, on a recording with a true
    path, run one after the other. What each of them printed is kept beside its path.
    """
    out.mkdir(parents=True, exist_ok=True)
    commands: dict[str, list[str | Path]] = {
        OURS: [sys.executable, '-m', 'segfloor_ros.apps.cli.main', 'run', recording, '--no-map']
    }
    for system, (program, first) in RUNNERS.items():
        runner, word = peers / 'bin' / program, peers / first if '/' in first else first
        if runner.is_file():
            commands[system] = [runner, word, recording]
    rows = []
    for number, (system, command) in enumerate(commands.items()):
        announce(f'{system} on {drive}', 0)
        path = out / f'{number}' if system == OURS else out / f'{number}.txt'
        try:
            said, cpu_s, peak_mb = run_program([*command, '--out', path])
            (out / f'{number}.log').write_text(said, encoding='utf-8')
            score = score_trajectory(match_files(path, recording / 'poses.txt'))
        except SegfloorError as error:
            rows.append(SlamRow(drive, system, problem=str(error)))
            continue
        found = (100 * score.tracked, score.ate_rmse_m, cpu_s, peak_mb)
        rows.append(SlamRow(drive, system, '', '', *found))
    return rows


def run_program(words: Sequence[str | Path | float]) -> tuple[str, float, float]:
    """Return what a program said, its CPU time in seconds and its peak memory in MB. Raises
    SegfloorError where it fails.
    """
    command = [sys.executable, '-c', MEASURE, *map(str, words)]
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    said, _, usage = done.stdout.rstrip().rpartition('\n')
    if done.returncode:
        raise SegfloorError(f'{words[0]} {words[1]}: status {done.returncode}: {said[-300:]}')
    cpu_s, peak_mb = map(float, usage.split())
    return said, cpu_s, peak_mb


def slam_cells(rows: Sequence[SlamRow]) -> list[tuple[str, ...]]:
    """Return a head, then a line for each drive: a cell for each system that was run, with the path
    error in mm, the CPU time in seconds, the memory in MB, and what share was tracked, if not all.
    """
    systems = [name for name in (OURS, *RUNNERS) if any(row.system == name for row in rows)]
    lines = [('drive', *systems)]
    for drive in dict.fromkeys(row.drive for row in rows):
        own = {row.system: row for row in rows if row.drive == drive}
        lines.append((drive, *(_cell(own.get(system)) for system in systems)))
    return lines


def _cell(row: SlamRow | None) -> str:
    if row is None:
        return ''
    if row.path_error_m is None or row.tracked_percent is None:
        return 'failed'
    tracked = '' if row.tracked_percent >= 99.95 else f'{row.tracked_percent:.1f} % tracked, '
    return f'{tracked}{1000 * row.path_error_m:.1f}, {row.cpu_s:.0f}, {row.peak_mb:.0f}'


def slam_table(rows: Sequence[SlamRow]) -> str:
    """Return the lines as a table of Markdown, with when and at which commit they were measured."""
    lines = slam_cells(rows)
    lines.insert(1, ('---',) * len(lines[0]))
    table = ''.join('| ' + ' | '.join(line) + ' |\n' for line in lines)
    return f'{table}\nMeasured: {"; ".join(dict.fromkeys(row.source for row in rows))}.\n'
