"""`tools.benchmark_nodes`: its drive to and fro, the command for real."""

import subprocess
import sys

import numpy as np
import pytest
from stereo_drive import room_drive, write_kitti
from stereo_room import CAMERA

from segfloor_ros.apps.recordings import open_source
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.errors import InputError
from segfloor_ros.nodes.configuration import resolve
from tools.endless_drive import write_endless_drive

pytest.importorskip('rclpy')

from segfloor_ros.nodes.messages.topics import NODES
from tools import idle_nodes
from tools.benchmark_nodes import idle_table


def open_recording(folder):
    return open_source(StereoCameraSettings(input=str(folder)))


def test_the_endless_drive_goes_to_and_fro_at_the_pace_of_the_recording(tmp_path) -> None:
    frames, _ = room_drive(4)
    source = open_recording(write_kitti(tmp_path / 'drive', frames))
    endless = open_recording(write_endless_drive(source, tmp_path / 'endless', 1.0))
    found = list(endless.frames())
    assert [frame.stamp_ns for frame in found] == [i * 100_000_000 for i in range(10)]
    for frame, place in zip(found, (0, 1, 2, 3, 2, 1, 0, 1, 2, 3), strict=True):
        np.testing.assert_array_equal(frame.left, frames[place].left)
        np.testing.assert_array_equal(frame.right, frames[place].right)
    assert endless.camera.baseline_m == pytest.approx(CAMERA.baseline_m)
    assert (endless.camera.fx, endless.camera.cy) == pytest.approx((CAMERA.fx, CAMERA.cy))


def test_a_single_frame_is_no_drive(tmp_path) -> None:
    source = open_recording(write_kitti(tmp_path / 'drive', room_drive(1)[0]))
    with pytest.raises(InputError, match='two frames'):
        write_endless_drive(source, tmp_path / 'endless', 1.0)


@pytest.mark.slow
def test_a_soak_loses_nothing(tmp_path) -> None:
    drive = write_kitti(tmp_path / 'drive', room_drive(5, step_m=0.04)[0])
    command = [sys.executable, '-m', 'tools.benchmark_nodes', str(drive),
               '--rate', '10', '--soak-minutes', '0.03']  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert '18, 18' in done.stdout
    for node in ('stereo_camera', 'stereo_slam', 'occupancy_grid'):
        assert f'{node}: CPU' in done.stdout


@pytest.mark.slow
def test_what_nodes_cost_that_do_nothing_is_told(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(idle_nodes, 'SETTLE_S', 0.5)
    monkeypatch.setattr(idle_nodes, 'ALL_IDLE_S', 0.1)
    frames, _ = room_drive(2)
    source = open_recording(write_kitti(tmp_path / 'drive', frames))
    stands = write_endless_drive(source, tmp_path / 'stands', 20.0, stands=True)
    configuration = resolve(None, ('stereo_slam.num_features=700',),
                            stereo_camera={'input': str(stands)})  # fmt: skip
    monkeypatch.setenv('ROS_DOMAIN_ID', '')
    shares = idle_nodes.measure_idle(configuration, 2.0)
    assert tuple(shares) == idle_nodes.PHASES
    assert all(set(by_node) == set(NODES) for by_node in shares.values())
    waiting, standing = shares['no images'], shares['camera stands']
    assert 0 < waiting['stereo_slam'] < standing['stereo_slam'] < 4
    table = idle_table(shares)
    assert table.row_count == len(NODES)
    assert [column.header for column in table.columns] == ['node', *idle_nodes.PHASES]


def test_a_camera_that_stands_sends_its_first_frame(tmp_path) -> None:
    frames, _ = room_drive(3)
    source = open_recording(write_kitti(tmp_path / 'drive', frames))
    stands = open_recording(write_endless_drive(source, tmp_path / 'stands', 0.5, stands=True))
    found = list(stands.frames())
    assert len(found) == 5
    for frame in found:
        np.testing.assert_array_equal(frame.right, frames[0].right)
