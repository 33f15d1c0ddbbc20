"""A node's part of a saved map."""

from __future__ import annotations

from collections.abc import Callable

from std_msgs.msg import Header, UInt8MultiArray

from segfloor_ros.core.files.arrays import Arrays, MapFile
from segfloor_ros.nodes.messages.saved_maps import map_file_message, map_file_of
from segfloor_ros.nodes.messages.topics import MAP_LOADED, MAP_PART, MAP_WANTED, to_ns
from segfloor_ros.nodes.shared.keyframes import KeyframeJoin
from segfloor_ros.nodes.shared.stage_node import AnyStageNode


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
