"""A camera that must lose nothing, and nodes that lose what they had in their queues."""

import pytest
from stereo_drive import room_drive, write_kitti

from segfloor_ros.apps.stereo_camera import make_stereo_camera
from segfloor_ros.nodes import stereo_camera as pacing
from segfloor_ros.nodes.messages.diagnostics import HEALTH
from segfloor_ros.nodes.messages.topics import FRAME_DONE, TOPICS, make_header, to_ns

INPUTS = tuple(
    f'{side}/{what}' for side in ('left', 'right') for what in ('image_raw', 'camera_info')
)
FRAMES = 10


class Listener:
    """In SLAM's place: it listens, and answers when it is told to."""

    def __init__(self, graph) -> None:
        self._graph = graph
        self.stamps: list[int] = []
        self._frame_done = graph.publisher(FRAME_DONE)
        self._subscriptions: list = []
        self.listen()

    def listen(self) -> None:
        for name in INPUTS:
            take = self._take if name == 'right/image_raw' else lambda message: None
            topic = TOPICS[name]
            made = self._graph.tester.create_subscription(topic.type, name, take, topic.profile)
            self._subscriptions.append(made)

    def turn_away(self) -> None:
        """As a node does that is paused."""
        while self._subscriptions:
            self._graph.tester.destroy_subscription(self._subscriptions.pop())

    def answer(self, stamp_ns: int) -> None:
        self._frame_done.publish(make_header(stamp_ns, ''))

    def _take(self, message) -> None:
        self.stamps.append(to_ns(message.header.stamp))


@pytest.fixture
def play(make_graph, tmp_path):
    """Start a lossless camera in front of a listener."""

    def play():
        drive = write_kitti(tmp_path / 'drive', room_drive(FRAMES)[0])
        graph = make_graph('-p', f'input:={drive}', '-p', 'rate:=0.0')
        listener = Listener(graph)
        graph.add(make_stereo_camera())
        graph.until(lambda: len(listener.stamps) == pacing.MAX_FRAMES_UNDER_WAY, 'the first frames')
        assert not graph.comes(lambda: len(listener.stamps) > pacing.MAX_FRAMES_UNDER_WAY, 0.5)
        return graph, listener

    return play


def test_a_lossless_camera_goes_on_after_what_a_node_has_lost(play, monkeypatch) -> None:
    monkeypatch.setattr(pacing, 'PATIENCE_S', 2.0)
    graph, listener = play()
    sent = len(listener.stamps)
    graph.until(lambda: len(listener.stamps) == 2 * sent, 'the frames after those that were lost')

    def said() -> bool:
        words = f'{sent} frames and 0 keyframes under way have not come to their end'
        return any(words in s.message for s in graph.statuses if s.kind == HEALTH)

    graph.until(said, 'the diagnosis')
    assert len(set(listener.stamps)) == 2 * sent  # it does not send again what was lost


def test_a_lossless_camera_waits_while_nobody_listens_and_loses_nothing_then(play) -> None:
    graph, listener = play()
    sent = len(listener.stamps)
    listener.turn_away()
    camera = next(node for node in graph.nodes if node.get_name() == 'stereo_camera')
    graph.until(lambda: not camera.count_subscribers('left/image_raw'), 'the pause')
    graph.comes(lambda: False, 0.3)
    listener.listen()
    graph.until(lambda: len(listener.stamps) >= sent + 1, 'the first frame after the pause')
    while len(listener.stamps) < FRAMES:
        known = len(listener.stamps)
        listener.answer(listener.stamps[-1])
        graph.until(lambda known=known: len(listener.stamps) > known, 'the next frames')
    assert len(set(listener.stamps)) == FRAMES
