"""What the five nodes have in common: states, parameters, and the parts they are made of."""

from __future__ import annotations

import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Sequence
from inspect import isawaitable
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.lifecycle import LifecycleNode, LifecycleState, ManagedEntity, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_srvs.srv import SetBool, Trigger

from segfloor_ros.core.errors import SegfloorError
from segfloor_ros.nodes.messages.diagnostics import HEALTH_PERIOD_S
from segfloor_ros.nodes.messages.topics import TOPICS, Topic, published_by
from segfloor_ros.nodes.settings.shared import NodeSettings
from segfloor_ros.nodes.shared.inputs import CHECK_S, Inputs
from segfloor_ros.nodes.shared.reporter import Connections, Reporter, one_line
from segfloor_ros.nodes.shared.running import NodeParameters

Settings = TypeVar('Settings', bound=NodeSettings)

DONE, REFUSED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class Outputs:
    """What a node offers from when it is configured until it is cleaned up: topics, services."""

    def __init__(self, node: Node, reporter: Reporter) -> None:
        self._node = node
        self._reporter = reporter
        self._steps: list[Callable[[], Any]] = []
        self.publishers: dict[str, Publisher] = {}
        """Those of `TOPICS` by name."""

    def publisher(self, name: str) -> Publisher:
        """Create the publisher of a topic of `TOPICS`."""
        topic = TOPICS[name]
        # What does not connect is reported in words and on /diagnostics.
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        made = self._node.create_publisher(topic.type, name, topic.offered, event_callbacks=quiet)
        self.publishers[name] = made
        self.at_clean_up(lambda: self._node.destroy_publisher(made))
        return made

    def publish(self, name: str, message: Any) -> None:
        """Publish a message on a topic of `TOPICS`."""
        self.publishers[name].publish(message)

    def listeners(self, name: str) -> int:
        """Return how many subscribers a topic of `TOPICS` has."""
        count: int = self.publishers[name].get_subscription_count()
        return count

    def service(self, kind: Any, name: str, answer: Callable[[Any, Any], Any]) -> None:
        """Offer a service whose response has `success` and `message`; what `answer` raises becomes
        the message. answer: may be a coroutine; the node works on while it waits.
        """

        async def answer_always(request: Any, response: Any) -> Any:
            try:
                answered = answer(request, response)
                return await answered if isawaitable(answered) else answered
            except Exception as error:  # whatever it is, the node lives on
                if not isinstance(error, (SegfloorError, OSError)):
                    self._reporter.log_fault(name, error)
                response.success = False
                response.message = str(error) or type(error).__name__
                return response

        group = ReentrantCallbackGroup()
        made = self._node.create_service(kind, name, answer_always, callback_group=group)
        self.at_clean_up(lambda: self._node.destroy_service(made))

    def trigger(self, name: str, work: Callable[[], str | Awaitable[str]]) -> None:
        """Offer a service that does some work and answers with its message, or with why it failed.
        work: may return an awaitable.
        """

        async def answer(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            message = work()
            response.message = message if isinstance(message, str) else await message
            response.success = True
            return response

        self.service(Trigger, name, answer)

    def at_clean_up(self, step: Callable[[], Any]) -> None:
        """Do something when the node is cleaned up; the last one first."""
        self._steps.append(step)

    def clean_up(self) -> None:
        """Offer nothing any more."""
        while self._steps:
            self._steps.pop()()
        self.publishers.clear()


class States(ManagedEntity):
    """The states of a managed node (REP-2002 in rclpy's form), with the services `~/pause` and
    `~/reset`. While the node is active, needed and not paused, its inputs are open.
    """

    def __init__(self, node: AnyStageNode) -> None:
        self._node = node
        self.label = 'unconfigured'
        """The state but for pauses and needs."""
        self._is_paused, self._is_needed = False, True
        self._fault: Exception | None = None
        node.add_managed_entity(self)
        _refuse_impossible_transitions(node)

    @property
    def in_words(self) -> str:
        """The state: unconfigured, inactive, active, paused, idle or finalized."""
        if self.label == 'active' and self._is_paused:
            return 'paused'
        return 'idle' if self.label == 'active' and not self._is_needed else self.label

    def start(self) -> None:
        """Configure and activate the node. Raises what stands in the way."""
        for step in (self._node.trigger_configure, self._node.trigger_activate):
            if step() != DONE:
                assert self._fault is not None
                raise self._fault

    def pause(self, paused: bool) -> None:
        """Close the inputs until further notice, or open them again."""
        self._is_paused = paused
        self._open_or_close(self.label)

    def need(self, is_needed: bool) -> None:
        """Close the inputs of an active node that nobody needs, or open them again."""
        self._is_needed = is_needed
        self._open_or_close(self.label)

    def clean_up(self) -> None:
        """Drop the map, topics and services."""
        self._is_paused = False
        self._open_or_close('inactive')
        self._node.inputs.remove_all()
        self._node.outputs.clean_up()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make topics, services and an empty map."""
        return self._transit(self._configure, 'inactive')

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the inputs."""
        return self._transit(lambda: self._open_or_close('active'), 'active')

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the inputs and keep the map."""
        return self._transit(lambda: self._open_or_close('inactive'), 'inactive')

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drop everything; the node can be configured again."""
        return self._transit(self.clean_up, 'unconfigured')

    on_error = on_cleanup

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drop everything, from any state."""
        return self._transit(self.clean_up, 'finalized')

    def _transit(self, step: Callable[[], None], label: str) -> TransitionCallbackReturn:
        """Take the step of a transition; a fault is logged and the transition refused."""
        try:
            step()
        except Exception as error:
            self._fault, log = error, self._node.get_logger()
            log.error(one_line(error))
            if not isinstance(error, SegfloorError):
                log.debug(''.join(traceback.format_exception(error)))
            return REFUSED
        self.label = label
        return DONE

    def _configure(self) -> None:
        node = self._node
        try:
            node.outputs.service(SetBool, '~/pause', self._answer_pause)
            node.outputs.service(Trigger, '~/reset', self._answer_reset)
            for topic in node.output_topics():
                node.outputs.publisher(topic.name)
            node.set_up()
            node.reset_stage()
        except Exception:
            self.clean_up()
            raise

    def _open_or_close(self, label: str) -> None:
        """Open or close the inputs as a state asks for."""
        node = self._node
        wanted = label == 'active' and self._is_needed and not self._is_paused
        if wanted and not node.inputs.is_open:
            node.inputs.open()
            node.on_inputs_opened()
        elif not wanted and node.inputs.is_open:
            node.inputs.close()
            node.on_inputs_closed()

    def _answer_pause(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        self.pause(bool(request.data))
        response.success, response.message = True, 'paused' if self._is_paused else 'running'
        return response

    def _answer_reset(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        self._node.inputs.give_up_waiting()
        done = self._transit(lambda: self._node.reset('by ~/reset'), self.label)
        response.success = done == DONE
        response.message = 'reset' if response.success else str(self._fault)
        return response


class StageNode(LifecycleNode, ABC, Generic[Settings]):
    """A managed node around one stage.

    Configured, it has its topics and services (`set_up`) and an empty map (`reset_stage`).
    Deactivated, idle or paused it receives nothing and keeps its map; cleaned up it has neither map
    nor topics. Callbacks run one after the other; the depth of the subscriptions is the queue.
    """

    settings_type: type[Settings]
    """Of the node's parameters; the nodes fill it in."""

    works_on_demand = False
    """Whether messages that nobody needs the results of may be missed."""

    def __init__(self) -> None:
        settings = self.settings_type
        super().__init__(
            settings.stage_name(), automatically_declare_parameters_from_overrides=True
        )
        self.parameters = NodeParameters(self, settings(), lambda: self.on_settings_changed())
        self.reporter = Reporter(self)
        self.inputs = Inputs(self, self.reporter)
        self.outputs = Outputs(self, self.reporter)
        self.states = States(self)
        publishers, subscriptions = self.outputs.publishers, self.inputs.subscriptions
        self._connections = Connections(self, self.reporter, publishers, subscriptions)
        self._last_health_s = 0.0
        self.inputs.steady_timer(CHECK_S, self._check)
        if self.settings.autostart:
            self.states.start()

    # What the nodes fill in.

    def output_topics(self) -> Sequence[Topic]:
        """Return the topics that the node publishes whatever its parameters are."""
        return published_by(self.settings.stage_name())

    @abstractmethod
    def set_up(self) -> None:
        """Make the inputs, the services and further topics. Raises SegfloorError when that cannot
        be.
        """

    @abstractmethod
    def reset_stage(self) -> None:
        """Begin with an empty map, first of all after `set_up`. The topics stay."""

    def on_inputs_opened(self) -> None:
        """Prepare for messages, at first and after a pause."""

    def on_inputs_closed(self) -> None:
        """Give up what waits for more messages."""

    def on_settings_changed(self) -> None:
        """Take over changed live parameters; the next message is processed with them."""

    def find_problems(self) -> None:
        """Report what shows over time; called once a second while the inputs are open."""

    def is_needed_otherwise(self) -> bool:
        """Whether somebody needs the node beside the listeners to its topics and its status."""
        return False

    # What they use.

    @property
    def settings(self) -> Settings:
        """The node's parameters as they are now."""
        return self.parameters.settings

    def describe_parameter(self, name: str) -> ParameterDescriptor:
        """Return a descriptor with the type of the value: rclpy notes that of any value tried."""
        described = super().describe_parameter(name)
        described.type = self.get_parameter(name).type_.value
        return described

    def reset(self, reason: str) -> None:
        """Drop the map and begin with an empty one, with one line in the log."""
        self.reset_stage()
        self.get_logger().warning(f'reset: {reason}')

    def destroy_node(self) -> None:
        """End the node and what works for it."""
        self.states.clean_up()
        super().destroy_node()

    def _check(self) -> None:
        """Report connections and health, and look whether the node is needed."""
        connections, now_s = self._connections, time.monotonic()
        always = not self.works_on_demand or self.states.label != 'active'
        self.states.need(connections.are_needed(always or self.is_needed_otherwise()))
        is_due = now_s >= self._last_health_s + HEALTH_PERIOD_S
        connections.report(always=is_due)
        self.inputs.update()
        if is_due:
            self._last_health_s = now_s
            if self.inputs.is_open:
                self.find_problems()
                connections.find_problems()
            self.reporter.publish_health(self.states.in_words)


AnyStageNode = StageNode[Any]


def _refuse_impossible_transitions(node: LifecycleNode) -> None:
    """Let the service `~/change_state` refuse a transition that the present state does not have;
    rclpy's own answer to it raises, which would end the node.
    """
    name = node.resolve_service_name('~/change_state')
    (service,) = (found for found in node.services if found.srv_name == name)
    change_state = service.callback

    def answer(request: Any, response: Any) -> Any:
        try:
            return change_state(request, response)
        except RuntimeError as error:  # rcl's error of a transition that is not registered
            node.get_logger().warning(str(error).partition(', at ')[0])
            response.success = False
            return response

    service.callback = answer
