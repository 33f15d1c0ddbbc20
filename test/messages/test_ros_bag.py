"""Bags read by rosbag2_py against the same bags read by rosbags."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from segfloor_ros.camera.model import StereoCameraSettings
from segfloor_ros.camera.sources import bag_file, open_source
from segfloor_ros.camera.sources.bag_file import read_rosbag2_with
from segfloor_ros.errors import InputError
from segfloor_ros.messages.ros_bag import use_rosbag2_py

DEMO = Path(bag_file.__file__).parents[2] / 'simulation' / 'demo' / 'drive.mcap'


@pytest.fixture
def rosbag2_py(monkeypatch):
    """Make rosbag2_py importable: the real one where ROS has it, else one that rosbags backs."""
    if importlib.util.find_spec('rosbag2_py') is None:
        monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / 'ros_stand_in'))
    yield
    read_rosbag2_with(None)
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
