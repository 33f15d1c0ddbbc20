"""The five nodes by name."""

from segfloor_ros.messages.topics import NODES
from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.floor_segmentation import FloorSegmentationNode
from segfloor_ros.nodes.occupancy_grid import OccupancyGridNode
from segfloor_ros.nodes.stereo_camera import StereoCameraNode
from segfloor_ros.nodes.stereo_slam import StereoSlamNode

MAKERS = dict(
    zip(
        NODES,
        (
            StereoCameraNode,
            StereoSlamNode,
            FloorSegmentationNode,
            CloudLabellingNode,
            OccupancyGridNode,
        ),
        strict=True,
    )
)
