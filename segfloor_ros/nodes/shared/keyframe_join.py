"""The parts of a keyframe, for the nodes behind SLAM.

What a node behind SLAM knows of the map, as a part of a saved map.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from sensor_msgs.msg import TimeReference
from std_msgs.msg import Header, UInt8MultiArray

from segfloor_ros.map_file import Arrays, MapFile
from segfloor_ros.messages.headers import make_header, to_ns
from segfloor_ros.messages.map_files import (
    is_of_loaded_map,
    map_file_message,
    map_file_of,
    map_start_ns,
)
from segfloor_ros.messages.topics import KEYFRAME_DONE, MAP_LOADED, MAP_PART, MAP_START, MAP_WANTED
from segfloor_ros.nodes.shared.stage_node import AnyStageNode

Process = Callable[[int, dict[str, Any]], Mapping[str, Any]]
"""Gets the stamp and the messages by topic; returns values for the status."""


MAX_WAITING = 100


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
        self._done = node.output(KEYFRAME_DONE)
        self._waiting: deque[tuple[int, dict[str, Any]]] = deque(maxlen=MAX_WAITING)
        self._left_ns: int | None = None
        self.map_start_ns: int | None = None
        """When the map was begun; None where nobody has told."""
        self.is_loaded = False
        """Whether the map goes on from a file."""

        def is_told(topic: str) -> bool:
            return node.inputs.publisher_count(topic) > 0

        told = {topic: partial(is_told, topic) for topic in (MAP_START, *optional)}
        node.inputs.join(parts, self._take, optional=told)

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
            is_well = self._node.work(stamp_ns, partial(self._process, stamp_ns, parts))
            if self._is_last or not is_well:
                self._done.publish(make_header(stamp_ns, ''))

    def _take(self, stamp_ns: int, parts: dict[str, Any]) -> None:
        if MAP_START in parts and not self._follow(parts[MAP_START]):
            self._done.publish(make_header(stamp_ns, ''))
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
        self._output = node.output(MAP_PART)
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
        # Who subscribes anew is told again.
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
        self._output.publish(map_file_message(self._file()))
