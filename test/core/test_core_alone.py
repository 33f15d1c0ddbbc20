"""The core runs with nothing plugged in, and loads no plugin."""

import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from stereo_drive import room_drive
from stereo_room import CAMERA, MOUNT

from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.pipeline import KeyframeStages, Pipeline
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.stereo_slam import StereoSlam
from segfloor_ros.core.timing import StageTimes
from segfloor_ros.nodes.configuration import resolve

FRAMES = 12


def core_pipeline(configuration: Configuration) -> Pipeline:
    """Return the stages with nothing plugged in."""
    times = StageTimes()
    slam = StereoSlam(CAMERA, configuration.stereo_slam, MOUNT, times=times)
    return Pipeline(slam, partial(KeyframeStages, CAMERA, configuration, times), times)


def test_the_core_maps_a_room_without_plugins() -> None:
    frames, T_world_base = room_drive(FRAMES)
    pipeline = core_pipeline(resolve(stereo_slam={'num_features': 600}))
    results = [result for frame in frames for result in pipeline.process(frame)]
    results += pipeline.finish_tracking()
    grid = pipeline.finish()
    assert [result.tracked for result in results] == [True] * FRAMES
    last = results[-1].T_map_odom @ results[-1].T_odom_base
    true = np.linalg.inv(T_world_base[0]) @ T_world_base[-1]
    np.testing.assert_allclose(last[:2, 3], true[:2, 3], atol=0.02)
    assert grid is not None and grid.area_m2(grid.cells == 0) > 1.0
    assert pipeline.slam.sensors.remarks == {} and pipeline.slam.rig_check.as_dicts() == []


def test_slam_that_keeps_no_maps_saves_and_loads_none() -> None:
    frames, _ = room_drive(3)
    slam = StereoSlam(CAMERA, StereoSlamSettings(num_features=600), MOUNT)
    for frame in frames:
        slam.process(frame)
    arrays = slam.to_arrays()
    assert 'keyframe_stamp_ns' not in arrays
    with pytest.raises(ValueError, match='keeps no maps'):
        slam.load(arrays, MOUNT, localize=False)


def test_the_core_loads_no_plugin() -> None:
    words = (
        'import sys, segfloor_ros.core.pipeline; '
        "print([name for name in sys.modules if 'segfloor_ros.core.plugins' in name])"
    )
    found = subprocess.run([sys.executable, '-c', words], capture_output=True, text=True)
    assert found.stdout.strip() == '[]', found.stderr
