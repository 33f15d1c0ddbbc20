"""What a node receives while it works: subscriptions, timers, and the parts of a keyframe or a
stereo pair, joined by their stamps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from segfloor_ros.nodes.messages.topics import TOPICS, stamp_of, to_ns
from segfloor_ros.nodes.shared.joining import StampJoiner
from segfloor_ros.nodes.shared.reporter import Reporter

LEAST_PERIOD_S, LOOK_S, CHECK_S = 0.005, 0.05, 0.1
"""Of timers: the shortest, of what has to follow soon, and of what may take a moment."""

DISCOVERY_S = 4.0
"""Publishers of one process are seen one after the other, the last ones after so long."""


@dataclass
class Input:
    """A subscription, timer or guard: what makes it, what ends it, and when it is wanted while the
    node works. entity: what has been made; None while it is closed.
    """

    make: Callable[[], Any]
    destroy: Callable[[Any], Any]
    is_wanted: Callable[[], bool] = lambda: True
    entity: Any = None


class Inputs:
    """The inputs of one node. They are declared once, and opened and closed with its states.

    A fault in a callback is one line in the log that names the topic; the node lives on.
    """

    def __init__(self, node: Node, reporter: Reporter) -> None:
        self._node = node
        self._reporter = reporter
        self._steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._inputs: list[Input] = []
        self._joiners: list[StampJoiner] = []
        self.subscriptions: dict[str, Subscription] = {}
        """The open subscriptions by the topic's name as in the code, before remapping."""
        self.is_open = False
        """Whether messages are received."""

    def subscribe(
        self,
        name: str,
        callback: Callable[[Any], None],
        choose_profile: Callable[[], QoSProfile] | None = None,
        is_wanted: Callable[[], bool] = lambda: True,
        takes_all: bool = False,
    ) -> None:
        """Receive a topic of `TOPICS`. choose_profile: asked whenever the subscription is made.
        is_wanted: asked whenever the inputs open, and by `update`. takes_all: with a message all
        are taken that have come, before anything else is done.
        """
        topic = TOPICS[name]

        def take(message: Any, info: Mapping[str, Any]) -> None:
            subscription = self.subscriptions[name]
            more = _waiting(subscription, topic.profile.depth) if takes_all else ()
            for one, its_info in ((message, info), *more):
                self._reporter.note_received(topic, stamp_of(one), its_info, subscription)
                try:
                    callback(one)
                except Exception as error:
                    self._reporter.log_fault(name, error)

        def subscribe() -> Subscription:
            profile = choose_profile() if choose_profile else topic.profile
            # What does not connect is reported in words and on /diagnostics.
            quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
            # rclpy's annotation knows callbacks of one argument only.
            two_arguments: Any = take
            made = self._node.create_subscription(
                topic.type, name, two_arguments, profile, event_callbacks=quiet
            )
            self.subscriptions[name] = made
            return made

        def unsubscribe(made: Subscription) -> None:
            self.subscriptions.pop(name)
            self._node.destroy_subscription(made)

        self._inputs.append(Input(subscribe, unsubscribe, is_wanted))

    def join(
        self,
        parts: Sequence[str],
        process: Callable[[int, dict[str, Any]], None],
        on_message: Callable[[str, int], None] | None = None,
        choose_profile: Callable[[], QoSProfile] | None = None,
        is_wanted: Callable[[], bool] = lambda: True,
        takes_all: bool = False,
        **limits: Any,
    ) -> None:
        """Receive topics whose messages belong together by their stamps; `process` gets the stamp
        and the messages by topic once all have arrived. Those that remain alone are reported.
        on_message: gets topic and stamp of every message. limits: of the `StampJoiner`.
        """
        joiner = StampJoiner(parts, **limits)
        self._joiners.append(joiner)

        def take(part: str, message: Any) -> None:
            stamp_ns = to_ns(message.header.stamp)
            if on_message is not None:
                on_message(part, stamp_ns)
            complete = joiner.add(part, stamp_ns, message)
            self._reporter.report_dropped(joiner, self.publishing_nodes)
            if complete is not None:
                process(stamp_ns, complete)

        for part in joiner.all_parts:
            self.subscribe(part, partial(take, part), choose_profile, is_wanted, takes_all)

    def every(self, period_s: float, callback: Callable[[], None]) -> None:
        """Call something regularly while the inputs are open."""
        make = partial(self.steady_timer, period_s, callback)
        self._inputs.append(Input(make, self._node.destroy_timer))

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

        self._inputs.append(Input(start, self._node.destroy_timer))

    def later(self, step: Callable[[], None]) -> Callable[[], None]:
        """Return what has a step taken while the inputs are open, once the messages are taken that
        have come: an executor looks at guard conditions after the subscriptions.
        """
        made = partial(self._node.create_guard_condition, step)
        guard = Input(made, self._node.destroy_guard_condition)
        self._inputs.append(guard)

        def request() -> None:
            if guard.entity is not None:
                guard.entity.trigger()

        return request

    def steady_timer(self, period_s: float, callback: Callable[[], None]) -> Timer:
        """Make a timer that also runs while the time of a recording stands still."""
        return self._node.create_timer(period_s, callback, clock=self._steady_clock)

    def open(self) -> None:
        """Receive from now on what is wanted."""
        self.is_open = True
        self._reporter.note_opened()
        self.update()

    def update(self) -> None:
        """While the inputs are open, open those that are wanted by now, and close the others; first
        close, since two may be of the same topic.
        """
        wanted = [self.is_open and one.is_wanted() for one in self._inputs]
        for one, is_wanted in zip(self._inputs, wanted, strict=True):
            if not is_wanted and one.entity is not None:
                entity, one.entity = one.entity, None
                one.destroy(entity)
        for one, is_wanted in zip(self._inputs, wanted, strict=True):
            if is_wanted and one.entity is None:
                one.entity = one.make()

    def close(self) -> None:
        """Receive nothing any more, and give up what waits for a partner."""
        self.is_open = False
        self.update()
        self.give_up_waiting()

    def reopen(self) -> None:
        """Subscribe again, with other profiles."""
        if self.is_open:
            self.close()
            self.open()

    def give_up_waiting(self) -> None:
        """Drop the messages that wait for a partner."""
        for joiner in self._joiners:
            joiner.clear()

    def remove_all(self) -> None:
        """Close the inputs and declare none any more."""
        self.close()
        self._inputs.clear()
        self._joiners.clear()

    def publishing_nodes(self, name: str) -> int:
        """Return how many nodes publish a topic that is received now. One that was killed and
        started again is one, though for a while both its lives are seen.
        """
        known = name in self.subscriptions
        infos = self._node.get_publishers_info_by_topic(name) if known else []
        return len({(info.node_namespace, info.node_name) for info in infos})


def _waiting(subscription: Subscription, most: int) -> Iterator[tuple[Any, Mapping[str, Any]]]:
    """Yield the messages that have come, oldest first."""
    with subscription.handle:
        for _ in range(most):
            message = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if message is None:
                return
            yield message
