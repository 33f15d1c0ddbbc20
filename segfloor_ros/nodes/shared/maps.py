"""The map of a node: its keyframes, joined from their messages; its part of a saved map; and what
is kept of it where it outlives a crash of the node.
"""

from __future__ import annotations

import contextlib
import json
import os
import stat
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sensor_msgs.msg import TimeReference
from std_msgs.msg import Header, UInt8MultiArray

from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.arrays import Arrays, MapFile
from segfloor_ros.core.files.results import read_map_file, write_to
from segfloor_ros.nodes.messages.arrays import (
    is_of_loaded_map,
    map_file_message,
    map_file_of,
    map_start_ns,
)
from segfloor_ros.nodes.messages.diagnostics import Level
from segfloor_ros.nodes.messages.topics import (
    KEYFRAME_DONE,
    KEYFRAMES,
    MAP_LOADED,
    MAP_PART,
    MAP_START,
    MAP_WANTED,
    make_header,
    to_ns,
)

if TYPE_CHECKING:
    from segfloor_ros.nodes.shared.stage_node import AnyStageNode

Process = Callable[[int, dict[str, Any]], Mapping[str, Any]]
"""Gets the stamp and the messages by topic; returns values for the status."""


IN_MEMORY = '/dev/shm'
LEAST_SHARE = 20
"""Times the duration of a save that passes before the next one: keeping costs little time."""


class KeyframeJoin:
    """Joins the parts of a keyframe and has the node process them. Where SLAM tells which map a
    keyframe belongs to, the node is reset before the first one of another map.

    may_process: keyframes are kept while it says no, until `process_waiting`. is_last: the
    keyframe goes no further when the node has processed it. optional: parts that are waited for
    only where somebody publishes them.
    """

    def __init__(
        self,
        node: AnyStageNode,
        parts: Sequence[str],
        process: Process,
        may_process: Callable[[], bool] = lambda: True,
        is_last: bool = False,
        optional: Sequence[str] = (),
    ) -> None:
        self.may_process = may_process
        self._node = node
        self._process = process
        self._is_last = is_last
        self._waiting: deque[tuple[int, dict[str, Any]]] = deque(maxlen=KEYFRAMES.depth)
        self._left_ns: int | None = None
        self.map_start_ns: int | None = None
        """When the map was begun; None where nobody has said."""
        self.is_loaded = False
        """Whether the map goes on from a file."""

        def is_published(topic: str) -> bool:
            return bool(node.inputs.subscriptions[topic].get_publisher_count())

        published = {topic: partial(is_published, topic) for topic in (MAP_START, *optional)}
        node.inputs.join(parts, self._take, optional=published)

    @property
    def waiting_count(self) -> int:
        """How many keyframes are kept."""
        return len(self._waiting)

    def leave_for(self, start_ns: int | None) -> None:
        """Take the keyframes of another map from now on, and none of the one before."""
        if start_ns != self.map_start_ns:
            self._waiting.clear()
            self._left_ns, self.map_start_ns = self.map_start_ns, start_ns

    def process_waiting(self) -> None:
        """Process what is kept, as far as it may be."""
        while self._waiting and self.may_process():
            stamp_ns, parts = self._waiting.popleft()
            is_well = self._work(stamp_ns, parts)
            if self._is_last or not is_well:
                self._node.outputs.publish(KEYFRAME_DONE, make_header(stamp_ns, ''))

    def _work(self, stamp_ns: int, parts: dict[str, Any]) -> bool:
        """Have the node process a keyframe and report how it went; returns whether it went well."""
        start = time.perf_counter()
        try:
            values = self._process(stamp_ns, parts)
        except Exception as error:
            self._node.reporter.report_fault(stamp_ns, error)
            return False
        milliseconds = 1e3 * (time.perf_counter() - start)
        self._node.reporter.report_processed(stamp_ns, Level.OK, 'running', milliseconds, **values)
        return True

    def _take(self, stamp_ns: int, parts: dict[str, Any]) -> None:
        if MAP_START in parts and not self._follow(parts[MAP_START]):
            self._node.outputs.publish(KEYFRAME_DONE, make_header(stamp_ns, ''))
            return
        self._waiting.append((stamp_ns, parts))
        self.process_waiting()

    def _follow(self, message: TimeReference) -> bool:
        """Go to the map of a keyframe; returns False for one that was left already."""
        start_ns, last_ns = map_start_ns(message), self.map_start_ns
        if last_ns is not None and start_ns != last_ns:
            if start_ns == self._left_ns:
                return False
            self._node.reset('stereo_slam has begun a new map')
        self.leave_for(start_ns)
        self.is_loaded = is_of_loaded_map(message)
        return True


class MapPart:
    """Keeps the part of a node for its next life, sends it to SLAM, which saves maps, and takes it
    from the map that SLAM has loaded: the keyframes of such a map wait until it has come.

    name: of the part. arrays: returns it. last_ns: stamp of the latest keyframe in the map, whose
    frame is frame_id.
    """

    def __init__(
        self, node: AnyStageNode, keyframes: KeyframeJoin, name: str, arrays: Callable[[], Arrays]
    ) -> None:
        self.last_ns = 0
        self.frame_id = ''
        self._node = node
        self._keyframes = keyframes
        self._name = name
        self._arrays = arrays
        self._loaded_ns: int | None = None
        self._wanted_ns: int | None = None
        node.inputs.subscribe(MAP_LOADED, self._take_loaded)
        node.inputs.subscribe(MAP_WANTED, self._take_wanted)
        keyframes.may_process = self._is_here

    def reset(self) -> None:
        """Belong to a map of which nothing is known yet."""
        self.last_ns, self.frame_id = 0, ''
        self._wanted_ns = None

    def note(self, stamp_ns: int, frame_id: str) -> None:
        """Note that a keyframe is in the map, and keep the map."""
        self.last_ns, self.frame_id = stamp_ns, frame_id
        self._node.kept_state.save(self._file)
        if self._wanted_ns is not None and stamp_ns >= self._wanted_ns:
            self._send()

    def resume(self, saved: MapFile) -> None:
        """Belong to a map: that of a killed node, or one that SLAM has loaded."""
        header = saved.header
        self._keyframes.leave_for(header['start_ns'])
        self._loaded_ns = header['loaded_ns']
        self.last_ns, self.frame_id = header['last_ns'], header['frame_id']

    def _is_here(self) -> bool:
        keyframes = self._keyframes
        return not keyframes.is_loaded or self._loaded_ns == keyframes.map_start_ns

    def _file(self) -> MapFile:
        header = {
            'start_ns': self._keyframes.map_start_ns,
            'loaded_ns': self._loaded_ns,
            'last_ns': self.last_ns,
            'frame_id': self.frame_id,
        }
        return MapFile(header, {self._name: self._arrays()})

    def _take_loaded(self, message: UInt8MultiArray) -> None:
        saved = map_file_of(message, MAP_LOADED)
        # Who subscribes anew gets it again.
        if saved.header['start_ns'] != self._loaded_ns:
            self._node.reset('stereo_slam has loaded a map')
            self._node.restore(saved)
            self._keyframes.process_waiting()

    def _take_wanted(self, message: Header) -> None:
        self._wanted_ns = to_ns(message.stamp)
        if self.last_ns >= self._wanted_ns:
            self._send()

    def _send(self) -> None:
        self._wanted_ns = None
        self._node.outputs.publish(MAP_PART, map_file_message(self._file()))


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
        self._waiting: Callable[[], MapFile] | None = None

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
        """Keep what `make` returns in place of the last map, later where that was kept only just
        now (`catch_up`); it is written beside the work of the node. A full disk is no reason to
        stop: the older map stays.
        """
        self._waiting = make
        self.catch_up()

    def catch_up(self) -> None:
        """Keep what is still to be kept, once it is time."""
        make = self._waiting
        if make is not None and self.is_due:
            self._waiting, start_s = None, time.monotonic()
            self._writing = threading.Thread(target=self._write, args=(make(), start_s))
            self._writing.start()

    def _write(self, saved: MapFile, start_s: float) -> None:
        with contextlib.suppress(OSError):
            self.file.parent.mkdir(mode=0o700, exist_ok=True)
            self._check_private()
            written = self.file.with_suffix('.part')
            with written.open('wb') as file:
                write_to(file, saved, compress=False)
            written.replace(self.file)
        now_s = time.monotonic()
        self._next_save_s = now_s + LEAST_SHARE * (now_s - start_s)

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
        self._waiting = None
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
