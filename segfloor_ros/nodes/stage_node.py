"""What the five nodes have in common: parameters, topics by name, status, and a clean end."""

from __future__ import annotations

import logging
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, TypeVar

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from segfloor_ros.errors import SegfloorError
from segfloor_ros.memory import rss_mb
from segfloor_ros.messages.diagnostics import CONNECTIONS, Level, Status, status_message
from segfloor_ros.messages.headers import to_ns
from segfloor_ros.messages.join import StampJoiner
from segfloor_ros.messages.map_life import MapLife, PathHead, path_head
from segfloor_ros.messages.topics import DIAGNOSTICS, TOPICS
from segfloor_ros.node_settings import NodeSettings
from segfloor_ros.nodes.hand_over import HandOver, LocalPublisher
from segfloor_ros.nodes.kept_state import KeptState
from segfloor_ros.nodes.managed_node import ManagedNode
from segfloor_ros.nodes.parameters import NodeParameters
from segfloor_ros.settings import StageSettings

Stage = TypeVar('Stage', bound=StageSettings)
Own = TypeVar('Own', bound=NodeSettings)

CONNECTION_CHECK_S = 0.1
HEARTBEAT_S = 1.0
PATH = 'keyframe/path'
REPEAT_FAULT_S = 5.0


class StageNode(ManagedNode, Generic[Stage, Own]):
    """A node around one stage. Subclasses create the topics in `set_up`, the stage in `start_anew`,
    and hand messages to the stage.

    Callbacks run one after the other; the depth of the subscriptions is the queue. A fault of a
    message or of the stage is one line in the log and one status; the node lives on.
    """

    def __init__(
        self, stage: type[Stage], own: type[Own], hand_over: HandOver | None = None
    ) -> None:
        super().__init__(stage.stage_name(), hand_over)
        self.parameters: NodeParameters[Stage, Own] = NodeParameters(self, stage(), own())
        self.add_on_set_parameters_callback(self._change_parameters)
        self._diagnostics = self.create_publisher(
            DIAGNOSTICS.type, DIAGNOSTICS.name, DIAGNOSTICS.profile
        )
        self._outputs: dict[str, Publisher | LocalPublisher] = {}
        self._joiners: list[StampJoiner] = []
        self._life = MapLife()
        resume_within_s = self.parameters.own.resume_within_s
        self._kept_state = KeptState(self.get_fully_qualified_name(), resume_within_s)
        self._connections: dict[str, str] = {}
        self._last_heartbeat_s = 0.0
        self._faults: dict[str, float] = {}
        self._said: dict[str, float] = {}
        self.create_timer(CONNECTION_CHECK_S, self._report_connections)
        if self.parameters.own.autostart:
            self.start()

    def on_settings_changed(self) -> None:
        """Take over changed live parameters; the next message is processed with them."""

    def on_inputs_closed(self) -> None:
        """Give up the sets that are not complete."""
        for joiner in self._joiners:
            joiner.clear()

    def reset(self) -> None:
        """Drop the map, and all that waits."""
        for joiner in self._joiners:
            joiner.clear()
        self._life = MapLife()
        super().reset()

    def begin_anew(self, reason: str) -> None:
        """Drop the map, and what was kept of it."""
        self._kept_state.remove()
        super().begin_anew(reason)

    def take_up(self) -> None:
        """Go on with what a killed node of this name has left, where the node keeps something."""
        kept = self._kept_state.take()
        if kept is not None:
            self._life, state = kept
            self.resume(state)

    def keep(self, state: Any, always: bool = False) -> None:
        """Keep a state for `resume` of a later node, should this one be killed."""
        self._kept_state.save((self._life, state), always)

    def resume(self, state: Any) -> None:
        """Go on with a state that a killed node has given to `keep`."""

    def forget(self) -> None:
        """Give up what waits; the outputs go with the topics."""
        self._kept_state.remove()
        self._joiners.clear()
        self._outputs.clear()
        self._life = MapLife()

    def output(self, name: str) -> Publisher | LocalPublisher:
        """Create the publisher of a topic of `TOPICS`. It lives until the node is cleaned up."""
        topic = TOPICS[name]
        self._outputs[name] = self.keep_publisher(topic.type, name, topic.profile)
        return self._outputs[name]

    def listen(
        self,
        name: str,
        callback: Callable[[Any], None],
        profile: QoSProfile | None = None,
        raw: bool = False,
    ) -> None:
        """Subscribe to a topic of `TOPICS` while the node is active; faults in the callback are
        logged with the topic's name. raw: hand on the serialized message.
        """
        topic = TOPICS[name]

        def guarded(message: Any) -> None:
            try:
                callback(message)
            except Exception as error:
                self.say_fault(name, error)

        self.subscribe_while_open(topic.type, name, guarded, profile or topic.profile, raw)

    def joiner(self, parts: Sequence[str], **limits: Any) -> StampJoiner:
        """Return a joiner that is emptied when the inputs close."""
        self._joiners.append(StampJoiner(parts, **limits))
        return self._joiners[-1]

    def join(self, parts: Sequence[str], process: Callable[[int, dict[str, Any]], None]) -> None:
        """Subscribe to topics whose messages belong to one keyframe; `process` gets the stamp and
        the messages by topic once all with one stamp have arrived. Those that remain alone are
        reported. Where SLAM publishes `keyframe/path`, it tells when a new map begins: the node
        then begins anew. The path is handed on serialized.
        """
        joiner = self.joiner(parts, optional={PATH: lambda: self.is_published(PATH)})

        def take(part: str, stamp_ns: int, message: Any) -> None:
            complete = joiner.add(part, stamp_ns, message)
            self.say_dropped(joiner)
            if complete is None:
                return
            if PATH in complete:
                self._follow_life(path_head(complete[PATH], PATH))
            process(stamp_ns, complete)

        def listen(part: str) -> None:
            self.listen(part, lambda message: take(part, to_ns(message.header.stamp), message))

        for part in parts:
            if part != PATH:
                listen(part)
        self.listen(PATH, lambda data: take(PATH, path_head(data, PATH).stamp_ns, data), raw=True)

    def on_new_map(self, first_stamp_ns: int) -> None:
        """Note that SLAM's map now begins at this stamp."""

    def _follow_life(self, head: PathHead) -> None:
        if self._life.is_new(head):
            self.begin_anew('stereo_slam has begun a new map')
            self.on_new_map(head.first_stamp_ns)

    def work(self, stamp_ns: int, step: Callable[[], Mapping[str, Any]]) -> None:
        """Run the stage's step for one stamp and report how it went, with the values it returns."""
        start = time.perf_counter()
        try:
            values = step()
        except Exception as error:
            self.say_fault(f'stamp {stamp_ns}', error)
            self.report(stamp_ns, Level.ERROR, one_line(error))
            return
        milliseconds = 1e3 * (time.perf_counter() - start)
        self.report(stamp_ns, Level.OK, 'running', processing_ms=f'{milliseconds:.3f}', **values)

    def report(self, stamp_ns: int, level: Level, message: str, **values: Any) -> None:
        """Publish a status about one stamp."""
        self.publish_status('', stamp_ns, level, message, {**values, 'rss_mb': f'{rss_mb():.2f}'})

    def publish_status(
        self, kind: str, stamp_ns: int, level: Level, message: str, values: Mapping[str, Any]
    ) -> None:
        """Publish a status of a kind of its own."""
        name = self.get_fully_qualified_name() + (f': {kind}' if kind else '')
        texts = {key: str(value) for key, value in values.items()}
        self._diagnostics.publish(status_message(Status(stamp_ns, name, level, message, texts)))

    def say_dropped(self, joiner: StampJoiner) -> None:
        """Warn about sets that were given up, naming the topics of the missing parts."""
        for dropped in joiner.take_dropped():
            names = ', '.join(dropped.missing)
            counts = {name: self.publisher_count(name) for name in joiner.parts}
            crowded = ''.join(
                f'; {name} has {count} publishers, stop or remap one'
                for name, count in counts.items()
                if count > 1
            )
            text = f'no message on {names} with stamp {dropped.stamp_ns}; dropped{crowded}'
            self.say(text, about=names + crowded)
            self.report(dropped.stamp_ns, Level.ERROR, text)

    def say_fault(self, where: str, error: Exception) -> None:
        """Log a fault in one line, at most every few seconds; the traceback of an unexpected
        one goes to the debug log.
        """
        text, now_s = one_line(error), time.monotonic()
        self._faults = {t: s for t, s in self._faults.items() if now_s - s < REPEAT_FAULT_S}
        if text in self._faults:
            return
        self._faults[text] = now_s
        self.get_logger().error(text if text.startswith(where) else f'{where}: {text}')
        if not isinstance(error, SegfloorError):
            self.get_logger().debug(''.join(traceback.format_exception(error)))

    def say(self, text: str, about: str = '') -> None:
        """Warn, at most every few seconds about the same: the text, where nothing else is named."""
        now_s = time.monotonic()
        self._said = {t: s for t, s in self._said.items() if now_s - s < REPEAT_FAULT_S}
        if (about or text) not in self._said:
            self._said[about or text] = now_s
            self.get_logger().warning(text)

    def say_waiting(self, what: str) -> None:
        """Warn that something does not arrive, unless it comes at once."""
        self.get_logger().warning(
            f'waiting for {what}', throttle_duration_sec=REPEAT_FAULT_S, skip_first=True
        )

    def _change_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        result = self.parameters.change(parameters)
        if result.successful:
            self.on_settings_changed()
        return result

    def _report_connections(self) -> None:
        counts = {
            name: str(output.get_subscription_count()) for name, output in self._outputs.items()
        }
        counts[DIAGNOSTICS.name] = str(self._diagnostics.get_subscription_count())
        now = time.monotonic()
        if counts != self._connections or now - self._last_heartbeat_s >= HEARTBEAT_S:
            self._connections, self._last_heartbeat_s = counts, now
            stamp_ns = self.get_clock().now().nanoseconds
            self.publish_status(CONNECTIONS, stamp_ns, Level.OK, 'subscribers by topic', counts)


AnyStageNode = StageNode[Any, Any]


def one_line(error: Exception) -> str:
    """Return an error in one line; unexpected ones with their type."""
    text = ' '.join(str(error).split())
    return text if isinstance(error, SegfloorError) else f'{type(error).__name__}: {text}'


def run_node(make_node: Callable[[], ManagedNode]) -> None:
    """Run a node until it is interrupted (status 0); bad parameters or input end it with one
    line and status 2.
    """
    run_nodes(lambda executor: [make_node()])


def run_nodes(make_nodes: Callable[[Executor], Sequence[ManagedNode]]) -> None:
    """Run nodes in one executor, like `run_node`; the executor comes first, for those who hand
    work to it.
    """
    logging.basicConfig(format='segfloor: %(message)s', level=logging.WARNING)
    status = 0
    nodes: Sequence[ManagedNode] = ()
    try:
        rclpy.init()
        executor = SingleThreadedExecutor()
        nodes = make_nodes(executor)
        for node in nodes:
            executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except SegfloorError as error:
        print(f'segfloor: {error}', file=sys.stderr)
        status = 2
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(status)
