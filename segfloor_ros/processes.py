"""Processes that end with the one that has started them."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)


def end_with_parent(parent_id: int) -> None:
    """Have the kernel send SIGTERM to this process when its parent ends, however it ends (prctl(2),
    Linux only). For `preexec_fn`, too.
    """
    if sys.platform != 'linux':
        return
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent_id:
        os.kill(os.getpid(), signal.SIGTERM)
