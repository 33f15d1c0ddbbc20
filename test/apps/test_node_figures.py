"""`segfloor benchmark --nodes`: its sums by hand, the command for real."""

import subprocess
import sys

import numpy as np
import pytest
from stereo_drive import room_drive, write_kitti

pytest.importorskip('rclpy')

from segfloor_ros.apps.cli.replay_session import NodeFigures, figure_rows


def test_the_figures_are_of_the_quarters_after_the_first() -> None:
    figures = NodeFigures(
        frames_sent=20,
        frames_processed=18,
        frames_skipped=2,
        keyframes=8,
        mapped=7,
        wall_s=2.0,
        latency_s=np.array([9.0, 9.0, 0.1, 0.3, 0.2, 0.2, 0.4, 0.6]),
        odometry_s=np.array([0.02, 0.04, 0.03, 0.1, 0.02]),
        steps_s={'a': np.array([0.3, 0.1, 0.2])},
        cpu_share={'a': 0.5},
        memory_mb=np.array([[0, 90.0], [5, 100.0], [10, 101.0], [20, 102.0]]),
        shutdown_s=0.5,
    )
    rows = dict(figure_rows(figures))
    assert rows['frames sent, processed'] == '20, 18'
    assert rows['keyframes, in the map'] == '8, 7'
    assert rows['frames per second'] == '9.0'
    assert rows['image to map, median and p95'] == '350 ms, 9000 ms'
    assert rows['image to odometry, median and p95'] == '30 ms, 88 ms'
    assert rows['image to map, 2nd and last quarter'] == '200 ms, 500 ms'
    assert rows['until a had done, median and p95'] == '200 ms, 290 ms'
    assert rows['frames skipped to stay up to date'] == '2'
    assert rows['a: CPU'] == '50 % of a core'
    assert rows['a: memory, 2nd and last quarter'] == '100.0 MB, 102.0 MB'


@pytest.mark.slow
def test_a_recording_is_played_through_the_nodes(tmp_path) -> None:
    recording = write_kitti(tmp_path / 'drive', room_drive(5, step_m=0.04)[0])
    command = [sys.executable, '-m', 'segfloor_ros.apps.cli.main', 'benchmark',
               '--nodes', str(recording), '--rate', '0.1']  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert '5, 5' in done.stdout
    for node in ('stereo_camera', 'stereo_slam', 'occupancy_grid'):
        assert f'{node}: CPU' in done.stdout
