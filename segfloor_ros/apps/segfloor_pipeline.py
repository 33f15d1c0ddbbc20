"""The five nodes in one program: same names, topics, services and parameters.

SLAM has a process of its own, forked, so that nothing else takes Python's lock from tracking. The
camera is among the nodes where `input` names a recording or a device.
"""

from __future__ import annotations

from rclpy.node import Node

from segfloor_ros.apps.stereo_camera import make_stereo_camera
from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.floor_segmentation import FloorSegmentationNode
from segfloor_ros.nodes.messages.topics import CAMERA
from segfloor_ros.nodes.occupancy_grid import OccupancyGridNode
from segfloor_ros.nodes.shared.running import run_nodes
from segfloor_ros.nodes.stereo_slam import StereoSlamNode

BEHIND = (FloorSegmentationNode, CloudLabellingNode, OccupancyGridNode)


def make_slam() -> list[Node]:
    """Make the node that tracks and maps."""
    return [StereoSlamNode()]


def make_others() -> list[Node]:
    """Make the other nodes of the pipeline."""
    nodes: list[Node] = [make_stereo_camera()] if _has_input() else []
    return [*nodes, *(make() for make in BEHIND)]


def _has_input() -> bool:
    """Whether the parameters of the camera name a recording or a device."""
    probe = Node(CAMERA, automatically_declare_parameters_from_overrides=True)
    try:
        return bool(probe.get_parameter_or('input').value)
    finally:
        probe.destroy_node()


def main() -> None:
    """Run the nodes."""
    run_nodes(make_slam, make_others)


if __name__ == '__main__':
    main()
