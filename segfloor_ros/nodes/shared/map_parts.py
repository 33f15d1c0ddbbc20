"""A node's part of the map, which SLAM keeps."""

from __future__ import annotations

import time
from collections.abc import Callable

from std_msgs.msg import UInt8MultiArray

from segfloor_ros.core.files.arrays import Arrays, MapFile
from segfloor_ros.nodes.messages.saved_maps import LEAST_SHARE, map_file_message, map_file_of
from segfloor_ros.nodes.messages.topics import MAP_LOADED, MAP_PART
from segfloor_ros.nodes.shared.inputs import CHECK_S
from segfloor_ros.nodes.shared.keyframes import KeyframeJoin
from segfloor_ros.nodes.shared.stage_node import AnyStageNode


class MapPart:
    """Sends the part of a node to SLAM, which keeps it, saves it with the map, and gives it back
    when the node is started again; so comes the part of a map that SLAM has loaded. Keyframes of a
    map wait until SLAM has answered; those that are in the part are passed over.

    name: of the part. arrays: returns it. restore: goes on with it. last_ns: stamp of the latest
    keyframe in the map, whose frame is frame_id.
    """

    def __init__(
        self,
        node: AnyStageNode,
        keyframes: KeyframeJoin,
        name: str,
        arrays: Callable[[], Arrays] = dict,
        restore: Callable[[MapFile], None] = lambda saved: None,
    ) -> None:
        self.last_ns = 0
        self.frame_id = ''
        self._node = node
        self._keyframes = keyframes
        self._name = name
        self._arrays = arrays
        self._restore = restore
        self._start_ns: int | None = None
        self._asked = 0
        """When SLAM was asked for the last time, by which its answer is known."""
        self._is_sent, self._next_s = True, 0.0
        node.inputs.subscribe(MAP_LOADED, self._take)
        node.inputs.every(CHECK_S, self._keep)
        self._may_process, keyframes.may_process = keyframes.may_process, self._is_here

    def reset(self) -> None:
        """Belong to a map of which nothing is known yet."""
        if not self._is_sent:
            self._send()
        self.last_ns, self.frame_id = 0, ''
        self._start_ns = self._keyframes.map_start_ns
        self._send(is_empty=True)

    def note(self, stamp_ns: int, frame_id: str) -> None:
        """Note that a keyframe is in the map, and have SLAM keep the part."""
        self.last_ns, self.frame_id, self._is_sent = stamp_ns, frame_id, False
        self._keep()

    def _is_here(self) -> bool:
        """Whether all is known that SLAM keeps of the map of the keyframes; asks for it."""
        start_ns, keeper = self._keyframes.map_start_ns, self._node.inputs.subscriptions[MAP_LOADED]
        if start_ns != self._start_ns:
            if keeper.get_publisher_count():
                if self._start_ns is not None or not self._asked:
                    self._start_ns = None
                    self._send(is_empty=True)
                return False
            self._start_ns = start_ns
        return self._may_process()

    def _keep(self) -> None:
        """Send what is new, once it is time."""
        if not self._is_sent and time.monotonic() >= self._next_s:
            self._send()

    def _send(self, is_empty: bool = False) -> None:
        """Send the part, or none: where the map is not known, that asks for what SLAM keeps."""
        begun_s = time.monotonic()
        if self._start_ns is None:
            self._asked = time.time_ns()
        header = {
            'part': self._name,
            'start_ns': self._start_ns,
            'asked': self._asked,
            'last_ns': self.last_ns,
            'frame_id': self.frame_id,
        }
        parts = {} if is_empty else {self._name: self._arrays()}
        self._node.outputs.publish(MAP_PART, map_file_message(MapFile(header, parts)))
        now_s = time.monotonic()
        self._is_sent, self._next_s = True, now_s + LEAST_SHARE * (now_s - begun_s)

    def _take(self, message: UInt8MultiArray) -> None:
        """Go on with what SLAM keeps or has loaded, where it is the answer, or another map."""
        saved = map_file_of(message, MAP_LOADED)
        start_ns, answers = saved.header['start_ns'], saved.header['asked']
        is_meant = answers.get(self._name) == self._asked or self._start_ns is not None
        if start_ns == self._start_ns or not is_meant:
            return
        if self.frame_id:
            self._node.reset('stereo_slam goes on with another map')
        self._keyframes.leave_for(start_ns)
        self._start_ns = start_ns
        if self._name in saved.header['last_ns']:
            self.last_ns = self._keyframes.known_ns = saved.header['last_ns'][self._name]
            self.frame_id = saved.header['frame_id']
            self._restore(saved)
            self._node.get_logger().warning('resumed with the map that stereo_slam keeps')
        self._keyframes.process_waiting()
