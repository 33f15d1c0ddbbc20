"""The five nodes in one process: same names, topics, services and parameters.

The camera is among them where `input` names a recording or a device.
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

STAGES = (StereoSlamNode, FloorSegmentationNode, CloudLabellingNode, OccupancyGridNode)


def make_nodes() -> list[Node]:
    """Make the nodes of the pipeline."""
    nodes: list[Node] = [make_stereo_camera()] if _has_input() else []
    return [*nodes, *(make() for make in STAGES)]


def _has_input() -> bool:
    """Whether the parameters of the camera name a recording or a device."""
    probe = Node(CAMERA, automatically_declare_parameters_from_overrides=True)
    try:
        return bool(probe.get_parameter_or('input').value)
    finally:
        probe.destroy_node()


def main() -> None:
    """Run the nodes."""
    run_nodes(make_nodes)


if __name__ == '__main__':
    main()
