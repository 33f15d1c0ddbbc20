"""The ROS domain of a replay is its own."""

import os
import subprocess
import sys

import pytest

pytest.importorskip('rclpy')

from segfloor_ros.apps.cli.replay_nodes import DOMAINS, free_domain

SAME_PID = 7
ASK = """
import os
os.getpid = lambda: 7
from segfloor_ros.apps.cli.replay_nodes import free_domain
print(free_domain())
"""


@pytest.mark.slow
def test_no_two_processes_are_told_the_same_domain(monkeypatch) -> None:
    monkeypatch.setattr(os, 'getpid', lambda: SAME_PID)
    mine = free_domain()
    asked = subprocess.run([sys.executable, '-c', ASK], capture_output=True, text=True, timeout=60)
    others = int(asked.stdout)
    assert mine != others
    assert {mine, others} <= set(range(1, DOMAINS + 1))
