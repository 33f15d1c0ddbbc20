"""Node `cloud_labelling`: sparse map, features and floor mask in, labelled points out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2

from segfloor_ros.cloud.labelled_cloud import CloudLabelling
from segfloor_ros.cloud.labels import FLOOR, OBSTACLE, LabelledPoints
from segfloor_ros.cloud.settings import CloudLabellingSettings
from segfloor_ros.map_file import MapFile
from segfloor_ros.messages.clouds import (
    features_arrays,
    labelled_message,
    points_of_label,
    sparse_cloud_arrays,
)
from segfloor_ros.messages.headers import to_ns
from segfloor_ros.messages.images import grey8_image
from segfloor_ros.messages.poses import pose_array
from segfloor_ros.node_settings import CloudLabellingNodeSettings
from segfloor_ros.nodes.keyframe_join import KeyframeJoin
from segfloor_ros.nodes.map_part import MapPart
from segfloor_ros.nodes.robot_check import RobotCheck
from segfloor_ros.nodes.running import run_node
from segfloor_ros.nodes.stage_node import StageNode
from segfloor_ros.slam.results import SparseCloud

MAP_POINTS, FEATURES = 'map_points', 'keyframe/features'
POSE, MASK = 'keyframe/odometry', 'keyframe/floor_mask'
KEEP_ALIVE_S = 0.5


class CloudLabellingNode(StageNode[CloudLabellingSettings, CloudLabellingNodeSettings]):
    """Labels the sparse map at every keyframe."""

    works_on_demand = True

    def __init__(self) -> None:
        super().__init__(CloudLabellingSettings, CloudLabellingNodeSettings)
        self._robot_check = RobotCheck(self, 'floor_segmentation')

    def set_up(self) -> None:
        """Make the topics."""
        self._labelled = self.output('labelled_points')
        self._by_label = {
            FLOOR: self.output('floor_points'),
            OBSTACLE: self.output('obstacle_points'),
        }
        keyframes = KeyframeJoin(self, (MAP_POINTS, FEATURES, POSE, MASK), self._label)
        self._part = MapPart(self, keyframes, 'cloud', lambda: self._stage.to_arrays())
        self.inputs.subscribe('odometry', self._keep_alive, is_wanted=self._obstacles_are_wanted)
        self.inputs.every(KEEP_ALIVE_S, self.inputs.update)

    def reset_stage(self) -> None:
        """Begin without points."""
        self._part.reset()
        self._stage = CloudLabelling(self.parameters.stage)
        self._obstacles: PointCloud2 | None = None

    def restore(self, saved: MapFile) -> None:
        """Go on with the labels of a map, and publish its obstacles where they are known."""
        self._stage.from_arrays(saved.parts['cloud'])
        self._part.resume(saved)
        points = saved.parts.get('points')
        if points is not None:
            cloud = SparseCloud(points['point_id'], points['xyz_map'])
            labelled, at = self._stage.labelled(cloud), (self._part.last_ns, self._part.frame_id)
            self._publish_by_label(*at, labelled)
            # Also for those who listen later: without keyframes it stays as it is.
            self._obstacles = points_of_label(*at, labelled, OBSTACLE)

    def find_problems(self) -> None:
        """Report when the floor is segmented for another robot."""
        difference = self._robot_check.difference(self.parameters.stage)
        if difference is not None:
            self.reporter.diagnose('robot', difference)

    def on_settings_changed(self) -> None:
        """Label the next keyframe with the new settings."""
        self._stage.settings = self.parameters.stage

    def _label(self, stamp_ns: int, parts: Mapping[str, Any]) -> dict[str, Any]:
        cloud = sparse_cloud_arrays(parts[MAP_POINTS], MAP_POINTS)
        features = features_arrays(parts[FEATURES], FEATURES)
        mask = grey8_image(parts[MASK], MASK)
        T_map_base = pose_array(parts[POSE].pose.pose)
        labelled = self._stage.update(cloud, features, mask, T_map_base)
        frame_id = parts[MAP_POINTS].header.frame_id
        self._labelled.publish(labelled_message(stamp_ns, frame_id, labelled))
        self._publish_by_label(stamp_ns, frame_id, labelled)
        self._part.note(stamp_ns, frame_id)
        return {'points': len(labelled.point_id)}

    def _publish_by_label(self, stamp_ns: int, frame_id: str, labelled: LabelledPoints) -> None:
        """Publish floor and obstacles, each while someone listens."""
        if self._by_label[FLOOR].get_subscription_count():
            floor = points_of_label(stamp_ns, frame_id, labelled, FLOOR)
            self._by_label[FLOOR].publish(floor)
        if self._obstacles_are_wanted():
            self._obstacles = points_of_label(stamp_ns, frame_id, labelled, OBSTACLE)
            self._by_label[OBSTACLE].publish(self._obstacles)

    def _obstacles_are_wanted(self) -> bool:
        return self._by_label[OBSTACLE].get_subscription_count() > 0

    def _keep_alive(self, message: Odometry) -> None:
        """Publish the obstacles again at the time of a tracked frame when they have become old. A
        robot that stands makes no keyframes, and who depends on the points, e.g. Nav2's collision
        monitor, must know that somebody still looks.
        """
        obstacles, stamp_ns = self._obstacles, to_ns(message.header.stamp)
        if obstacles is not None:
            age_s = 1e-9 * (stamp_ns - to_ns(obstacles.header.stamp))
            if not 0 <= age_s < KEEP_ALIVE_S:
                obstacles.header.stamp = message.header.stamp
                self._by_label[OBSTACLE].publish(obstacles)


def main() -> None:
    """Run the node."""
    run_node(CloudLabellingNode)


if __name__ == '__main__':
    main()
