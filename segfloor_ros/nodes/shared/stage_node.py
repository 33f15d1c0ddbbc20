"""What the five nodes have in common: states, parameters, and the parts they are made of."""

from __future__ import annotations

import time
import traceback
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from std_srvs.srv import SetBool, Trigger

from segfloor_ros.configuration import NodeSettings
from segfloor_ros.errors import SegfloorError
from segfloor_ros.map_file import MapFile
from segfloor_ros.messages.diagnostics import HEALTH_PERIOD_S, Level
from segfloor_ros.messages.topics import TOPICS
from segfloor_ros.nodes.shared.inputs import Inputs
from segfloor_ros.nodes.shared.maps import KeptState
from segfloor_ros.nodes.shared.reporter import Connections, Reporter
from segfloor_ros.nodes.shared.running import NodeParameters

Settings = TypeVar('Settings', bound=NodeSettings)

CONNECTION_CHECK_S = 0.1
DONE, REFUSED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class StageNode(LifecycleNode, Generic[Settings]):
    """A managed node (REP-2002 in rclpy's form) around one stage, with the services `~/pause` and
    `~/reset`.

    Configured, it has its topics and services (`set_up`) and an empty map (`reset_stage`). While it
    is active, needed and not paused, its `inputs` are open. Deactivated, idle or paused it receives
    nothing and keeps its map; cleaned up it has neither map nor topics. Callbacks run one after the
    other; the depth of the subscriptions is the queue.
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
        self.parameters = NodeParameters(self, settings())
        self.add_on_set_parameters_callback(self._change_parameters)
        self.reporter = Reporter(self)
        self.inputs = Inputs(self, self.reporter)
        self.connections = Connections(self, self.reporter, self.inputs)
        self.kept_state = KeptState(self.get_fully_qualified_name(), self.settings.resume_within_s)
        self._at_clean_up: list[Callable[[], Any]] = []
        self._state = 'unconfigured'
        self._is_paused, self._is_needed = False, True
        self._fault: Exception | None = None
        self._last_health_s = 0.0
        refuse_impossible_transitions(self)
        self.inputs.steady_timer(CONNECTION_CHECK_S, self._check)
        if self.settings.autostart:
            self._configure_and_activate()

    # What the nodes fill in.

    def set_up(self) -> None:
        """Make the topics and services. Raises SegfloorError when that cannot be."""
        raise NotImplementedError

    def reset_stage(self) -> None:
        """Begin with an empty map, first of all after `set_up`. The topics stay."""
        raise NotImplementedError

    def restore(self, saved: MapFile) -> None:
        """Go on with a map, first of all after `reset_stage`: what a killed node has left in
        `kept_state`, or what SLAM has loaded.
        """

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

    @property
    def state_in_words(self) -> str:
        """The state of the node: unconfigured, inactive, active, paused, idle or finalized."""
        if self._state == 'active' and self._is_paused:
            return 'paused'
        return 'idle' if self._state == 'active' and not self._is_needed else self._state

    def output(self, name: str) -> Publisher:
        """Create the publisher of a topic of `TOPICS`. It lives until the node is cleaned up."""
        topic = TOPICS[name]
        # What does not connect is reported by `qos_check`, in words and on /diagnostics.
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        made = self.create_publisher(topic.type, name, topic.profile, event_callbacks=quiet)
        self.connections.outputs[name] = made
        self.at_clean_up(lambda: self.destroy_publisher(made))
        return made

    def offer(self, kind: Any, name: str, answer: Callable[[Any, Any], Any]) -> None:
        """Offer a service until the node is cleaned up. answer: may be a coroutine; the node works
        on while it waits.
        """
        made = self.create_service(kind, name, answer, callback_group=ReentrantCallbackGroup())
        self.at_clean_up(lambda: self.destroy_service(made))

    def offer_trigger(self, name: str, work: Callable[[], str | Awaitable[str]]) -> None:
        """Offer a service that does some work and answers with its message, or with why it failed.
        work: may return an awaitable; raises SegfloorError or OSError.
        """

        async def answer(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                message = work()
                response.message = message if isinstance(message, str) else await message
                response.success = True
            except (SegfloorError, OSError) as error:
                response.message = str(error)
            return response

        self.offer(Trigger, name, answer)

    def at_clean_up(self, step: Callable[[], Any]) -> None:
        """Do something when the node is cleaned up; the last one first."""
        self._at_clean_up.append(step)

    def work(self, stamp_ns: int, step: Callable[[], Mapping[str, Any]]) -> bool:
        """Run the stage's step for one stamp and report how it went, with the values it returns;
        returns whether it went well.
        """
        start = time.perf_counter()
        try:
            values = step()
        except Exception as error:
            self.reporter.report_fault(stamp_ns, error)
            return False
        milliseconds = 1e3 * (time.perf_counter() - start)
        self.reporter.report_processed(stamp_ns, Level.OK, 'running', milliseconds, **values)
        return True

    def pause(self, paused: bool) -> None:
        """Close the inputs until further notice, or open them again."""
        self._is_paused = paused
        self._open_or_close()

    def reset(self, reason: str) -> None:
        """Drop the map and begin with an empty one, with one line in the log."""
        self.get_logger().info(f'reset: {reason}')
        self.kept_state.remove()
        self.reset_stage()

    # The transitions, as rclpy calls them.

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
        """Drop the map, topics and services."""
        return self._transit(self._clean_up, 'unconfigured')

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drop everything, from any state."""
        return self._transit(self._clean_up, 'finalized')

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drop everything; the node can be configured again."""
        return self._transit(self._clean_up, 'unconfigured')

    def destroy_node(self) -> None:
        """End the node and what works for it."""
        self._clean_up()
        super().destroy_node()

    def _configure_and_activate(self) -> None:
        """Configure and activate. Raises what stands in the way."""
        for step in (self.trigger_configure, self.trigger_activate):
            if step() != DONE:
                assert self._fault is not None
                raise self._fault

    def _transit(self, step: Callable[[], None], label: str) -> TransitionCallbackReturn:
        """Take the step of a transition; a fault is logged and the transition refused."""
        try:
            step()
        except Exception as error:
            self._fault = error
            self.get_logger().error(' '.join(str(error).split()) or repr(error))
            if not isinstance(error, SegfloorError):
                self.get_logger().debug(''.join(traceback.format_exception(error)))
            return REFUSED
        self._state = label
        return DONE

    def _configure(self) -> None:
        try:
            self.offer(SetBool, '~/pause', self._answer_pause)
            self.offer(Trigger, '~/reset', self._answer_reset)
            self.at_clean_up(self.kept_state.remove)
            self.set_up()
            self.reset_stage()
            kept = self.kept_state.take()
            if kept is not None:
                self.restore(kept)
                self.get_logger().warning('resumed with the map of a node that was killed')
        except Exception:
            self._clean_up()
            raise

    def _clean_up(self) -> None:
        self._is_paused = False
        self._open_or_close('inactive')
        self.inputs.remove_all()
        while self._at_clean_up:
            self._at_clean_up.pop()()
        self.connections.outputs.clear()

    def _open_or_close(self, label: str = '') -> None:
        """Open or close the inputs as the state asks for; label: the state that is entered."""
        is_active = (label or self._state) == 'active'
        wanted = is_active and self._is_needed and not self._is_paused
        if wanted and not self.inputs.is_open:
            self.inputs.open()
            self.on_inputs_opened()
        elif not wanted and self.inputs.is_open:
            self.inputs.close()
            self.reporter.restart_loss_counts()
            self.on_inputs_closed()

    def _check(self) -> None:
        """Report connections and health, and look whether the node is needed."""
        counts = self.connections.count_listeners()
        always = not self.works_on_demand or self._state != 'active'
        self._is_needed = self.connections.are_needed(counts, always or self.is_needed_otherwise())
        self._open_or_close()
        now_s = time.monotonic()
        is_due = now_s - self._last_health_s >= HEALTH_PERIOD_S
        self.connections.report(counts, always=is_due)
        if is_due:
            self._last_health_s = now_s
            if self.inputs.is_open:
                self.find_problems()
                self.connections.find_problems()
            self.reporter.publish_health(self.state_in_words)

    def _answer_pause(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        self.pause(bool(request.data))
        response.success, response.message = True, 'paused' if self._is_paused else 'running'
        return response

    def _answer_reset(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        self.inputs.give_up_waiting()
        response.success = self._transit(lambda: self.reset('by ~/reset'), self._state) == DONE
        response.message = 'reset' if response.success else str(self._fault)
        return response

    def _change_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        result = self.parameters.change(parameters)
        if result.successful:
            self.on_settings_changed()
        return result


AnyStageNode = StageNode[Any]


def refuse_impossible_transitions(node: LifecycleNode) -> None:
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
