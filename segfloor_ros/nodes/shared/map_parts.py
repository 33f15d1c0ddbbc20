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
        """Belong to a map of which nothing is known yet, and ask SLAM where there is none."""
        if not self._is_sent:
            self._send()
        self.last_ns, self.frame_id = 0, ''
        self._start_ns = self._keyframes.map_start_ns
        self._send()

    def note(self, stamp_ns: int, frame_id: str) -> None:
        """Note that a keyframe is in the map, and have SLAM keep the part."""
        self.last_ns, self.frame_id, self._is_sent = stamp_ns, frame_id, False
        self._keep()

    def _is_here(self) -> bool:
        """Whether all is known that SLAM keeps of the map of the keyframes; asks for it."""
        if self._keyframes.map_start_ns == self._start_ns:
            return self._may_process()
        if self._start_ns is not None:
            self._start_ns = None
            self._send()
        return False

    def _keep(self) -> None:
        """Send what is new, once it is time."""
        if not self._is_sent and time.monotonic() >= self._next_s:
            self._send()

    def _send(self) -> None:
        """Send the part, if there is one; where the map is not known, that asks for it."""
        begun_s = time.monotonic()
        if self._start_ns is None:
            self._asked = time.time_ns()
        header = {
            'part': self._name, 'start_ns': self._start_ns, 'asked': self._asked,
            'last_ns': self.last_ns, 'frame_id': self.frame_id,
        }  # fmt: skip
        parts = {self._name: self._arrays()} if self.frame_id else {}
        self._node.outputs.publish(MAP_PART, map_file_message(MapFile(header, parts)))
        now_s = time.monotonic()
        self._is_sent, self._next_s = True, now_s + LEAST_SHARE * (now_s - begun_s)

    def _take(self, message: UInt8MultiArray) -> None:
        """Go on with what SLAM keeps or has loaded, where it is the answer, or another map."""
        saved = map_file_of(message, MAP_LOADED)
        header, name = saved.header, self._name
        is_meant = self._start_ns is not None or header['asked'].get(name) == self._asked
        if header['start_ns'] == self._start_ns or not is_meant:
            return
        if self.frame_id:
            self._node.reset('stereo_slam goes on with another map')
        self._keyframes.leave_for(header['start_ns'])
        self._start_ns = header['start_ns']
        if name in header['last_ns']:
            self.last_ns, self.frame_id = header['last_ns'][name], header['frame_id']
            self._keyframes.known_ns = self.last_ns
            self._restore(saved)
            self._node.get_logger().warning('resumed with the map that stereo_slam keeps')
        self._keyframes.process_waiting()
