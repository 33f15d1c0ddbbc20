"""Node `cloud_labelling`: sparse map, features and floor mask in, labelled points out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import parameter_value_to_python
from rclpy.task import Future

from segfloor_ros.core.cloud import CloudLabelling
from segfloor_ros.core.contracts import POINT_FLOOR, LabelledPoints, SparseCloud
from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.core.settings import ROBOT_PARAMETERS, RobotSettings
from segfloor_ros.nodes.messages import points
from segfloor_ros.nodes.messages.images import grey8_image
from segfloor_ros.nodes.messages.poses import pose_array
from segfloor_ros.nodes.messages.topics import FRESH_S, to_ns
from segfloor_ros.nodes.settings.cloud import CloudLabellingNodeSettings
from segfloor_ros.nodes.shared.keyframes import KeyframeJoin
from segfloor_ros.nodes.shared.map_parts import MapPart
from segfloor_ros.nodes.shared.running import run_node
from segfloor_ros.nodes.shared.stage_node import AnyStageNode, StageNode

MAP_POINTS, FEATURES = 'map_points', 'keyframe/features'

POSE, MASK = 'keyframe/odometry', 'keyframe/floor_mask'


class RobotCheck:
    """Asks a node for the parameters of the robot and compares them with those of this one."""

    def __init__(self, node: AnyStageNode, other: str) -> None:
        self._node, self._other = node, other
        client = node.create_client(GetParameters, f'{other}/get_parameters')
        self._client = client
        node.outputs.at_clean_up(lambda: node.destroy_client(client))
        self._asked: Future | None = None
        self._theirs: dict[str, Any] = {}

    def difference(self, ours: RobotSettings) -> str | None:
        """Return in words how the robots differ, as of the last answer, and ask anew."""
        if self._asked is not None and self._asked.done():
            values = map(parameter_value_to_python, self._asked.result().values)
            self._theirs = dict(zip(ROBOT_PARAMETERS, values, strict=False))
            self._asked = None
        if self._asked is None and self._client.service_is_ready():
            request = GetParameters.Request(names=ROBOT_PARAMETERS)
            self._asked = self._client.call_async(request)
        parts = [
            f'{name} is {value:g} here and {self._theirs[name]:g} in {self._other}'
            for name, value in ours.robot.items()
            if self._theirs.get(name, value) != value
        ]
        if not parts:
            return None
        return '; '.join(parts) + ': there is one robot, set it under /** in the parameter file'


class CloudLabellingNode(StageNode[CloudLabellingNodeSettings]):
    """Labels the sparse map at every keyframe."""

    works_on_demand = True

    settings_type = CloudLabellingNodeSettings

    def set_up(self) -> None:
        """Make the topics."""
        self._robot_check = RobotCheck(self, 'floor_segmentation')
        keyframes = KeyframeJoin(self, (MAP_POINTS, FEATURES, POSE, MASK), self._label)
        self._part = MapPart(
            self, keyframes, 'cloud', lambda: self._stage.to_arrays(), self._restore
        )
        self.inputs.subscribe('odometry', self._keep_alive, is_wanted=self._obstacles_are_wanted)

    def reset_stage(self) -> None:
        """Begin without points."""
        self._part.reset()
        self._stage = CloudLabelling(self.settings)
        self._newest: tuple[str, LabelledPoints] | None = None
        self._told_ns = self._tracked_ns = 0
        self._listeners = 0

    def _restore(self, saved: MapFile) -> None:
        """Go on with the labels of a map, and publish its obstacles where they are known."""
        self._stage.from_arrays(saved.parts['cloud'])
        points = saved.parts.get('points')
        if points is not None:
            cloud = SparseCloud(points['point_id'], points['xyz_map'])
            labelled, at = self._stage.labelled(cloud), (self._part.last_ns, self._part.frame_id)
            self._publish_by_label(*at, labelled)

    def find_problems(self) -> None:
        """Report when the floor is segmented for another robot."""
        difference = self._robot_check.difference(self.settings)
        if difference is not None:
            self.reporter.diagnose('robot', difference)

    def on_settings_changed(self) -> None:
        """Label the next keyframe with the new settings."""
        self._stage.settings = self.settings

    def _label(self, stamp_ns: int, parts: Mapping[str, Any]) -> dict[str, Any]:
        cloud = points.sparse_cloud_arrays(parts[MAP_POINTS], MAP_POINTS)
        features = points.features_arrays(parts[FEATURES], FEATURES)
        mask = grey8_image(parts[MASK], MASK)
        T_map_base = pose_array(parts[POSE].pose.pose)
        labelled = self._stage.update(cloud, features, mask, T_map_base)
        frame_id = parts[MAP_POINTS].header.frame_id
        message = points.labelled_message(stamp_ns, frame_id, labelled)
        self.outputs.publish('labelled_points', message)
        self._publish_by_label(stamp_ns, frame_id, labelled)
        self._part.note(stamp_ns, frame_id)
        return {'points': len(labelled.point_id)}

    def _publish_by_label(self, stamp_ns: int, frame_id: str, labelled: LabelledPoints) -> None:
        """Publish floor and obstacles, each while someone listens."""
        if self.outputs.listeners('floor_points'):
            rows = np.flatnonzero(labelled.label == POINT_FLOOR)
            floor = points.points_at(stamp_ns, frame_id, labelled, rows)
            self.outputs.publish('floor_points', floor)
        self._newest, self._listeners = (frame_id, labelled), 0
        self._publish_obstacles(stamp_ns)
        self._told_ns = max(stamp_ns, self._tracked_ns)

    def _obstacles_are_wanted(self) -> bool:
        return self.outputs.listeners('obstacle_points') > 0

    def _keep_alive(self, message: Odometry) -> None:
        """Publish that nothing is new at the time of a tracked frame when the last points have
        become old. A robot that stands makes no keyframes, and who depends on the points must know
        that somebody still looks. The points themselves are repeated for who has begun to listen,
        and no one else: who was there may have gone.
        """
        self._tracked_ns = to_ns(message.header.stamp)
        if not 0 <= 1e-9 * (self._tracked_ns - self._told_ns) < FRESH_S:
            self._publish_obstacles(self._tracked_ns)
            self._told_ns = self._tracked_ns

    def _publish_obstacles(self, stamp_ns: int) -> None:
        """Publish the obstacles of the newest keyframe, or of a loaded map, where somebody has
        begun to listen since they were published last, else that there are none.
        """
        before, self._listeners = self._listeners, self.outputs.listeners('obstacle_points')
        if self._newest is None or not self._listeners:
            return
        frame_id, labelled = self._newest
        rows = self._stage.standing(labelled) if self._listeners > before else np.zeros(0, np.intp)
        message = points.points_at(stamp_ns, frame_id, labelled, rows)
        self.outputs.publish('obstacle_points', message)


def main() -> None:
    """Run the node."""
    run_node(CloudLabellingNode)


if __name__ == '__main__':
    main()
