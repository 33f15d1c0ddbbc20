"""The maps that the node `stereo_slam` loads, saves, and keeps for its next life."""

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
from segfloor_ros.nodes.messages.saved_maps import map_file_message, map_file_of
from segfloor_ros.nodes.messages.topics import (
    MAP_LOADED,
    MAP_PART,
    MAP_WANTED,
    PATIENCE_S,
    make_header,
)
from segfloor_ros.nodes.settings.slam import StereoSlamNodeSettings
from segfloor_ros.nodes.shared.stage_node import AnyStageNode
from segfloor_ros.nodes.slam_outputs import SlamTopics

PARTS = {'cloud', 'grid'}
"""What the nodes behind know of a map."""


class SlamMaps:
    """The services `~/save_map`, `~/load_map`, `~/prune_map` and `~/map_info`, and what SLAM and
    the nodes behind it tell each other about maps of files.

    slam: returns what could be saved, of the map that `topics` are about.
    """

    def __init__(
        self, node: AnyStageNode, topics: SlamTopics, slam: Callable[[], StereoSlam | None]
    ) -> None:
        self._node = node
        self._topics = topics
        self._slam = slam
        self.loaded: tuple[MapFile, LoadedMap] | None = None
        """What was read of a file and is still to be announced."""
        self._kept_ns: int | None = None
        self._parts: dict[str, MapFile] = {}
        self._arrived: Future | None = None
        node.inputs.subscribe(MAP_PART, self._take_part)
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
        self.loaded, name = None, self._own.load_map
        if not name:
            return None
        from segfloor_ros.core.files.results import read_map_file

        return read_map_file(user_path(name))

    def keep(self, slam: StereoSlam) -> None:
        """Keep what a later life of this node goes on from, where there are new keyframes."""
        last_ns = slam.map.keyframes[-1].stamp_ns
        if self._node.kept_state.is_due and last_ns != self._kept_ns and not self._own.localize:
            self._node.kept_state.save(self._slam_part)
            self._kept_ns = last_ns

    def announce(self) -> None:
        """Send the nodes behind what they need of a map that was loaded."""
        if self.loaded is None:
            return
        (saved, loaded), self.loaded = self.loaded, None
        start_ns = self._topics.map_start_ns
        header = {
            'start_ns': start_ns,
            'loaded_ns': start_ns,
            'last_ns': int(loaded.path.stamp_ns[-1]),
            'frame_id': self._own.map_frame,
        }
        cloud, grid = loaded.cloud, saved.parts['grid']
        parts = {
            'cloud': saved.parts['cloud'],
            'grid': grid | {'stamp_ns': grid['stamp_ns'] + loaded.shift_ns},
            'points': {'point_id': cloud.point_id, 'xyz_map': cloud.xyz_map},
        }
        self._node.outputs.publish(MAP_LOADED, map_file_message(MapFile(header, parts)))

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
        """Ask for the parts of the other nodes; returns where to save, and SLAM's own part."""
        from segfloor_ros.core.files.results import SAVED_MAP
        from segfloor_ros.core.files.writing import check_output

        path = self._file_to_save()
        check_output(path, SAVED_MAP, (self._own.load_map,), 'save_map')
        saved = self._slam_part()
        self._arrived = Future()
        last_ns = int(saved.parts['slam']['keyframe_stamp_ns'][-1])
        self._node.outputs.publish(MAP_WANTED, make_header(last_ns, self._own.map_frame))
        return path, saved

    async def _completed(self, path: Path, saved: MapFile) -> str:
        """Save a map once the parts of the other nodes have come; returns where it is."""
        start_ns, arrived = saved.header.pop('start_ns'), self._arrived
        assert arrived is not None
        give_up = self._node.inputs.steady_timer(PATIENCE_S, self._give_up)
        try:
            await arrived
            for part in self._parts.values():
                if part.header['start_ns'] != start_ns:
                    raise MapError('the map was reset while it was saved')
                saved.parts |= part.parts
            from segfloor_ros.core.files.results import write_map_file

            inputs = (self._own.load_map,)
            await _in_background(partial(write_map_file, path, saved, inputs))
        finally:
            self._node.destroy_timer(give_up)
            self._arrived, self._parts = None, {}
        return str(path)

    def _give_up(self) -> None:
        if self._arrived is not None and not self._arrived.done():
            missing = ', '.join(sorted(PARTS - self._parts.keys()))
            text = (
                f'the map is not saved: within {PATIENCE_S:g} s no answer on {MAP_PART} of the '
                f'part {missing}; are cloud_labelling and occupancy_grid active?'
            )
            self._arrived.set_exception(MapError(text))

    def _take_part(self, message: UInt8MultiArray) -> None:
        part = map_file_of(message, MAP_PART)
        if self._arrived is None or self._arrived.done():
            return
        self._parts.update(dict.fromkeys(part.parts, part))
        if self._parts.keys() >= PARTS:
            self._arrived.set_result(None)


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
