"""The shipped drive, played by `ros2 bag play` into the nodes of bag.launch.py: the map grows, tf
leads from the map to the base, and the last map is left in the folder MAP_FOLDER.
"""

import os
import time
import unittest
from pathlib import Path

import launch_testing.actions
import pytest
import rclpy
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from rclpy.time import Time
from tf2_ros import Buffer, TransformListener

import segfloor_ros.apps.simulation
from segfloor_ros.nodes.map_files import save_map
from segfloor_ros.nodes.messages.grids import grid_of
from segfloor_ros.nodes.messages.topics import TOPICS

DRIVE = Path(segfloor_ros.apps.simulation.__file__).parent / 'demo' / 'drive.mcap'
SHARE = Path(get_package_share_directory('segfloor_ros'))
FIRST_MAP_S = 120.0
QUIET_S = 15.0
"""Without a new map for so long, the drive is over."""


@pytest.mark.launch_test
def generate_test_description() -> LaunchDescription:
    """Return the launch file under test."""
    arguments = {'bag': str(DRIVE), 'params_file': str(SHARE / 'params' / 'demo.yaml')}
    launch_file = PythonLaunchDescriptionSource(str(SHARE / 'launch_configs' / 'bag.launch.py'))
    nodes = IncludeLaunchDescription(launch_file, launch_arguments=arguments.items())
    return LaunchDescription([nodes, launch_testing.actions.ReadyToTest()])


class TestMap(unittest.TestCase):
    """What the nodes publish while the bag plays."""

    def setUp(self) -> None:
        """Listen to the map and to tf."""
        rclpy.init()
        self.node = rclpy.create_node('bag_test')
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self.node)
        self.maps = []
        topic = TOPICS['map']
        self.node.create_subscription(topic.type, topic.name, self.maps.append, topic.profile)

    def tearDown(self) -> None:
        """Listen no more."""
        self.node.destroy_node()
        rclpy.shutdown()

    def test_the_bag_becomes_a_map(self) -> None:
        """The map grows until the bag ends; tf is complete."""
        self.spin(FIRST_MAP_S, lambda: bool(self.maps))
        self.assertTrue(self.maps, f'no map within {FIRST_MAP_S:g} s')
        count = 0
        while len(self.maps) > count:
            count = len(self.maps)
            self.spin(QUIET_S, lambda seen=count: len(self.maps) > seen)
        self.assertGreater(count, 10)
        self.assertTrue(self.buffer.can_transform('map', 'base_link', Time()))
        folder = Path(os.environ['MAP_FOLDER'])
        folder.mkdir(parents=True, exist_ok=True)
        save_map(grid_of(self.maps[-1]), folder / 'map.yaml')

    def spin(self, patience_s: float, done) -> None:
        """Handle messages until something holds, or for so long."""
        end_s = time.monotonic() + patience_s
        while not done() and time.monotonic() < end_s:
            rclpy.spin_once(self.node, timeout_sec=0.1)
