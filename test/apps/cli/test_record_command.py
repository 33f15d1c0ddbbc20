"""`segfloor record`: topics of a live graph, and a camera of this machine."""

import os
import shutil
import signal
import struct
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import segfloor
from node_chain import CALIBRATION, SIDES
from rclpy.duration import Duration
from stereo_drive import room_drive

from segfloor_ros.apps.cli.topic_recorder import TopicRecord, stamp_of
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.nodes.messages.camera_infos import camera_info_message
from segfloor_ros.nodes.messages.images import image_message

STOP_S = 30.0
ARRIVAL = Duration(seconds=30)
FRAMES = 12
LOST = 7


@pytest.fixture
def recording(make_graph, tmp_path):
    """A graph with the topics of a camera, and a recorder of it, which ends with the test."""
    graph = make_graph()
    names = [f'{side}/{what}' for side in SIDES for what in ('camera_info', 'image_raw')]
    publishers = {name: graph.publisher(name) for name in names}
    words = [
        sys.executable,
        '-m',
        'segfloor_ros.apps.cli.main',
        'record',
        str(tmp_path / 'out.mcap'),
    ]
    process = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=dict(os.environ)
    )
    try:
        yield SimpleNamespace(graph=graph, publishers=publishers, process=process)
    finally:
        process.kill()
        process.communicate(timeout=STOP_S)


def test_what_a_camera_publishes_is_in_the_bag_and_a_lost_frame_is_counted(
    recording, tmp_path
) -> None:
    graph, publishers = recording.graph, recording.publishers
    graph.connected(list(publishers.values()))
    # The other side may see the match a moment later.
    graph.comes(lambda: False, 0.5)
    frames, _ = room_drive(FRAMES)
    for frame in frames[:LOST] + frames[LOST + 1 :]:
        for side in SIDES:
            info = camera_info_message(frame.stamp_ns, f'{side}_eye', getattr(CALIBRATION, side))
            image = image_message(frame.stamp_ns, f'{side}_eye', getattr(frame, side))
            publishers[f'{side}/camera_info'].publish(info)
            publishers[f'{side}/image_raw'].publish(image)
    assert all(publisher.wait_for_all_acked(ARRIVAL) for publisher in publishers.values())
    recording.process.send_signal(signal.SIGINT)
    out, err = recording.process.communicate(timeout=STOP_S)
    assert recording.process.returncode == 0, err
    rows = {line.split('│')[1].strip(): line.split('│') for line in out.splitlines() if '│' in line}
    assert set(rows) == {f'/{name}' for name in publishers}
    assert [rows[f'/{side}/image_raw'][2].strip() for side in SIDES] == [str(FRAMES - 1)] * 2
    assert [rows[f'/{side}/image_raw'][5].strip() for side in SIDES] == ['1', '1']
    source = open_source(StereoCameraSettings(input=str(tmp_path / 'out.mcap')))
    found = list(source.frames())
    assert [f.stamp_ns for f in found] == [f.stamp_ns for f in frames if f.index != LOST]
    assert np.array_equal(found[0].left, frames[0].left)


RECORDER = """
import sys, time
from pathlib import Path
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.recordings.bag_writer import BagWriter, ImageCoding
from segfloor_ros.core.camera.settings import StereoCameraSettings
source = open_source(StereoCameraSettings(input=sys.argv[1]))
with BagWriter(Path(sys.argv[2]), source.calibration, ImageCoding.raw, keeps=True) as bag:
    for pair in source.raw_pairs():
        bag.write(pair)
    print(flush=True)
    time.sleep(60)
"""


@pytest.mark.slow
@pytest.mark.parametrize('name', ['out.mcap', pytest.param('out', marks=pytest.mark.slow)])
def test_what_a_killed_recorder_wrote_is_read(tmp_path, name) -> None:
    """The file or folder is there by its name from the beginning."""
    pytest.importorskip('rosbags')
    from stereo_drive import write_kitti

    frames, out = room_drive(40)[0], tmp_path / 'bags' / name
    drive = write_kitti(tmp_path / 'drive', frames)
    words = [sys.executable, '-c', RECORDER, str(drive), str(out)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, cwd=Path(__file__).parents[3]) as process:
        process.stdout.readline()
        process.kill()
    found = list(open_source(StereoCameraSettings(input=str(out))).frames())
    assert len(found) > 0.8 * len(frames)
    assert [f.stamp_ns for f in found] == [f.stamp_ns for f in frames[: len(found)]]
    assert np.array_equal(found[-1].left, frames[len(found) - 1].left)
    done = segfloor('convert', drive, tmp_path / 'next.mcap')  # removes what is left
    assert done.returncode == 0, done.stderr
    assert [path.name for path in out.parent.iterdir()] == [name]


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGHUP, signal.SIGTERM])
def test_a_signal_completes_the_recording(recording, tmp_path, number) -> None:
    graph, publishers = recording.graph, recording.publishers
    graph.connected(list(publishers.values()))
    graph.comes(lambda: False, 0.5)
    for frame in room_drive(3)[0]:
        for side in SIDES:
            info = camera_info_message(frame.stamp_ns, f'{side}_eye', getattr(CALIBRATION, side))
            image = image_message(frame.stamp_ns, f'{side}_eye', getattr(frame, side))
            publishers[f'{side}/camera_info'].publish(info)
            publishers[f'{side}/image_raw'].publish(image)
    assert all(publisher.wait_for_all_acked(ARRIVAL) for publisher in publishers.values())
    recording.process.send_signal(number)
    _, err = recording.process.communicate(timeout=STOP_S)
    assert recording.process.returncode == 0, err
    assert [path.name for path in tmp_path.iterdir()] == ['out.mcap']
    source = open_source(StereoCameraSettings(input=str(tmp_path / 'out.mcap')))
    assert len(list(source.frames())) == 3


def test_where_nothing_comes_no_file_is_left(make_graph, tmp_path) -> None:
    make_graph()
    done = segfloor('record', tmp_path / 'out.mcap', '--seconds', 1, '--topics', '/nobody/.*')
    assert done.returncode == 2
    assert 'nothing came' in done.stderr and done.stderr.count('\n') == 1
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_ends_the_recording_with_a_whole_file(tmp_path, monkeypatch) -> None:
    pytest.importorskip('rosbags')
    from stereo_drive import write_kitti

    from segfloor_ros.apps.recordings.bag_writer import BagWriter, convert

    drive = write_kitti(tmp_path / 'drive', room_drive(3)[0])
    source = open_source(StereoCameraSettings(input=str(drive)))
    with BagWriter(tmp_path / 'out.mcap', source.calibration) as bag:
        for pair in source.raw_pairs():
            bag.write(pair)
        size = bag.file.bytes
        assert not bag.file.is_disk_full(10.0)
        # Ten more seconds as the last ten fit no more.
        usage = shutil.disk_usage(tmp_path)._replace(free=64_000_000 + size - 1)
        monkeypatch.setattr(shutil, 'disk_usage', lambda path: usage)
        assert bag.file.is_disk_full(10.0)
        assert not bag.file.is_disk_full(20.0)
    assert convert(open_source(StereoCameraSettings(input=str(tmp_path / 'out.mcap'))),
                   tmp_path / 'again.mcap') == 3  # fmt: skip


def cdr(stamp_ns: int, order: str = '<') -> bytes:
    sec, nanosec = divmod(stamp_ns, 10**9)
    return bytes([0, order == '<', 0, 0]) + struct.pack(f'{order}iI', sec, nanosec) + b'rest'


@pytest.mark.parametrize('order', ['<', '>'])
def test_the_stamp_of_a_message_is_read_from_its_bytes(order) -> None:
    assert stamp_of(cdr(3_000_000_007, order)) == 3_000_000_007


def test_frames_that_a_topic_lacks_are_counted_by_its_own_rate() -> None:
    record = TopicRecord('sensor_msgs/msg/Image')
    steps_ms = [33, 34, 33, 100, 33, 33, 67, 40, 33]
    stamps = np.cumsum([0, *steps_ms]) * 1_000_000
    for i, stamp in enumerate(stamps):
        record.take(cdr(int(stamp)), 1.0 + 0.1 * i)
    assert (record.messages, record.dropped) == (10, 3)
    assert record.rate_hz == pytest.approx(10.0)
