"""What the five nodes have in common: parameters, topics by name, status, and a clean end."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, TypeVar

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile

from segfloor_ros.errors import SegfloorError
from segfloor_ros.messages.diagnostics import Level
from segfloor_ros.messages.headers import to_ns
from segfloor_ros.messages.join import StampJoiner
from segfloor_ros.messages.map_life import MapLife, PathHead, path_head
from segfloor_ros.messages.topics import TOPICS
from segfloor_ros.node_settings import NodeSettings
from segfloor_ros.nodes.hand_over import HandOver
from segfloor_ros.nodes.kept_state import KeptState
from segfloor_ros.nodes.managed_node import ManagedNode
from segfloor_ros.nodes.middleware import prepare_middleware
from segfloor_ros.nodes.parameters import NodeParameters
from segfloor_ros.nodes.reporting_node import PATH, ReportingNode
from segfloor_ros.settings import StageSettings

Stage = TypeVar('Stage', bound=StageSettings)
Own = TypeVar('Own', bound=NodeSettings)

INTERRUPT_HEARD_S = 0.2


class StageNode(ReportingNode, Generic[Stage, Own]):
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
        self._joiners: list[StampJoiner] = []
        self._life = MapLife()
        resume_within_s = self.parameters.own.resume_within_s
        self._kept_state = KeptState(self.get_fully_qualified_name(), resume_within_s)
        if self.parameters.own.autostart:
            self.start()

    def on_settings_changed(self) -> None:
        """Take over changed live parameters; the next message is processed with them."""

    def on_inputs_closed(self) -> None:
        """Give up the sets that are not complete."""
        super().on_inputs_closed()
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
        """Give up what waits."""
        super().forget()
        self._kept_state.remove()
        self._joiners.clear()
        self._life = MapLife()

    def listen(
        self,
        name: str,
        callback: Callable[[Any], None],
        choose_profile: Callable[[], QoSProfile] | None = None,
        raw: bool = False,
    ) -> None:
        """Subscribe to a topic of `TOPICS` while the node is active; faults in the callback are
        logged with the topic's name. raw: hand on the serialized message. choose_profile: asked
        whenever the inputs open.
        """
        topic = TOPICS[name]

        def guarded(message: Any, info: Mapping[str, Any]) -> None:
            self.note_received(topic, None if raw else to_ns(message.header.stamp), info)
            try:
                callback(message)
            except Exception as error:
                self.say_fault(name, error)

        choose = choose_profile or (lambda: topic.profile)
        self.subscribe_while_open(topic.type, name, guarded, choose, raw)

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
            self.report_fault(stamp_ns, error)
            return
        milliseconds = 1e3 * (time.perf_counter() - start)
        self.report_processed(stamp_ns, Level.OK, 'running', milliseconds, **values)

    def _change_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        result = self.parameters.change(parameters)
        if result.successful:
            self.on_settings_changed()
        return result


AnyStageNode = StageNode[Any, Any]


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
        prepare_middleware()
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
    except Exception:
        # An interrupt takes the middleware away under whatever is being done at that moment, and
        # may be heard of a little later than what it broke.
        time.sleep(INTERRUPT_HEARD_S)
        if rclpy.ok():
            raise
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(status)
