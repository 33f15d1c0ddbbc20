"""About where the robot is, as people tell it in RViz: for the node `stereo_slam`."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped

from segfloor_ros.geometry import Array
from segfloor_ros.messages.poses import pose_array
from segfloor_ros.node_settings import StereoSlamNodeSettings
from segfloor_ros.nodes.stage_node import AnyStageNode
from segfloor_ros.slam.stereo_slam import StereoSlam

TOPIC = 'initialpose'
SIGMAS = 3.0
LEAST_SIGMA_M, LEAST_SIGMA_RAD = 0.5, 0.26
"""Nobody points more exactly than RViz says by itself: half a metre and 15 degrees."""


class InitialPose:
    """Narrows the search of the camera in a known map to the surroundings of a pose."""

    def __init__(self, node: AnyStageNode, own: StereoSlamNodeSettings) -> None:
        self._node = node
        self._map_frame = own.map_frame
        self.reset()
        node.inputs.subscribe(TOPIC, self._take)

    def reset(self) -> None:
        """Know no pose."""
        self._given: tuple[Array, float, float] | None = None

    def apply(self, slam: StereoSlam) -> None:
        """Have SLAM look around a pose that was given since the last call, once it has a map."""
        if self._given is not None and slam.mount is not None and slam.map.keyframes:
            slam.search_near(*self._given)
            self._given = None

    def _take(self, message: PoseWithCovarianceStamped) -> None:
        if message.header.frame_id not in ('', self._map_frame):
            self._node.reporter.warn(
                f'{TOPIC} is in frame {message.header.frame_id}; give it in {self._map_frame}'
            )
            return
        T_map_base = pose_array(message.pose.pose)
        sigma = np.sqrt(np.maximum(np.diag(np.reshape(message.pose.covariance, (6, 6))), 0.0))
        reach_m = SIGMAS * max(float(sigma[:3].max()), LEAST_SIGMA_M)
        reach_rad = SIGMAS * max(float(sigma[3:].max()), LEAST_SIGMA_RAD)
        self._given = T_map_base, reach_m, reach_rad
        x, y = T_map_base[:2, 3].tolist()
        self._node.get_logger().info(f'looks within {reach_m:.1f} m around x {x:.2f}, y {y:.2f}')
