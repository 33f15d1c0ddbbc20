"""The maps that the node `stereo_slam` loads, saves, and keeps for its next life and for that of
the nodes behind it.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

from rclpy.task import Future
from std_msgs.msg import UInt8MultiArray

from segfloor_ros.core.contracts import LoadedMap
from segfloor_ros.core.errors import MapError, SettingsError
from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.core.files.paths import user_path
from segfloor_ros.core.slam.stereo_slam import StereoSlam
from segfloor_ros.nodes.kept_state import KeptState
from segfloor_ros.nodes.messages.saved_maps import map_file_message, map_file_of
from segfloor_ros.nodes.messages.topics import MAP_LOADED, MAP_PART, PATIENCE_S
from segfloor_ros.nodes.settings.slam import StereoSlamNodeSettings
from segfloor_ros.nodes.shared.stage_node import AnyStageNode
from segfloor_ros.nodes.slam_outputs import SlamTopics

PARTS = {'cloud', 'grid'}
"""What the nodes behind know of a map, in a file."""


class SlamMaps:
    """The services `~/save_map`, `~/load_map`, `~/prune_map` and `~/map_info`, and what the nodes
    behind SLAM know of the map, which they get back when they ask for it.

    slam: returns what could be saved, of the map that `topics` are about.
    """

    def __init__(
        self, node: AnyStageNode, topics: SlamTopics, slam: Callable[[], StereoSlam | None]
    ) -> None:
        self._node = node
        self._topics = topics
        self._slam = slam
        self.kept = KeptState(node.get_fully_qualified_name(), self._own.resume_within_s)
        node.outputs.at_clean_up(self.kept.remove)
        self._kept_ns: list[int] = []
        self._parts: dict[str, MapFile] = {}
        """What the nodes behind know, by name; each with the map that it belongs to."""
        self._asked: dict[str, int] = {}
        self._is_to_answer = False
        self._arrived: Future | None = None
        """Done when a map that is saved has all its parts."""
        # On a busy machine only one message of each topic is taken per frame.
        node.inputs.subscribe(MAP_PART, self._take_part, takes_all=True)
        node.outputs.trigger('~/save_map', self._save)
        node.outputs.trigger('~/load_map', self._load)
        node.outputs.trigger('~/prune_map', self._prune)
        node.outputs.trigger('~/map_info', self._info)

    @property
    def _own(self) -> StereoSlamNodeSettings:
        own: StereoSlamNodeSettings = self._node.settings
        return own

    def read(self) -> MapFile | None:
        """Return the map of the parameter `load_map`, None where it is empty. Raises InputError."""
        name = self._own.load_map
        if not name:
            return None
        from segfloor_ros.core.files.results import read_map_file

        return read_map_file(user_path(name))

    def hold(self, saved: MapFile, last_ns: dict[str, int]) -> None:
        """Hold what the nodes behind know of a map that SLAM goes on with. last_ns: the latest
        keyframe in each part.
        """
        belongs = {'start_ns': self._topics.map_start_ns, 'frame_id': self._own.map_frame}
        for name, stamp_ns in last_ns.items():
            parts = {name: saved.parts[name]} if name in saved.parts else {}
            self._parts[name] = MapFile(belongs | {'part': name, 'last_ns': stamp_ns}, parts)
        self._is_to_answer = True

    def hold_kept(self, saved: MapFile) -> None:
        """Hold what the nodes behind know of the map of a killed node. Its keyframes are not sent
        again: a part that lacks the last ones has all that it can have.
        """
        last_ns = saved.header['last_ns'].items()
        self.hold(saved, {name: max(stamp_ns, _last_ns(saved)) for name, stamp_ns in last_ns})

    def hold_loaded(self, saved: MapFile, loaded: LoadedMap) -> None:
        """Hold what the nodes behind need of a map that was loaded."""
        grid, cloud = saved.parts['grid'], loaded.cloud
        saved.parts['grid'] = grid | {'stamp_ns': grid['stamp_ns'] + loaded.shift_ns}
        self.hold(saved, dict.fromkeys(sorted(PARTS), int(loaded.path.stamp_ns[-1])))
        points = {'point_id': cloud.point_id, 'xyz_map': cloud.xyz_map}
        self._parts['cloud'].parts['points'] = points

    def work(self) -> None:
        """Answer the nodes that have asked, and keep what a later life of this node goes on from,
        where there are new keyframes.
        """
        if self._is_to_answer:
            self._is_to_answer = False
            start_ns, frame_id = self._topics.map_start_ns, self._own.map_frame
            header = {'start_ns': start_ns, 'frame_id': frame_id, 'asked': self._asked}
            answer = self._with_parts(MapFile(header))
            self._node.outputs.publish(MAP_LOADED, map_file_message(answer))
        slam = self._slam()
        if slam is None or slam.mount is None or not slam.map.keyframes or self._own.localize:
            return
        newest = [slam.map.keyframes[-1].stamp_ns]
        newest += [part.header['last_ns'] for part in self._parts.values()]
        if newest != self._kept_ns and slam.back_end.idle and self.kept.is_due:
            self.kept.save(lambda: self._with_parts(self._slam_part()))
            self._kept_ns = newest

    def _with_parts(self, saved: MapFile) -> MapFile:
        """Add what the nodes behind know of the map, and the latest keyframe in each part."""
        saved.header['last_ns'] = {}
        for name, part in self._parts.items():
            if part.header['start_ns'] == self._topics.map_start_ns:
                saved.header['last_ns'][name] = part.header['last_ns']
                saved.parts |= part.parts
        return saved

    def _slam_part(self) -> MapFile:
        slam = self._slam()
        if slam is None:
            raise MapError('there is no map yet that could be saved')
        from segfloor_ros.core.plugins.maps.saved_slam import save_slam

        saved = save_slam(slam, slam.rig.camera)
        saved.header['start_ns'] = self._topics.map_start_ns
        return saved

    def _load(self) -> str:
        if not self._own.load_map:
            raise SettingsError('load_map is empty; set it to the name of a saved map')
        self.read()  # one that cannot be read leaves the map as it is
        self._node.reset('by ~/load_map')
        return self._own.load_map

    def _info(self) -> str:
        """Return what the map holds, as JSON."""
        saved = self._slam_part()
        slam, sessions = saved.parts['slam'], saved.header['sessions']
        columns = {
            'keyframes': 'keyframe_stamp_ns', 'points': 'point_stable_id', 'loops': 'loop_ends',
        }  # fmt: skip
        sizes = {name: len(slam[column]) for name, column in columns.items()}
        return json.dumps(sizes | {'sessions': sessions})

    def _file_to_save(self) -> Path:
        if not self._own.save_map:
            raise SettingsError('save_map is empty; set it to the name of a file, e.g. home.map')
        if self._arrived is not None:
            raise MapError('a map is being saved already')
        return user_path(self._own.save_map).absolute()

    async def _prune(self) -> str:
        """Prune the file of `save_map` beside tracking; the map in use stays as it is."""
        from segfloor_ros.core.plugins.maps.pruning import prune_file

        said: list[str] = []
        path = self._file_to_save()
        await _in_background(lambda: said.append(prune_file(path)))
        return said[0]

    async def _save(self) -> str:
        """Gather the map and write it beside tracking, which goes on meanwhile."""
        return await self._completed(*self._begin_to_save())

    def save_before_reset(self) -> None:
        """Begin to save a map that is dropped now, where `save_map` names a file."""
        slam = self._slam()
        has_map = slam is not None and slam.mount is not None and bool(slam.map.keyframes)
        if not (self._own.save_map and has_map) or self._own.localize or self._arrived is not None:
            return
        node, log_fault = self._node, self._node.reporter.log_fault

        async def complete(path: Path, saved: MapFile) -> None:
            try:
                place = await self._completed(path, saved)
                node.get_logger().warning(f'the map before the reset is in {place}')
            except Exception as error:
                log_fault('save_map, before the reset', error)

        try:
            assert node.executor is not None
            node.executor.create_task(complete, *self._begin_to_save())
        except Exception as error:
            log_fault('save_map, before the reset', error)

    def _begin_to_save(self) -> tuple[Path, MapFile]:
        """Wait for the parts of the other nodes; returns where to save, and SLAM's own part."""
        from segfloor_ros.core.files.results import SAVED_MAP
        from segfloor_ros.core.files.writing import check_output

        path = self._file_to_save()
        check_output(path, SAVED_MAP, (self._own.load_map,), 'save_map')
        saved = self._slam_part()
        self._saved, self._arrived = saved, Future()
        for part in self._parts.values():
            self._gather(part)
        return path, saved

    async def _completed(self, path: Path, saved: MapFile) -> str:
        """Save a map once the parts of the other nodes have come; returns where it is."""
        arrived = self._arrived
        assert arrived is not None
        give_up = self._node.inputs.steady_timer(PATIENCE_S, self._give_up)
        try:
            await arrived
            del saved.header['start_ns']
            from segfloor_ros.core.files.results import write_map_file

            inputs = (self._own.load_map,)
            await _in_background(partial(write_map_file, path, saved, inputs))
        finally:
            self._node.destroy_timer(give_up)
            self._arrived = None
        return str(path)

    def _give_up(self) -> None:
        if self._arrived is not None and not self._arrived.done():
            missing = ', '.join(sorted(PARTS - self._saved.parts.keys()))
            text = (
                f'the map is not saved: within {PATIENCE_S:g} s no answer on {MAP_PART} of the '
                f'part {missing}; are cloud_labelling and occupancy_grid active?'
            )
            self._arrived.set_exception(MapError(text))

    def _take_part(self, message: UInt8MultiArray) -> None:
        part = map_file_of(message, MAP_PART)
        name, start_ns = part.header['part'], part.header['start_ns']
        self._asked[name] = part.header['asked']
        if start_ns is None:
            self._is_to_answer = True
        elif not part.header['frame_id']:
            self._parts.pop(name, None)
        else:
            self._parts[name] = part
            self._gather(part)

    def _gather(self, part: MapFile) -> None:
        """Take a part that a save waits for: of its map, with its last keyframe."""
        if self._arrived is None or self._arrived.done():
            return
        saved, name = self._saved, part.header['part']
        if name in PARTS and _covers(part, saved):
            saved.parts[name] = part.parts[name]
        if saved.parts.keys() >= PARTS:
            self._arrived.set_result(None)


def _last_ns(saved: MapFile) -> int:
    """Return the stamp of the latest keyframe of SLAM's part."""
    return int(saved.parts['slam']['keyframe_stamp_ns'][-1])


def _covers(part: MapFile, saved: MapFile) -> bool:
    """Return whether a part has all keyframes of SLAM's part, of the same map."""
    is_of_map = part.header['start_ns'] == saved.header['start_ns']
    return is_of_map and part.header['last_ns'] >= _last_ns(saved)


async def _in_background(work: Callable[[], None]) -> None:
    """Do something on a thread of its own."""
    done = Future()

    def run() -> None:
        try:
            work()
        except Exception as error:
            done.set_exception(error)
        else:
            done.set_result(None)

    threading.Thread(target=run, name='save map').start()
    await done
