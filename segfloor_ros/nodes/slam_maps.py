"""Maps that the node `stereo_slam` loads, saves, and keeps for its next life."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

from rclpy.task import Future
from rclpy.timer import Timer
from std_msgs.msg import UInt8MultiArray

from segfloor_ros.configuration import StereoSlamNodeSettings
from segfloor_ros.errors import MapError, SettingsError
from segfloor_ros.files.saved_map import MapFile, read_map_file, write_map_file
from segfloor_ros.messages.maps import map_file_message, map_file_of
from segfloor_ros.messages.topics import MAP_LOADED, MAP_PART, MAP_WANTED, PATIENCE_S, make_header
from segfloor_ros.nodes.shared.stage_node import AnyStageNode
from segfloor_ros.nodes.slam_outputs import SlamTopics
from segfloor_ros.slam.mapping.back_end import Submap
from segfloor_ros.slam.saved_slam import LoadedMap, save_slam
from segfloor_ros.slam.stereo_slam import StereoSlam

PARTS = {'cloud', 'grid'}
"""What the nodes behind know of a map."""


class SlamMaps:
    """The services `~/save_map` and `~/load_map`, and what SLAM and the nodes behind it tell each
    other about maps of files.

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
        self._loaded_output = node.outputs.publisher(MAP_LOADED)
        self._wanted = node.outputs.publisher(MAP_WANTED)
        node.inputs.subscribe(MAP_PART, self._take_part)
        node.outputs.trigger('~/save_map', self._save)
        node.outputs.trigger('~/load_map', self._load)

    @property
    def _own(self) -> StereoSlamNodeSettings:
        own: StereoSlamNodeSettings = self._node.settings
        return own

    def read(self) -> MapFile | None:
        """Return the map of the parameter `load_map`, None where it is empty. Raises InputError."""
        self.loaded, name = None, self._own.load_map
        return read_map_file(Path(name).expanduser()) if name else None

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
        self._loaded_output.publish(map_file_message(MapFile(header, parts)))

    def _slam_part(self) -> MapFile:
        slam = self._slam()
        if slam is None:
            raise MapError('there is no map yet that could be saved')
        saved = save_slam(slam, slam.rig.camera)
        saved.header['start_ns'] = self._topics.map_start_ns
        return saved

    def _load(self) -> str:
        if not self._own.load_map:
            raise SettingsError('load_map is empty; set it to the name of a saved map')
        self._node.reset('by ~/load_map')
        return self._own.load_map

    async def _save(self) -> str:
        """Gather the map and write it beside tracking, which goes on meanwhile."""
        name = self._own.save_map
        if not name:
            raise SettingsError('save_map is empty; set it to the name of a file, e.g. home.map')
        if self._arrived is not None:
            raise MapError('a map is being saved already')
        path = Path(name).expanduser().absolute()
        self._refuse_to_overwrite(path)
        saved = self._slam_part()
        start_ns = saved.header.pop('start_ns')
        self._parts = {}
        self._arrived = Future()
        give_up = self._node.inputs.steady_timer(PATIENCE_S, self._give_up)
        last_ns = int(saved.parts['slam']['keyframe_stamp_ns'][-1])
        self._wanted.publish(make_header(last_ns, self._own.map_frame))
        try:
            await self._arrived
            for part in self._parts.values():
                if part.header['start_ns'] != start_ns:
                    raise MapError('the map was reset while it was saved')
                saved.parts |= part.parts
            await _in_background(partial(write_map_file, path, saved))
        finally:
            self._stop(give_up)
        return str(path)

    def _refuse_to_overwrite(self, path: Path) -> None:
        """Raise MapError where a map would be replaced that the drive has not recognised."""
        slam, load_map = self._slam(), self._own.load_map
        is_outside = slam is not None and slam.back_end.submap is Submap.OUTSIDE
        if is_outside and load_map and Path(load_map).expanduser().resolve() == path.resolve():
            raise MapError(
                f'{path}: stays as it was, since no place of it was recognised; set save_map to '
                'another name to keep the map of this drive'
            )

    def _stop(self, timer: Timer) -> None:
        self._node.destroy_timer(timer)
        self._arrived = None
        self._parts = {}

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
