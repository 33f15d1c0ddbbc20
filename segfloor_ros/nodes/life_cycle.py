"""What rclpy's lifecycle node leaves open."""

from __future__ import annotations

from typing import Any

from rclpy.lifecycle import LifecycleNode


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
