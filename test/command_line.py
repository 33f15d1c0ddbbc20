"""The command `segfloor` in tests: in a process of its own, or, much faster, in this one."""

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

from segfloor_ros.apps.cli.main import main


def segfloor_process(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own."""
    environment = {**os.environ, 'PYTHONPATH': str(Path(__file__).resolve().parents[1])}
    return subprocess.run(
        [sys.executable, '-m', 'segfloor_ros.apps.cli.main', *map(str, arguments)],
        capture_output=True,
        text=True,
        env=environment,
        timeout=120,
    )


def segfloor(*arguments: object) -> SimpleNamespace:
    """Run the command line in this process; what is logged is not in its stderr."""
    out, err = io.StringIO(), io.StringIO()
    with (
        patch.object(sys, 'argv', ['segfloor', *map(str, arguments)]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            main()
            status = 0
        except SystemExit as ended:
            status = ended.code or 0
    return SimpleNamespace(returncode=status, stdout=out.getvalue(), stderr=err.getvalue())
