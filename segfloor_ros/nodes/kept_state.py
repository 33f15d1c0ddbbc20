"""The map that outlives a crash of the node `stereo_slam`."""

from __future__ import annotations

import contextlib
import json
import os
import stat
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.nodes.messages.saved_maps import LEAST_SHARE

IN_MEMORY = '/dev/shm'


class KeptState:
    """A saved map in a folder of this user's own, one per node name and ROS domain; in memory where
    the system has such a folder (`XDG_RUNTIME_DIR`, `/dev/shm`), so that no disk is worn.

    A node that ends in order removes it, so that only one that was killed finds it again, and
    only within `resume_within_s`, so that the next drive does not begin in the map of the last
    one. With 0 nothing is kept.
    """

    def __init__(self, node_name: str, resume_within_s: float) -> None:
        domain = os.environ.get('ROS_DOMAIN_ID') or '0'
        places = [os.environ.get('XDG_RUNTIME_DIR') or IN_MEMORY, IN_MEMORY, tempfile.gettempdir()]
        parent = next(Path(place) for place in places if os.access(place, os.W_OK))
        folder = parent / f'segfloor_ros-{os.getuid()}'
        self.file = folder / f'{domain}-{node_name.strip("/").replace("/", "-")}.map'
        self._note = self.file.with_suffix('.json')
        self._resume_within_s = resume_within_s
        self._next_save_s = -float('inf')
        self._writing: threading.Thread | None = None

    @property
    def is_due(self) -> bool:
        """Whether a map would be kept now."""
        return (
            self._resume_within_s > 0
            and time.monotonic() >= self._next_save_s
            and not (self._writing is not None and self._writing.is_alive())
        )

    def note(self, values: Mapping[str, Any]) -> None:
        """Keep values of JSON beside the map, now: the last frame before a crash counts."""
        if self._resume_within_s <= 0:
            return
        with contextlib.suppress(OSError):
            self.file.parent.mkdir(mode=0o700, exist_ok=True)
            self._check_private()
            written = self._note.with_suffix('.note')
            written.write_text(json.dumps(values))
            written.replace(self._note)

    def save(self, make: Callable[[], MapFile]) -> None:
        """Keep what `make` returns in place of the last map, where that was not kept only just now;
        it is written beside the work of the node. A full disk is no reason to stop: the older map
        stays.
        """
        if self.is_due:
            start_s = time.thread_time()
            saved = make()
            spent_s = time.thread_time() - start_s
            self._writing = threading.Thread(target=self._write, args=(saved, spent_s))
            self._writing.start()

    def _write(self, saved: MapFile, spent_s: float) -> None:
        with contextlib.suppress(OSError):
            self.file.parent.mkdir(mode=0o700, exist_ok=True)
            self._check_private()
            from segfloor_ros.core.files.results import to_bytes

            written = self.file.with_suffix('.part')
            # At once: each write to the file waits for Python's lock, which tracking holds.
            written.write_bytes(to_bytes(saved, compress=False))
            written.replace(self.file)
        # Not the time it waits for others: on a busy machine a restart needs a recent map, too.
        spent_s += time.thread_time()
        self._next_save_s = time.monotonic() + LEAST_SHARE * spent_s

    def finish(self) -> None:
        """Wait until the map is written."""
        if self._writing is not None:
            self._writing.join()

    def take(self) -> MapFile | None:
        """Return the map that a killed node of this name left a short time ago, or None; what it
        noted last is `note` of the header. It is handed out once: a map that ends its node is not
        tried again.
        """
        try:
            self._check_private()
            files = [file for file in (self.file, self._note) if file.is_file()]
            age_s = time.time() - max((file.lstat().st_mtime for file in files), default=0.0)
            if age_s > self._resume_within_s:
                return None
            from segfloor_ros.core.files.results import read_map_file

            saved = read_map_file(self.file)
            if self._note in files:
                saved.header['note'] = json.loads(self._note.read_text())
            return saved
        except (OSError, ValueError, InputError):
            return None
        finally:
            self.remove()

    def remove(self) -> None:
        """Leave nothing to be taken up; in a folder that is not private, nothing is touched."""
        self.finish()
        with contextlib.suppress(OSError):
            self._check_private()
            for file in (self.file, self._note, self.file.with_suffix('.part')):
                file.unlink(missing_ok=True)

    def _check_private(self) -> None:
        """Raise PermissionError unless the folder is this user's own, no link, and nobody else can
        look into it or change it: then nobody else decides what lies there.
        """
        found = self.file.parent.lstat()
        is_own = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid()
        if not is_own or found.st_mode & 0o077:
            raise PermissionError(f'{self.file.parent} is not private')
