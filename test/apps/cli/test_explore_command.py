"""`segfloor explore`: a closed loop over DDS, from an empty map to goals on the whole one."""

import contextlib
import json
import os
import signal
import threading
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from command_line import segfloor

from segfloor_ros.apps.cli.explore_session import STANDING_S
from segfloor_ros.apps.trajectory import read_trajectory

pytestmark = pytest.mark.skipif(find_spec('mujoco') is None, reason='the extra sim')

RATE_HZ = 5

SMALL_ROOM = """
description: A room with a box in it.
seed: 5
floor: {texture: marble}
walls:
  - {points: [[-0.7, -0.9], [2.1, -0.9], [2.1, 0.9], [-0.7, 0.9]], closed: true,
     texture: rough_plaster, posters: 6}
boxes:
  - {at: [1.3, 0.55], size: [0.3, 0.3, 0.5], texture: goods}
camera: {width: 480, height: 360, rate_hz: 5}
path: {waypoints: [[0, 0], [0.5, 0]]}
"""


CHAMBER = """
description: As little as can be explored; few and small images keep it to a minute of CPU time.
seed: 5
floor: {texture: marble}
walls:
  - {points: [[-0.5, -0.5], [1.0, -0.5], [1.0, 0.5], [-0.5, 0.5]], closed: true,
     texture: rough_plaster, posters: 6}
camera: {width: 320, height: 240, rate_hz: 2}
path: {waypoints: [[0, 0], [0.3, 0]]}
"""


def kill_slam_once_busy(busy_s: float) -> threading.Thread:
    """Watch the node of SLAM that this process starts, and kill it once it has worked for so many
    seconds of CPU time: it is in mid drive then, however long starting takes on a busy machine.
    """
    ticks = busy_s * os.sysconf('SC_CLK_TCK')

    def is_killed() -> bool:
        for folder in Path('/proc').glob('[0-9]*'):
            with contextlib.suppress(OSError):
                values = (folder / 'stat').read_text().rpartition(')')[2].split()
                is_slam = b'segfloor_ros.nodes.stereo_slam' in (folder / 'cmdline').read_bytes()
                if (
                    is_slam
                    and int(values[1]) == os.getpid()
                    and sum(map(int, values[11:13])) > ticks
                ):
                    os.kill(int(folder.name), signal.SIGKILL)
                    return True
        return False

    def watch() -> None:
        while not is_killed():
            time.sleep(0.2)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    return thread


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_robot_maps_a_chamber_and_drives_to_a_goal(tmp_path) -> None:
    scene, out = tmp_path / 'chamber.yaml', tmp_path / 'out'
    scene.write_text(CHAMBER)
    done = segfloor('explore', scene, '--out', out, '--goals', '1', '--minutes', '1')
    assert done.returncode == 0, done.stderr
    found = json.loads((out / 'summary.json').read_text())
    assert found['mapped_share'] > 0.95
    assert found['bumps'] == 0
    assert (found['goals_reached'], found['goals_total']) == (1, 1)
    assert found['path_rmse_m'] < 0.02
    times_s, poses = read_trajectory(out / 'ground_truth.txt')
    moved = np.abs(poses - poses[0]).max(axis=(1, 2))
    assert moved[times_s <= STANDING_S].max() < 0.005 < moved.max(), 'it neither drives nor turns'


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_robot_maps_a_room_by_itself_and_drives_to_goals_though_slam_is_killed(tmp_path) -> None:
    scene, out = tmp_path / 'room.yaml', tmp_path / 'out'
    scene.write_text(SMALL_ROOM)
    killer = kill_slam_once_busy(8.0)
    done = segfloor('explore', scene, '--out', out, '--goals', '1', '--minutes', '4')
    assert done.returncode == 0, done.stderr
    assert not killer.is_alive()
    found = json.loads((out / 'summary.json').read_text())
    assert found['mapped_share'] > 0.95
    assert found['bumps'] == 0
    assert (found['goals_reached'], found['goals_total']) == (1, 1)
    assert found['path_rmse_m'] < 0.05
    assert (out / 'explored.gif').read_bytes().startswith(b'GIF89a')
    times_s, poses = read_trajectory(out / 'ground_truth.txt')
    tracked_s, _ = read_trajectory(out / 'trajectory.txt')
    lost = np.flatnonzero(np.diff(tracked_s) > 1.5 / RATE_HZ)
    assert len(lost), 'SLAM was killed'
    for last_s, next_s in zip(tracked_s[lost], tracked_s[lost + 1], strict=True):
        stands = (times_s > last_s + 0.5) & (times_s < next_s)
        places = poses[stands, :2, 3]
        assert not len(places) or np.hypot(*(places - places[0]).T).max() < 0.005


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (('hall', '--robot', 'huski'), 'huski: no such robot'),
        (('hal',), 'hal: no such scene or file'),
        (('hall', '--goals', '-1'), '--goals'),
    ],
)
def test_what_cannot_be_explored_is_said_in_one_line(tmp_path, arguments, words) -> None:
    done = segfloor('explore', *arguments, '--out', str(tmp_path / 'out'))
    assert done.returncode == 2
    assert words in done.stderr
    assert not (tmp_path / 'out').exists()
