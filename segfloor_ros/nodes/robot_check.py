"""Whether another node was started with the same robot."""

from __future__ import annotations

from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.task import Future

from segfloor_ros.configuration import ROBOT_PARAMETERS
from segfloor_ros.robot import RobotSettings


class RobotCheck:
    """Asks a node for the parameters of the robot and compares them with those of this one."""

    def __init__(self, node: Node, other: str) -> None:
        self._node, self._other = node, other
        self._client = node.create_client(GetParameters, f'{other}/get_parameters')
        self._asked: Future | None = None
        self._theirs: dict[str, Any] = {}

    def difference(self, ours: RobotSettings) -> str | None:
        """Return in words how the robots differ, as of the last answer, and ask anew."""
        if self._asked is not None and self._asked.done():
            values = map(parameter_value_to_python, self._asked.result().values)
            self._theirs = dict(zip(ROBOT_PARAMETERS, values, strict=False))
            self._asked = None
        if self._asked is None and self._client.service_is_ready():
            request = GetParameters.Request(names=ROBOT_PARAMETERS)
            self._asked = self._client.call_async(request)
        parts = [
            f'{name} is {value:g} here and {self._theirs[name]:g} in {self._other}'
            for name, value in ours.robot.items()
            if self._theirs.get(name, value) != value
        ]
        if not parts:
            return None
        return '; '.join(parts) + ': there is one robot, set it under /** in the parameter file'
