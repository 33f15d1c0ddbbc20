"""Nodes receive images only while somebody needs what they make of them; time may stand still."""

import pytest
from node_messages import STAMP_NS, grid_messages, publish

from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.floor_segmentation import FloorSegmentationNode
from segfloor_ros.nodes.occupancy_grid import OccupancyGridNode
from segfloor_ros.nodes.shared import reporter as connections
from segfloor_ros.nodes.stereo_slam import StereoSlamNode


@pytest.mark.parametrize(
    ('make', 'received', 'made'),
    [
        (StereoSlamNode, 'left/image_raw', 'odometry'),
        (FloorSegmentationNode, 'keyframe/left/image_rect', 'keyframe/floor_mask'),
        (CloudLabellingNode, 'map_points', 'obstacle_points'),
    ],
)
def test_without_listeners_nothing_is_received(
    make_graph, monkeypatch, make, received, made
) -> None:
    monkeypatch.setattr(connections, 'LASTS_S', 1.0)
    graph = make_graph()
    graph.be_deaf()
    node = graph.add(make())
    graph.until(lambda: not node.count_subscribers(received), 'the end of the subscription')
    assert node.states.in_words == 'idle'
    graph.collect(made)
    graph.until(lambda: node.count_subscribers(received), 'the subscription')
    assert node.states.in_words == 'active'


def test_the_grid_maps_whether_anybody_listens_or_not(make_graph) -> None:
    graph = make_graph()
    graph.be_deaf()
    node = graph.add(OccupancyGridNode())
    publish(graph, grid_messages(STAMP_NS))
    late = graph.collect('map')
    graph.until(lambda: late, 'the map')
    assert node.states.in_words == 'active'


def test_while_the_time_of_a_recording_stands_still_status_and_map_come(make_graph) -> None:
    """A player that has ended publishes no clock any more; the last map is due all the same."""
    graph = make_graph('-p', 'use_sim_time:=true', '-p', 'publish_period_s:=0.3')
    maps = graph.collect('map')
    graph.add(OccupancyGridNode())
    publishers = publish(graph, grid_messages(STAMP_NS))
    graph.until(lambda: maps, 'the first map')
    second = grid_messages(STAMP_NS + 1)
    publish(graph, second, publishers)
    graph.until(lambda: len(maps) == 2, 'the second map')
    assert graph.reports_any('occupancy_grid')
