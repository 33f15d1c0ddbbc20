"""The five nodes by name."""

from segfloor_ros.apps.stereo_camera import make_stereo_camera
from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.floor_segmentation import FloorSegmentationNode
from segfloor_ros.nodes.messages.topics import NODES
from segfloor_ros.nodes.occupancy_grid import OccupancyGridNode
from segfloor_ros.nodes.stereo_slam import StereoSlamNode

MAKERS = dict(
    zip(
        NODES,
        (
            make_stereo_camera,
            StereoSlamNode,
            FloorSegmentationNode,
            CloudLabellingNode,
            OccupancyGridNode,
        ),
        strict=True,
    )
)
