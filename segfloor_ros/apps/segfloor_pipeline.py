"""The five nodes in one program: same names, topics, services and parameters.

SLAM has a process of its own, so that nothing else takes Python's lock from tracking. The process
of the others is forked from it and shares the memory of what is imported. The camera is among the
nodes where `input` names a recording or a device.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from types import FrameType

from rclpy.node import Node

from segfloor_ros.apps.stereo_camera import make_stereo_camera
from segfloor_ros.core.processes import end_with_parent
from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.floor_segmentation import FloorSegmentationNode
from segfloor_ros.nodes.messages.topics import CAMERA
from segfloor_ros.nodes.occupancy_grid import OccupancyGridNode
from segfloor_ros.nodes.shared.running import run_nodes
from segfloor_ros.nodes.stereo_slam import StereoSlamNode

BEHIND = (FloorSegmentationNode, CloudLabellingNode, OccupancyGridNode)


class Helper:
    """A forked process with the other nodes. It begins when it is told to; when one of the two
    processes ends, so does the other. When one is killed, the other goes as if it was killed, too:
    what SLAM keeps for the next life stays.
    """

    def __init__(self) -> None:
        self._has_begun = False
        gc.freeze()  # what is never collected stays shared
        reading, self._pipe = os.pipe()
        parent_id, self._process_id = os.getpid(), os.fork()
        if self._process_id:
            os.close(reading)
            signal.signal(signal.SIGCHLD, self._end_as_well)
            return
        end_with_parent(parent_id, signal.SIGKILL)
        os.close(self._pipe)
        if os.read(reading, 1):
            os.close(reading)
            run_nodes(_make_others)
        sys.exit(0)  # the first process has failed, and has said why

    def begin(self) -> None:
        """Let it make its nodes."""
        os.write(self._pipe, b'!')
        self._has_begun = True

    def end(self) -> int:
        """End it in order and return its exit status."""
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.close(self._pipe)
        if self._has_begun:
            os.kill(self._process_id, signal.SIGINT)
        code = os.waitstatus_to_exitcode(os.waitpid(self._process_id, 0)[1])
        return code if code >= 0 else 128 - code

    def _end_as_well(self, number: int, frame: FrameType | None) -> None:
        """End this process where its helper has ended, not only stopped or gone on."""
        options = os.WEXITED | os.WNOHANG | os.WNOWAIT
        ended = os.waitid(os.P_PID, self._process_id, options)
        if ended is None:
            return
        if ended.si_code != os.CLD_EXITED:
            os._exit(128 + ended.si_status)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        signal.raise_signal(signal.SIGINT)


def _make_others() -> list[Node]:
    nodes: list[Node] = [make_stereo_camera()] if _has_input() else []
    return [*nodes, *(make() for make in BEHIND)]


def _has_input() -> bool:
    """Whether the parameters of the camera name a recording or a device."""
    probe = Node(CAMERA, automatically_declare_parameters_from_overrides=True)
    try:
        return bool(probe.get_parameter_or('input').value)
    finally:
        probe.destroy_node()


def main() -> None:
    """Run the nodes."""
    helper = Helper()

    def make_slam() -> list[Node]:
        nodes: list[Node] = [StereoSlamNode()]
        helper.begin()
        return nodes

    status = 1
    try:
        run_nodes(make_slam)
    except SystemExit as ended:
        status = int(ended.code or 0)
    finally:
        status = max(status, helper.end())
    sys.exit(status)


if __name__ == '__main__':
    main()
