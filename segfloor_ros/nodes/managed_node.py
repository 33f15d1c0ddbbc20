"""A node that can be managed (configure, activate, deactivate, cleanup, shutdown), and that starts
by itself where nobody manages it.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from std_srvs.srv import SetBool, Trigger

from segfloor_ros.errors import SegfloorError
from segfloor_ros.nodes.hand_over import (
    HandOver,
    LocalPublisher,
    LocalSubscription,
    TopicCallback,
)
from segfloor_ros.nodes.when_idle import WhenIdle

LEAST_PERIOD_S = 0.001
DONE, REFUSED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class ManagedNode(LifecycleNode):
    """The states of a node (REP-2002 in rclpy's form), and the services `~/pause` and `~/reset`.

    Configured, it has its topics and services and an empty map (`set_up`, `start_anew`); while it
    is active, needed and not paused, its inputs are open: subscriptions and timers made with
    `listen` and `every`. Deactivated, idle or paused it receives nothing and keeps its map, and
    what it has latched stays to be had; cleaned up it has neither.
    """

    def __init__(self, name: str, hand_over: HandOver | None = None) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        self._hand_over = hand_over
        self._openers: list[tuple[Callable[[], Any], Callable[[Any], Any]]] = []
        self._open: list[tuple[Any, Callable[[Any], Any]]] = []
        self._kept: list[tuple[Any, Callable[[Any], Any]]] = []
        self._steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._heard: dict[str, Subscription | LocalSubscription] = {}
        self._is_set_up = self.is_active = self._is_paused = False
        self._is_needed = True
        self._fault: Exception | None = None
        self._answer_impossible_transitions()

    @property
    def state_in_words(self) -> str:
        """The state of the node: unconfigured, inactive, active, paused, idle or finalized."""
        if self.is_active and self._is_paused:
            return 'paused'
        if self.is_active and not self._is_needed:
            return 'idle'
        return str(self._state_machine.current_state[1])

    @property
    def is_open(self) -> bool:
        """Whether the inputs are open: the node is active, needed and not paused."""
        return self.is_active and self._is_needed and not self._is_paused

    def set_up(self) -> None:
        """Make the topics and services. Raises SegfloorError when that cannot be."""
        raise NotImplementedError

    def start_anew(self) -> None:
        """Begin with an empty map, first of all after `set_up`. The topics stay."""
        raise NotImplementedError

    def take_up(self) -> None:
        """Go on, right after the first `start_anew`, with what a killed node has left."""

    def forget(self) -> None:
        """Drop the map and end what works on it."""

    def on_inputs_opened(self) -> None:
        """Prepare for messages, at first and after a pause."""

    def on_inputs_closed(self) -> None:
        """Give up what waits for more messages."""

    def start(self) -> None:
        """Configure and activate. Raises what stands in the way."""
        for step in (self.trigger_configure, self.trigger_activate):
            if step() != DONE:
                assert self._fault is not None
                raise self._fault

    def reset(self) -> None:
        """Drop the map and whatever waits, because somebody asked for it."""
        self.begin_anew('asked to by ~/reset')

    def begin_anew(self, reason: str) -> None:
        """Drop the map and begin anew, with one line in the log. What waits to be processed is of
        the new map already.
        """
        self.get_logger().info(f'begins anew: {reason}')
        self.start_anew()

    def pause(self, paused: bool) -> None:
        """Close the inputs until further notice, or open them again."""
        self._is_paused = paused
        self._open_or_close()

    def note_need(self, needed: bool) -> None:
        """Close the inputs while nobody needs what is made of them."""
        self._is_needed = needed
        self._open_or_close()

    def reopen(self) -> None:
        """Close the inputs and open them again, to subscribe otherwise."""
        if self._open:
            self._close()
            self._open_or_close()

    def keep_publisher(
        self, kind: Any, name: str, profile: QoSProfile
    ) -> Publisher | LocalPublisher:
        """Create a publisher that lives until the node is cleaned up."""
        # What does not connect is said by `qos_check`, in words and on /diagnostics.
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        publisher = self.create_publisher(kind, name, profile, event_callbacks=quiet)
        self._kept.append((publisher, self.destroy_publisher))
        if self._hand_over is None:
            return publisher
        return self._hand_over.publisher(publisher, profile)

    def keep_subscription(
        self, kind: Any, name: str, callback: Callable[[Any], None], profile: QoSProfile
    ) -> Callable[[], None]:
        """Subscribe until the node is cleaned up, whether it is active or not; the function
        returned ends it before.
        """
        kept = (self.create_subscription(kind, name, callback, profile), self.destroy_subscription)
        self._kept.append(kept)

        def end() -> None:
            if kept in self._kept:
                self._kept.remove(kept)
                self.destroy_subscription(kept[0])

        return end

    def at_cleanup(self, step: Callable[[], None]) -> None:
        """Do something when the node is cleaned up."""
        self._kept.append((None, lambda _: step()))

    def offer(self, kind: Any, name: str, answer: Callable[[Any, Any], Any]) -> None:
        """Offer a service until the node is cleaned up."""
        self._kept.append((self.create_service(kind, name, answer), self.destroy_service))

    def subscribe_while_open(
        self,
        kind: Any,
        name: str,
        callback: TopicCallback,
        choose_profile: Callable[[], QoSProfile],
        raw: bool = False,
    ) -> None:
        """Subscribe to a topic while the inputs are open. raw: take the serialized messages."""

        def subscribe() -> Subscription | LocalSubscription:
            local, profile = None, choose_profile()
            if self._hand_over is not None:
                topic = self.resolve_topic_name(name)
                local = self._hand_over.subscribe(topic, callback, profile, raw)
            quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
            # rclpy's annotation knows callbacks of one argument only.
            take: Any = callback
            made = local or self.create_subscription(
                kind, name, take, profile, raw=raw, event_callbacks=quiet
            )
            self._heard[name] = made
            return made

        self._openers.append((subscribe, self._unsubscribe))

    def publishing_nodes(self, name: str) -> int:
        """Return how many nodes publish a topic that the node listens to now. One that was killed
        and started again is one, though for a while both its lives are seen.
        """
        infos = self.get_publishers_info_by_topic(name) if name in self._heard else []
        return len({(info.node_namespace, info.node_name) for info in infos})

    def publisher_count(self, name: str) -> int:
        """Return how many publishers of a topic that the node listens to now are seen."""
        return self._heard[name].get_publisher_count() if name in self._heard else 0

    @property
    def subscriptions_by_topic(self) -> Mapping[str, Subscription | LocalSubscription]:
        """The open subscriptions by the topic's name as in the code, before remapping."""
        return self._heard

    def is_published(self, name: str) -> bool:
        """Whether anybody publishes a topic that the node listens to now."""
        return self.publisher_count(name) > 0

    def when_idle(self, callback: Callable[[], None]) -> WhenIdle:
        """Return what calls something once the messages that have come are taken. It lives until
        the node is cleaned up.
        """
        made = WhenIdle(self, callback)
        self._kept.append((made.guard, self.destroy_guard_condition))
        return made

    def every(self, period_s: float, callback: Callable[[], None]) -> None:
        """Call something regularly while the inputs are open."""
        self._openers.append((lambda: self.steady_timer(period_s, callback), self.destroy_timer))

    def repeat(self, step: Callable[[], float]) -> None:
        """Call something while the inputs are open, each time after as many seconds as it has
        returned the time before.
        """

        def start() -> Timer:
            def run() -> None:
                timer.timer_period_ns = round(1e9 * max(step(), LEAST_PERIOD_S))
                timer.reset()

            timer = self.steady_timer(LEAST_PERIOD_S, run)
            return timer

        self._openers.append((start, self.destroy_timer))

    def steady_timer(self, period_s: float, callback: Callable[[], None]) -> Timer:
        """Make a timer that also runs while the time of a recording stands still."""
        return self.create_timer(period_s, callback, clock=self._steady_clock)

    def destroy_node(self) -> None:
        """End the node and what works for it."""
        self._clean_up()
        super().destroy_node()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make topics, services and an empty map."""
        return self._try(self._configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the inputs."""
        self.is_active = True
        result = self._try(self._open_or_close)
        self.is_active = result == DONE
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the inputs and keep the map."""
        self.is_active = False
        return self._try(self._open_or_close)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drop the map, topics and services."""
        return self._try(self._clean_up)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drop everything, from any state."""
        return self._try(self._clean_up)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drop everything; the node can be configured again."""
        return self._try(self._clean_up)

    def _try(self, step: Callable[[], None]) -> TransitionCallbackReturn:
        """Take a step of a transition; a fault is logged and the transition refused."""
        try:
            step()
        except Exception as error:
            self._fault = error
            self.get_logger().error(' '.join(str(error).split()) or repr(error))
            if not isinstance(error, SegfloorError):
                self.get_logger().debug(''.join(traceback.format_exception(error)))
            return REFUSED
        return DONE

    def _configure(self) -> None:
        try:
            self.offer(SetBool, '~/pause', self._answer_pause)
            self.offer(Trigger, '~/reset', self._answer_reset)
            self._is_set_up = True
            self.set_up()
            self.start_anew()
            self.take_up()
        except Exception:
            self._clean_up()
            raise

    def _clean_up(self) -> None:
        self.is_active = self._is_paused = False
        self._open_or_close()
        self._openers.clear()
        if self._is_set_up:
            self._is_set_up = False
            self.forget()
        while self._kept:
            entity, destroy = self._kept.pop()
            destroy(entity)

    def _open_or_close(self) -> None:
        if self.is_open and not self._open:
            self._open = [(make(), destroy) for make, destroy in self._openers]
            self.on_inputs_opened()
        elif not self.is_open and self._open:
            self._close()

    def _close(self) -> None:
        while self._open:
            entity, destroy = self._open.pop()
            destroy(entity)
        self._heard.clear()
        self.on_inputs_closed()

    def _unsubscribe(self, subscription: Subscription | LocalSubscription) -> None:
        if not isinstance(subscription, LocalSubscription):
            self.destroy_subscription(subscription)
        elif self._hand_over is not None:
            self._hand_over.unsubscribe(subscription)

    def _answer_pause(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        self.pause(bool(request.data))
        response.success, response.message = True, 'paused' if self._is_paused else 'running'
        return response

    def _answer_reset(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        response.success = self._try(self.reset) == DONE
        response.message = 'begun anew' if response.success else str(self._fault)
        return response

    def _answer_impossible_transitions(self) -> None:
        """Refuse a transition that the present state does not have; in rclpy's own handler it
        raises, which would end the node.
        """
        change_state = self._service_change_state.callback

        def answer(request: Any, response: Any) -> Any:
            try:
                return change_state(request, response)
            except rclpy_implementation.RCLError as error:
                self.get_logger().warning(str(error).partition(', at ')[0])
                response.success = False
                return response

        self._service_change_state.callback = answer
