"""Node `occupancy_grid`: labelled points, features, path and floor scan in, the map out."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from rclpy.timer import Timer

from segfloor_ros.core.errors import MapError, SettingsError
from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.core.files.paths import user_path
from segfloor_ros.core.grid.mapper import make_mapper
from segfloor_ros.nodes.messages.grids import grid_message
from segfloor_ros.nodes.messages.points import features_arrays, labelled_arrays
from segfloor_ros.nodes.messages.poses import path_arrays
from segfloor_ros.nodes.messages.scans import scan_arrays
from segfloor_ros.nodes.settings.grid import OccupancyGridNodeSettings
from segfloor_ros.nodes.shared.keyframes import KeyframeJoin
from segfloor_ros.nodes.shared.map_parts import MapPart
from segfloor_ros.nodes.shared.running import run_node
from segfloor_ros.nodes.shared.stage_node import StageNode

YAML_SUFFIXES = ('.yaml', '.yml')
POINTS, FEATURES = 'labelled_points', 'keyframe/features'
PATH, POSE, SCAN = 'keyframe/path', 'keyframe/odometry', 'keyframe/floor_scan'


class OccupancyGridNode(StageNode[OccupancyGridNodeSettings]):
    """Builds the map at every keyframe and publishes it."""

    settings_type = OccupancyGridNodeSettings

    def set_up(self) -> None:
        """Make the topics and the service."""
        self._later: Timer | None = None
        parts = (POINTS, FEATURES, PATH, POSE, SCAN)
        self._keyframes = KeyframeJoin(self, parts, self._update, is_last=True)
        self._part = MapPart(
            self, self._keyframes, 'grid', lambda: self._stage.to_arrays(), self._restore
        )
        self.outputs.trigger('save_map', self._save)

    def reset_stage(self) -> None:
        """Begin with an empty map."""
        self._part.reset()
        self._stage = make_mapper(self.settings)
        self._published_s = -float('inf')

    def _restore(self, saved: MapFile) -> None:
        """Go on with a map, and publish it at once."""
        arrays = saved.parts['grid']
        self._stage.from_arrays(arrays, arrays['stamp_ns'])
        self._publish()

    def on_inputs_closed(self) -> None:
        """Publish the map if it was still to come."""
        if self._later is not None and self.context.ok():
            self._publish()

    def on_settings_changed(self) -> None:
        """Map the next keyframe with the new settings."""
        self._stage.change_settings(self.settings)

    def _update(self, stamp_ns: int, parts: Mapping[str, Any]) -> dict[str, Any]:
        points = labelled_arrays(parts[POINTS], POINTS)
        features = features_arrays(parts[FEATURES], FEATURES)
        path = path_arrays(parts[PATH])
        scan = scan_arrays(parts[SCAN], SCAN)
        self._stage.update(stamp_ns, points, features, path, scan)
        self._part.note(stamp_ns, parts[POSE].header.frame_id)
        self._publish_soon()
        return {}

    def _publish_soon(self) -> None:
        """Publish now, or when the period since the last map is over."""
        if self._later is not None:
            return
        wait_s = self._published_s + self.settings.publish_period_s - time.monotonic()
        if wait_s <= 0:
            self._publish()
        else:
            self._later = self.inputs.steady_timer(wait_s, self._publish)

    def _publish(self) -> None:
        if self._later is not None:
            self.destroy_timer(self._later)
            self._later = None
        self._published_s = time.monotonic()
        last_ns, frame_id = self._part.last_ns, self._part.frame_id
        self.outputs.publish('map', grid_message(last_ns, frame_id, self._stage.grid()))

    def _save(self) -> str:
        name = self.settings.map_file
        if not name:
            raise SettingsError('map_file is empty; set it to the name of a file, e.g. map.yaml')
        if not self._part.frame_id:
            raise MapError('there is no map yet: no keyframe has arrived')
        path = user_path(name).absolute()
        if path.suffix not in YAML_SUFFIXES:
            path = path.with_name(f'{path.name}.yaml')
        from segfloor_ros.nodes.map_files import save_map

        save_map(self._stage.grid(), path)
        return str(path)


def main() -> None:
    """Run the node."""
    run_node(OccupancyGridNode)


if __name__ == '__main__':
    main()
