"""Scores of masks over depth and height, worked out by hand, and a simulated drive."""

import numpy as np
import pytest

from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.simulation import FrameTruth
from segfloor_ros.apps.simulation.world import RenderingError
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.contracts import Mount
from segfloor_ros.nodes.configuration import resolve
from tools.floor_masks import (
    SCENES,
    count,
    floor_scene,
    mount_of,
    read_truth,
    render_floor,
    score_recording,
)

CAMERA = StereoCamera(4, 3, 100.0, 100.0, 1.5, 1.0, 0.1)


def test_pixels_are_counted_by_depth_and_height():
    # A level camera 0.3 m high: row 2 looks down by one pixel, so at depth d it is 0.01 d lower.
    mount = Mount(0.3)
    depth_m = np.full((3, 4), 1.0, np.float32)
    depth_m[2] = (1.0, 28.0, 24.0, 30.0)
    floor = np.zeros((3, 4), np.uint8)
    floor[2, 1:] = 255
    mask = np.zeros((3, 4), np.uint8)
    mask[2] = (255, 255, 0, 255)
    truth = FrameTruth(floor, depth_m, 10 / depth_m)
    counts = count(mask, truth, CAMERA, mount.T_base_left)
    # Three are called floor, two of them are; all of the floor is farther than six metres.
    assert counts[:4].tolist() == [2, 3, 0, 0]
    near = FrameTruth(floor, np.where(floor > 0, 2.0, depth_m), truth.disparity_px)
    assert count(mask, near, CAMERA, mount.T_base_left)[2:4].tolist() == [2, 3]


def test_low_things_are_counted():
    mount = Mount(0.06)
    depth_m = np.full((3, 4), 1.0, np.float32)  # heights 0.07, 0.06 and 0.05 m by row
    mask = np.zeros((3, 4), np.uint8)
    mask[1, :3] = 255
    truth = FrameTruth(np.zeros((3, 4), np.uint8), depth_m, 10 / depth_m)
    assert count(mask, truth, CAMERA, mount.T_base_left)[4:6].tolist() == [3, 12]
    sill = FrameTruth(np.full((3, 4), 255, np.uint8), depth_m, 10 / depth_m)
    counts = count(mask, sill, CAMERA, Mount(0.03).T_base_left)  # heights 0.04, 0.03 and 0.02
    assert counts[4:].tolist() == [0, 0, 0, 4]


@pytest.mark.parametrize('name', SCENES)
def test_scenes_can_be_opened(name):
    scene = floor_scene(name)
    mount = mount_of(scene)
    assert mount.height_m == scene.camera.height_m
    assert np.degrees(mount.roll_rad) == pytest.approx(scene.camera.roll_deg)


@pytest.mark.slow
def test_a_low_box_is_not_floor(tmp_path):
    scene, started = open_scene('low_box'), []

    def announce(description, frames):
        started.append((description, frames))
        return lambda done: None

    try:
        recording = render_floor('low_box', scene, tmp_path, announce)
    except RenderingError as error:
        pytest.skip(str(error))
    assert [description for description, _ in started] == ['rendering low_box']
    assert len(list((recording / 'floor').iterdir())) == started[0][1]
    truth = read_truth(recording, 0, open_source(StereoCameraSettings(input=str(recording))).camera)
    assert truth.depth_m[truth.floor > 0].max() < truth.depth_m.max()
    score = score_recording('low_box', recording, mount_of(scene), resolve())
    assert score.precision > 0.99
    assert score.recall > 0.97
    assert score.low_called_floor < 0.08
    assert np.isnan(score.sill_called_floor)
