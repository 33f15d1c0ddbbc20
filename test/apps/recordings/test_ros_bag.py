"""Bags read and written by rosbag2_py against the same bags by rosbags."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from segfloor_ros.apps.recordings import bag_file, open_source
from segfloor_ros.apps.recordings.bag_file import read_rosbag2_with
from segfloor_ros.apps.recordings.bag_writer import (
    BagWriter,
    ImageCoding,
    NewBag,
    convert,
    write_rosbag2_with,
)
from segfloor_ros.apps.recordings.ros_bag import Rosbag2Writer, use_rosbag2_py
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.contracts import ImuSample, WheelPose
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import make_transform

DEMO = Path(bag_file.__file__).parents[1] / 'simulation' / 'demo' / 'drive.mcap'


@pytest.fixture
def rosbag2_py(monkeypatch):
    """Make rosbag2_py importable: the real one where ROS has it, else one that rosbags backs."""
    if importlib.util.find_spec('rosbag2_py') is None:
        monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / 'ros_stand_in'))
    yield
    read_rosbag2_with(None)
    write_rosbag2_with(None)
    sys.modules.pop('rosbag2_py', None)


def pairs(path: Path, count: int):
    source = open_source(StereoCameraSettings(input=str(path)))
    found = []
    for _, frame in zip(range(count), source.frames(), strict=False):
        found.append(frame)
    return source, found


def test_a_bag_is_read_the_same_by_both(rosbag2_py) -> None:
    plain, expected = pairs(DEMO, 5)
    use_rosbag2_py()
    source, found = pairs(DEMO, 5)
    assert 'rosbag2_py' in sys.modules
    assert source.calibration.camera == plain.calibration.camera
    assert (source.frame_count, source.rate_hz) == (plain.frame_count, plain.rate_hz)
    assert len(found) == 5
    for a, b in zip(found, expected, strict=True):
        assert a.stamp_ns == b.stamp_ns
        np.testing.assert_array_equal(a.left, b.left)
        np.testing.assert_array_equal(a.right, b.right)


def test_without_rosbags_rosbag2_py_is_enough_and_without_both_there_is_one_line(
    rosbag2_py, monkeypatch, tmp_path
) -> None:
    use_rosbag2_py()
    damaged = tmp_path / 'damaged.mcap'
    damaged.write_bytes(DEMO.read_bytes()[:3000])
    with pytest.raises(InputError, match=r'damaged\.mcap: cannot read the bag') as error:
        pairs(damaged, 1)
    assert '\n' not in str(error.value)
    read_rosbag2_with(None)
    for name in [name for name in sys.modules if name.partition('.')[0] == 'rosbags']:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match='pip install rosbags') as error:
        pairs(DEMO, 1)
    assert '\n' not in str(error.value)


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    """Return the messages of a bag in CDR; what fills gaps in it is zero."""
    with AnyReader([path]) as reader:
        serialize = reader.typestore.serialize_cdr
        return [
            (c.topic, stamp, bytes(serialize(reader.deserialize(data, c.msgtype), c.msgtype)))
            for c, stamp, data in reader.messages()
        ]


@pytest.mark.parametrize('coding', ImageCoding)
def test_a_bag_is_written_the_same_by_both(rosbag2_py, tmp_path, coding) -> None:
    settings = StereoCameraSettings(input=str(DEMO), frames=3)
    convert(open_source(settings), tmp_path / 'expected.mcap', coding)
    use_rosbag2_py()
    assert convert(open_source(settings), tmp_path / 'found.mcap', coding) == 3
    assert sys.modules['rosbag2_py'].SequentialWriter.opened == 1
    assert messages(tmp_path / 'found.mcap') == messages(tmp_path / 'expected.mcap')
    assert {path.name for path in tmp_path.iterdir()} == {'expected.mcap', 'found.mcap'}


def test_wheels_imu_and_tf_are_written_the_same_by_both(rosbag2_py, tmp_path) -> None:
    source, _ = pairs(DEMO, 1)
    turn = make_transform(Rotation.from_euler('z', 0.3).as_matrix(), np.array([1.0, 2.0, 0.5]))
    measured = [
        WheelPose(1_000_000_007, turn),
        ImuSample(1_000_000_009, np.array([0.1, 0.2, 0.3]), np.array([0.0, -9.8, 0.1]),
                  np.array([0.02, 0.0, 0.01])),
    ]  # fmt: skip
    for name, library in (('expected', None), ('found', Rosbag2Writer)):
        write_rosbag2_with(library)
        with BagWriter(tmp_path / f'{name}.mcap', source.calibration) as bag:
            for measurement in measured:
                bag.write_measurement(measurement)
    found = messages(tmp_path / 'found.mcap')
    assert {topic for topic, *_ in found} == {'/wheel_odometry', '/imu', '/tf_static'}
    assert found == messages(tmp_path / 'expected.mcap')


def test_after_an_error_rosbag2_py_leaves_nothing(rosbag2_py, tmp_path) -> None:
    use_rosbag2_py()
    with pytest.raises(KeyboardInterrupt), NewBag(tmp_path / 'drive.mcap') as bag:
        bag.write('/imu', 'sensor_msgs/msg/Imu', 1, b'\0\1\0\0' + 8 * b'\0')
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
