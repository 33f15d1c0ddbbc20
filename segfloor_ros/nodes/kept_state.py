"""What a node knows, kept where it outlives a crash of the node: taken up again after a restart."""

from __future__ import annotations

import contextlib
import os
import pickle
import tempfile
import time
from pathlib import Path
from typing import Any

from segfloor_ros import __version__

IN_MEMORY = Path('/dev/shm')
LEAST_SHARE = 20
"""Times the duration of a save that passes before the next one: keeping costs little time."""


class KeptState:
    """A file in a folder of this user's own, one per node name and ROS domain; in memory where the
    system has such a folder, so that no disk is worn.

    A node that ends in order removes it, so that only one that was killed finds it again, and
    only within `resume_within_s`, so that the next drive does not begin in the map of the last
    one. With 0 nothing is kept.
    """

    def __init__(self, node_name: str, resume_within_s: float) -> None:
        domain = os.environ.get('ROS_DOMAIN_ID') or '0'
        parent = IN_MEMORY if IN_MEMORY.is_dir() else Path(tempfile.gettempdir())
        folder = parent / f'segfloor_ros-{os.getuid()}'
        self._file = folder / f'{domain}-{node_name.strip("/").replace("/", "-")}.state'
        self._resume_within_s = resume_within_s
        self._next_save_s = -float('inf')

    def save(self, state: Any, always: bool = False) -> None:
        """Keep a state in place of the last one, unless the last one was kept only just now. A
        full disk is no reason to stop: the older state stays.
        """
        start_s = time.monotonic()
        if self._resume_within_s == 0 or (start_s < self._next_save_s and not always):
            return
        with contextlib.suppress(OSError):
            self._file.parent.mkdir(mode=0o700, exist_ok=True)
            if not _is_private(self._file.parent):
                return
            written = self._file.with_suffix('.new')
            written.write_bytes(pickle.dumps((__version__, state), pickle.HIGHEST_PROTOCOL))
            written.replace(self._file)
        now_s = time.monotonic()
        self._next_save_s = now_s + LEAST_SHARE * (now_s - start_s)

    def take(self) -> Any:
        """Return the state that a killed node of this name left a short time ago, or None. It is
        handed out once: a state that ends its node is not tried again.
        """
        try:
            age_s = time.time() - self._file.stat().st_mtime
            # Reading it can run code: it must lie in a folder that nobody else writes to.
            if not _is_private(self._file.parent) or age_s > self._resume_within_s:
                return None
            version, state = pickle.loads(self._file.read_bytes())
        except (OSError, pickle.UnpicklingError, EOFError, AttributeError, ImportError):
            return None
        finally:
            self.remove()
        return state if version == __version__ else None

    def remove(self) -> None:
        """Leave nothing to be taken up."""
        with contextlib.suppress(OSError):
            self._file.unlink()


def _is_private(folder: Path) -> bool:
    """Whether the folder is this user's own and nobody else can write to it."""
    found = folder.lstat()
    return found.st_uid == os.getuid() and not found.st_mode & 0o022
