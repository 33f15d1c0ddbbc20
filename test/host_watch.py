"""Follows nodes that run on two hosts from one of them: lets the camera play, and saves the map."""

import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import rclpy
from std_srvs.srv import SetBool, Trigger

from segfloor_ros.apps.cli.replay_nodes import NodeGraph
from segfloor_ros.apps.cli.replay_recorder import ReplayRecorder
from segfloor_ros.nodes.messages.topics import NODES


def main() -> None:
    """Print how long it took."""
    context = rclpy.Context()
    rclpy.init(context=context)
    recorder = ReplayRecorder(context)
    graph = NodeGraph(recorder, SimpleNamespace(check=lambda: None, process_ids=NODES), Path())
    waited_s = graph.connect()
    start_s = time.monotonic()
    graph.call(SetBool, 'stereo_camera/pause', SetBool.Request(data=False))
    graph.play(lambda count, state: None, threading.Event())
    graph.call(Trigger, 'save_map', Trigger.Request())
    print(f'connected after {waited_s:.1f} s, played in {time.monotonic() - start_s:.1f} s')
    rclpy.try_shutdown(context=context)
    sys.stdout.flush()


if __name__ == '__main__':
    main()
