"""What SLAM keeps for the nodes behind it: asked for at their start, sent when it is new."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from node_messages import cloud_messages, publish
from std_srvs.srv import Trigger

from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.messages.points import labelled_arrays
from segfloor_ros.nodes.messages.saved_maps import map_file_message, map_file_of, map_start_message
from segfloor_ros.nodes.messages.topics import KEYFRAMES, MAP_LOADED, MAP_PART, MAP_START, TOPICS

S = 1_000_000_000
BEGUN = 7


class Keeper:
    """The tester in place of SLAM: it sends keyframes of a map and answers what it is asked."""

    def __init__(self, graph) -> None:
        self.graph = graph
        self._said = graph.collect(MAP_PART)
        self.labelled = graph.collect('labelled_points')
        self._answers = graph.publisher(MAP_LOADED)
        self._keyframes: dict[str, Any] = {}

    @property
    def parts(self) -> list[MapFile]:
        """What the node has said so far."""
        return [map_file_of(message, MAP_PART) for message in self._said]

    def asked(self, count: int) -> int:
        """Wait until the node has asked so often; returns what its last question is known by."""
        asking = lambda: [p for p in self.parts if p.header['start_ns'] is None]  # noqa: E731
        self.graph.until(lambda: len(asking()) == count, f'question {count}')
        return asking()[-1].header['asked']

    def answer(self, asked: int, part: MapFile | None = None, start_ns: int = BEGUN) -> None:
        last_ns = {} if part is None else {'cloud': part.header['last_ns']}
        header = {'start_ns': start_ns, 'frame_id': 'map', 'last_ns': last_ns}
        saved = MapFile(header | {'asked': {'cloud': asked}}, {} if part is None else part.parts)
        self._answers.publish(map_file_message(saved))

    def send(self, number: int, start_ns: int = BEGUN) -> None:
        start = {MAP_START: map_start_message(number * S, 'map', start_ns)}
        publish(self.graph, {**cloud_messages(number * S), **start}, self._keyframes)

    def part_of(self, number: int) -> MapFile:
        """Wait for the part of the node with a keyframe in it."""

        def found() -> list[MapFile]:
            return [p for p in self.parts if p.header['last_ns'] == number * S]

        self.graph.until(found, f'the part with keyframe {number}')
        return found()[-1]

    def confidence(self, count: int) -> np.ndarray:
        """Wait for so many labelled clouds; returns how sure the last one is."""
        self.graph.until(lambda: len(self.labelled) == count, f'cloud {count}')
        return labelled_arrays(self.labelled[-1], '').confidence


@pytest.fixture
def keeper(make_graph) -> Keeper:
    return Keeper(make_graph())


def test_a_node_begins_when_it_is_answered_and_sends_what_is_new(keeper) -> None:
    keeper.graph.add(CloudLabellingNode())
    asked = keeper.asked(1)
    keeper.answer(asked - 1)  # to a node of this name that was killed before
    keeper.send(1)
    assert not keeper.graph.comes(lambda: keeper.labelled, 0.5)
    keeper.answer(asked)
    for number in (1, 2):
        if number > 1:
            keeper.send(number)
        keeper.confidence(number)
    part = keeper.part_of(2)  # sent a moment later where the one before has only just been sent
    assert part.header['start_ns'] == BEGUN
    assert part.parts['cloud']['looks'].max() == 2


def test_a_node_that_is_started_again_has_lost_nothing(keeper) -> None:
    """It gets back its part, takes up the keyframes since, and leaves those that are in it."""
    node = keeper.graph.add(CloudLabellingNode())
    keeper.answer(keeper.asked(1))
    for number in (1, 2, 3):
        keeper.send(number)
        keeper.confidence(number)
    part, without_break = keeper.part_of(1), keeper.confidence(3)
    keeper.graph.remove(node)
    keeper.labelled.clear()
    keeper.graph.add(CloudLabellingNode())
    keeper.answer(keeper.asked(2), part)
    np.testing.assert_array_equal(keeper.confidence(2), without_break)
    assert keeper.part_of(3).parts['cloud']['looks'].max() == 3
    assert not keeper.graph.comes(lambda: len(keeper.labelled) > 2, 0.3)


def test_a_node_is_reset_when_the_keyframes_are_of_another_map(keeper) -> None:
    """It asks for that one, which it does not know."""
    keeper.graph.add(CloudLabellingNode())
    keeper.answer(keeper.asked(1))
    for number in (1, 2):
        keeper.send(number)
        keeper.confidence(number)
    keeper.send(3, start_ns=BEGUN + 1)
    keeper.answer(keeper.asked(2), start_ns=BEGUN + 1)
    keeper.confidence(3)
    first, second, third = (labelled_arrays(m, '').confidence for m in keeper.labelled)
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(first, third)


def test_what_a_reset_has_dropped_does_not_come_back(keeper) -> None:
    node = keeper.graph.add(CloudLabellingNode())
    keeper.answer(keeper.asked(1))
    keeper.send(1)
    keeper.confidence(1)
    keeper.part_of(1)
    assert keeper.graph.call(Trigger, 'cloud_labelling/reset', Trigger.Request()).success
    keeper.graph.until(lambda: not keeper.parts[-1].header['frame_id'], 'an empty part')
    assert keeper.parts[-1].header['start_ns'] == BEGUN and not keeper.parts[-1].parts
    assert node.states.in_words == 'active'
    keeper.send(2)
    keeper.confidence(2)
    assert keeper.part_of(2).parts['cloud']['looks'].max() == 1


def test_publishers_that_keep_nothing_are_heard(make_graph) -> None:
    """A node of another package with the usual profile in place of one of ours."""
    graph = make_graph()
    labelled = graph.collect('labelled_points')
    graph.add(CloudLabellingNode())
    messages = cloud_messages(S)
    publishers = {
        name: graph.tester.create_publisher(TOPICS[name].type, name, KEYFRAMES) for name in messages
    }
    publish(graph, messages, publishers)
    graph.until(lambda: labelled, 'the keyframe')
