"""How much memory a process has."""

from __future__ import annotations

import resource
import sys
from pathlib import Path

_PROC = Path('/proc')


def rss_mb(process_id: int | None = None) -> float:
    """Return the resident memory of this process, or of another one, in MB (10^6 bytes).

    Where there is no /proc, it is the peak of this process so far, and 0 for others.
    """
    statm = _PROC / str(process_id or 'self') / 'statm'
    if statm.exists():
        return int(statm.read_text().split()[1]) * resource.getpagesize() / 1e6
    if process_id is not None:
        return 0.0
    unit = 1 if sys.platform == 'darwin' else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
