"""What a worker of a check starts ends with it."""

import signal
import subprocess
import sys

import pytest

from segfloor_ros.apps.suite import job


def test_a_signal_that_falls_into_the_start_of_a_program_ends_both(tmp_path, monkeypatch) -> None:
    """Python ignores what a handler raises within a fork, so that the signal was lost."""
    started = []
    popen = subprocess.Popen

    def start(*words, **options):
        signal.raise_signal(signal.SIGTERM)
        started.append(popen(*words, **options))
        return started[0]

    monkeypatch.setattr(subprocess, 'Popen', start)
    before = signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        with pytest.raises(SystemExit) as ended:
            job.run_segfloor(['demo', '--out', str(tmp_path / 'out')], tmp_path / 'log', 60.0)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert ended.value.code == 128 + signal.SIGTERM
    assert started[0].poll() is not None
