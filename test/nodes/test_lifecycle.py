"""The states of the nodes, driven over DDS as a lifecycle manager does."""

import numpy as np
import pytest
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from node_makers import MAKERS
from node_messages import FEATURES, MASK, POINTS, STAMP_NS, cloud_messages, grid_messages, publish
from std_srvs.srv import SetBool
from stereo_drive import room_drive, write_kitti

from segfloor_ros.apps.stereo_camera import make_stereo_camera
from segfloor_ros.core.cloud import CloudLabelling, CloudLabellingSettings
from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.messages.points import labelled_arrays
from segfloor_ros.nodes.messages.topics import NODES, published_by, subscribed_by, to_ns
from segfloor_ros.nodes.occupancy_grid import OccupancyGridNode

MANAGED = ('-p', 'autostart:=false')


def state(graph, node: str) -> int:
    return graph.call(GetState, f'{node}/get_state', GetState.Request()).current_state.id


def change(graph, node: str, transition: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=transition))
    return graph.call(ChangeState, f'{node}/change_state', request).success


def topics(made) -> tuple[set[str], set[str]]:
    """Return the package's topics that a node publishes and subscribes to."""
    name = made.get_name()
    published = {t for t, _ in made.get_publisher_names_and_types_by_node(name, '/')}
    subscribed = {t for t, _ in made.get_subscriber_names_and_types_by_node(name, '/')}
    mine = {f'/{topic.name}' for topic in published_by(name)}
    inputs = {f'/{topic.name}' for topic in subscribed_by(name)}
    return published & mine, subscribed & inputs


@pytest.mark.parametrize('node', NODES)
def test_a_manager_takes_a_node_through_its_states(make_graph, tmp_path, node) -> None:
    drive = write_kitti(tmp_path / 'drive', room_drive(1)[0])
    source = ('-p', f'input:={drive}') if node == 'stereo_camera' else ()
    graph = make_graph(*MANAGED, *source)
    made = graph.add(MAKERS[node]())
    outputs = {f'/{topic.name}' for topic in published_by(node)}
    assert state(graph, node) == State.PRIMARY_STATE_UNCONFIGURED
    assert topics(made) == (set(), set())
    for _ in range(2):
        assert change(graph, node, Transition.TRANSITION_CONFIGURE)
        assert state(graph, node) == State.PRIMARY_STATE_INACTIVE
        assert topics(made) == (outputs, set())
        for _ in range(2):
            assert change(graph, node, Transition.TRANSITION_ACTIVATE)
            assert state(graph, node) == State.PRIMARY_STATE_ACTIVE
            assert bool(topics(made)[1]) is (node != 'stereo_camera')
            assert change(graph, node, Transition.TRANSITION_DEACTIVATE)
            assert topics(made) == (outputs, set())
        assert change(graph, node, Transition.TRANSITION_CLEANUP)
        assert state(graph, node) == State.PRIMARY_STATE_UNCONFIGURED
        assert topics(made) == (set(), set())
    assert change(graph, node, Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
    assert state(graph, node) == State.PRIMARY_STATE_FINALIZED


@pytest.mark.parametrize('node', NODES[1:])
def test_without_a_manager_a_node_is_active(make_graph, node) -> None:
    graph = make_graph()
    graph.add(MAKERS[node]())
    assert state(graph, node) == State.PRIMARY_STATE_ACTIVE
    assert change(graph, node, Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert state(graph, node) == State.PRIMARY_STATE_FINALIZED


def test_an_impossible_transition_is_refused_and_the_node_lives(make_graph) -> None:
    graph = make_graph(*MANAGED)
    graph.add(CloudLabellingNode())
    assert not change(graph, 'cloud_labelling', Transition.TRANSITION_ACTIVATE)
    assert state(graph, 'cloud_labelling') == State.PRIMARY_STATE_UNCONFIGURED
    assert change(graph, 'cloud_labelling', Transition.TRANSITION_CONFIGURE)


def test_a_camera_without_recording_stays_unconfigured(make_graph) -> None:
    graph = make_graph(*MANAGED, '-p', 'input:=/nowhere')
    graph.add(make_stereo_camera())
    assert not change(graph, 'stereo_camera', Transition.TRANSITION_CONFIGURE)
    assert state(graph, 'stereo_camera') == State.PRIMARY_STATE_UNCONFIGURED


def test_a_deactivated_node_keeps_its_map_and_a_cleaned_up_one_does_not(make_graph) -> None:
    """The label of a point is decided by all its looks, so a second look tells what was kept."""
    graph = make_graph(*MANAGED)
    labelled = graph.collect('labelled_points')
    graph.add(CloudLabellingNode())
    assert change(graph, 'cloud_labelling', Transition.TRANSITION_CONFIGURE)
    assert change(graph, 'cloud_labelling', Transition.TRANSITION_ACTIVATE)
    publishers = publish(graph, cloud_messages(STAMP_NS))
    graph.until(lambda: len(labelled) == 1, 'the first keyframe')
    assert change(graph, 'cloud_labelling', Transition.TRANSITION_DEACTIVATE)
    graph.until(lambda: not any(p.get_subscription_count() for p in publishers.values()), 'silence')
    assert change(graph, 'cloud_labelling', Transition.TRANSITION_ACTIVATE)
    publish(graph, cloud_messages(STAMP_NS + 1), publishers)
    graph.until(lambda: len(labelled) == 2, 'the second keyframe')
    assert change(graph, 'cloud_labelling', Transition.TRANSITION_DEACTIVATE)
    assert change(graph, 'cloud_labelling', Transition.TRANSITION_CLEANUP)
    assert change(graph, 'cloud_labelling', Transition.TRANSITION_CONFIGURE)
    assert change(graph, 'cloud_labelling', Transition.TRANSITION_ACTIVATE)
    publish(graph, cloud_messages(STAMP_NS + 2), publishers)
    graph.until(lambda: len(labelled) == 3, 'the third keyframe')
    stage = CloudLabelling(CloudLabellingSettings())
    once, twice = (stage.update(POINTS, FEATURES, MASK, np.eye(4)).confidence for _ in range(2))
    assert not np.array_equal(once, twice)
    found = [labelled_arrays(message, '').confidence for message in labelled]
    for confidence, expected in zip(found, (once, twice, once), strict=True):
        np.testing.assert_array_equal(confidence, expected)


def test_a_node_that_was_cleaned_up_in_a_pause_does_not_begin_paused(make_graph) -> None:
    graph = make_graph(*MANAGED)
    labelled = graph.collect('labelled_points')
    graph.add(CloudLabellingNode())
    begin = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE
    end = Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP
    for transition in begin:
        assert change(graph, 'cloud_labelling', transition)
    assert graph.call(SetBool, 'cloud_labelling/pause', SetBool.Request(data=True)).success
    for transition in (*end, *begin):
        assert change(graph, 'cloud_labelling', transition)
    publish(graph, cloud_messages(STAMP_NS))
    graph.until(lambda: labelled, 'the first keyframe')


def test_the_latched_map_is_there_until_cleanup(make_graph) -> None:
    graph = make_graph()
    graph.add(OccupancyGridNode())
    publish(graph, grid_messages(STAMP_NS))
    graph.until(lambda: graph.reports('occupancy_grid'), 'the update')
    assert change(graph, 'occupancy_grid', Transition.TRANSITION_DEACTIVATE)
    late = graph.collect('map')
    graph.until(lambda: late, 'the map of an inactive node')
    assert to_ns(late[0].header.stamp) == STAMP_NS
    assert change(graph, 'occupancy_grid', Transition.TRANSITION_CLEANUP)
    graph.until(lambda: not graph.tester.count_publishers('map'), 'the end of the topic')


def test_a_paused_node_gets_nothing_and_goes_on(make_graph) -> None:
    graph = make_graph()
    labelled = graph.collect('labelled_points')
    made = graph.add(CloudLabellingNode())
    assert graph.call(SetBool, 'cloud_labelling/pause', SetBool.Request(data=True)).success
    assert topics(made)[1] == set()
    assert state(graph, 'cloud_labelling') == State.PRIMARY_STATE_ACTIVE
    answer = graph.call(SetBool, 'cloud_labelling/pause', SetBool.Request(data=False))
    assert (answer.success, answer.message) == (True, 'running')
    publish(graph, cloud_messages(STAMP_NS))
    graph.until(lambda: labelled, 'the keyframe after the pause')
