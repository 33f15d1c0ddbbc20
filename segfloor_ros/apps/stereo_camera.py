"""The program of the node `stereo_camera`: it plays what the readers of recordings can open."""

from __future__ import annotations

from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.recordings.ros_bag import use_rosbag2_py
from segfloor_ros.nodes.shared.running import run_node
from segfloor_ros.nodes.stereo_camera import StereoCameraNode


def make_stereo_camera() -> StereoCameraNode:
    """Make the node."""
    use_rosbag2_py()
    return StereoCameraNode(open_source)


def main() -> None:
    """Run the node."""
    run_node(make_stereo_camera)


if __name__ == '__main__':
    main()
