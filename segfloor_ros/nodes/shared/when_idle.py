"""Work that waits until the node has taken the messages that have come."""

from __future__ import annotations

from collections.abc import Callable

from segfloor_ros.nodes.shared.stage_node import AnyStageNode

MOST_PASSES = 100
"""Messages that come faster than they are taken do not put the work off for good."""


class WhenIdle:
    """Calls something when the executor has passed over all topics and found nothing new.

    An executor takes one message of each topic in a pass. Work done in the callback of the first
    message would leave the newer ones in the queue, unknown, while it lasts.
    """

    def __init__(self, node: AnyStageNode, callback: Callable[[], None]) -> None:
        self._callback = callback
        self._is_new = False
        self._passes = 0
        self._guard = node.create_guard_condition(self._pass)
        node.at_clean_up(lambda: node.destroy_guard_condition(self._guard))

    def request(self) -> None:
        """Have it called; what came just now may be followed by more."""
        self._is_new = True
        self._guard.trigger()

    def _pass(self) -> None:
        if self._is_new and self._passes < MOST_PASSES:
            self._is_new = False
            self._passes += 1
            self._guard.trigger()
            return
        self._is_new, self._passes = False, 0
        self._callback()
