"""Node `occupancy_grid`: labelled points, features, path and floor scan in, the map out."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path as FilePath
from typing import Any

from rclpy.timer import Timer
from std_srvs.srv import Trigger

from segfloor_ros.errors import SegfloorError
from segfloor_ros.grid.map_file import save_map
from segfloor_ros.grid.mapper import OccupancyGridMapper
from segfloor_ros.grid.settings import OccupancyGridSettings
from segfloor_ros.messages.clouds import features_arrays, labelled_arrays
from segfloor_ros.messages.floor import scan_arrays
from segfloor_ros.messages.grids import grid_message
from segfloor_ros.messages.poses import path_arrays
from segfloor_ros.node_settings import OccupancyGridNodeSettings
from segfloor_ros.nodes.keyframe_join import KeyframeJoin
from segfloor_ros.nodes.running import run_node
from segfloor_ros.nodes.stage_node import StageNode

YAML_SUFFIXES = ('.yaml', '.yml')
POINTS, FEATURES = 'labelled_points', 'keyframe/features'
PATH, POSE, SCAN = 'keyframe/path', 'keyframe/odometry', 'keyframe/floor_scan'


class OccupancyGridNode(StageNode[OccupancyGridSettings, OccupancyGridNodeSettings]):
    """Builds the map at every keyframe and publishes it."""

    def __init__(self) -> None:
        super().__init__(OccupancyGridSettings, OccupancyGridNodeSettings)

    def set_up(self) -> None:
        """Make the topics and the service."""
        self._later: Timer | None = None
        self._map = self.output('map')
        parts = (POINTS, FEATURES, PATH, POSE, SCAN)
        self._keyframes = KeyframeJoin(self, parts, self._update, is_last=True)
        self.offer(Trigger, 'save_map', self._save)

    def reset_stage(self) -> None:
        """Begin with an empty map."""
        self._stage = OccupancyGridMapper(self.parameters.stage)
        self._stamp_ns = 0
        self._frame_id = ''
        self._published_s = -float('inf')

    def restore(self, state: tuple[int | None, OccupancyGridMapper, int, str]) -> None:
        """Resume with the map of a killed node, and publish it at once."""
        self._keyframes.map_start_ns, self._stage, self._stamp_ns, self._frame_id = state
        self._stage.change_settings(self.parameters.stage)
        self.get_logger().warning('resumed with the map of a node that was killed')
        self._publish()

    def on_inputs_closed(self) -> None:
        """Publish the map if it was still to come."""
        if self._later is not None and self.context.ok():
            self._publish()

    def on_settings_changed(self) -> None:
        """Map the next keyframe with the new settings."""
        self._stage.change_settings(self.parameters.stage)

    def _update(self, stamp_ns: int, parts: Mapping[str, Any]) -> dict[str, Any]:
        points = labelled_arrays(parts[POINTS], POINTS)
        features = features_arrays(parts[FEATURES], FEATURES)
        path = path_arrays(parts[PATH])
        scan = scan_arrays(parts[SCAN], SCAN)
        self._stage.update(stamp_ns, points, features, path, scan)
        self._stamp_ns, self._frame_id = stamp_ns, parts[POSE].header.frame_id
        map_start_ns = self._keyframes.map_start_ns
        self.kept_state.save((map_start_ns, self._stage, self._stamp_ns, self._frame_id))
        self._publish_soon()
        return {}

    def _publish_soon(self) -> None:
        """Publish now, or when the period since the last map is over."""
        if self._later is not None:
            return
        wait_s = self._published_s + self.parameters.own.publish_period_s - time.monotonic()
        if wait_s <= 0:
            self._publish()
        else:
            self._later = self.inputs.steady_timer(wait_s, self._publish)

    def _publish(self) -> None:
        if self._later is not None:
            self.destroy_timer(self._later)
            self._later = None
        self._published_s = time.monotonic()
        self._map.publish(grid_message(self._stamp_ns, self._frame_id, self._stage.grid()))

    def _save(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        name = self.parameters.own.map_file
        if not self._frame_id or not name:
            response.message = (
                'there is no map yet: no keyframe has arrived'
                if name
                else 'map_file is empty; set it to the name of a file, e.g. map.yaml'
            )
            return response
        path = FilePath(name).expanduser().absolute()
        if path.suffix not in YAML_SUFFIXES:
            path = path.with_name(f'{path.name}.yaml')
        try:
            save_map(self._stage.grid(), path)
        except (SegfloorError, OSError) as error:
            response.message = f'{path}: {error}'
            return response
        response.success, response.message = True, str(path)
        return response


def main() -> None:
    """Run the node."""
    run_node(OccupancyGridNode)


if __name__ == '__main__':
    main()
