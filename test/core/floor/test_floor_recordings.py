"""Masks on recordings: one with exact truth, one with outlines drawn by hand."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from floor_scenes import FLOORS, MOUNT, SMALL_CAMERA, Scene, floor_patch, wall

from segfloor_ros.apps.evaluation.floor import count_pixels, draw_outline, read_outlines
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.rectification import deblocked
from segfloor_ros.core.contracts import FLOOR, Mount
from segfloor_ros.core.floor.disparity.profile import FloorLine
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings
from segfloor_ros.nodes.configuration import resolve

OUTLINES = Path(__file__).with_name('library_floor_outlines.yaml')
LIBRARY_MOUNT = Mount(1.27, np.radians(5.9), np.radians(0.4))
ROVER_MOUNT = Mount(0.255, np.radians(26.3), np.radians(2.2))


def test_corridor(shared_data):
    folder = shared_data / 'corridor'
    camera = StereoCamera(640, 480, 320.0, 320.0, 320.0, 240.0, 0.12)
    mount = Mount(0.30, 0.1222)
    line = FloorLine.of(camera, mount)
    disparity = np.maximum(line.slope * (np.arange(480) - line.horizon), 1e-6)
    depth = (camera.disparity_times_depth / disparity)[:, None]
    stage = FloorSegmentation(camera, FloorSegmentationSettings())
    hit = called = wanted = found = 0
    for i in range(0, 255, 30):
        pair = [cv2.imread(str(folder / f'image_{k}' / f'{i:06d}.png'), 0) for k in (0, 1)]
        floor = cv2.imread(str(folder / 'floor' / f'{i:06d}.png'), 0) > 0
        mask = stage.process(*pair, mount).mask == FLOOR
        near = floor & (depth > 0.5) & (depth < 6.0)
        hit, called = hit + (mask & floor).sum(), called + mask.sum()
        found, wanted = found + (mask & near).sum(), wanted + near.sum()
    assert hit / called > 0.99
    # Every frame on its own: what the right camera does not see stays partly unknown.
    assert found / wanted > 0.96


def rectified_reader(folder: Path):
    maps, projection = {}, np.zeros((3, 4))
    for side in ('left', 'right'):
        text = yaml.safe_load((folder / f'{side}.yaml').read_text())
        values = {
            key: np.array(text[key]['data'], float).reshape(shape)
            for key, shape in (
                ('camera_matrix', (3, 3)),
                ('distortion_coefficients', (-1,)),
                ('rectification_matrix', (3, 3)),
                ('projection_matrix', (3, 4)),
            )
        }
        projection = values['projection_matrix']
        maps[side] = cv2.initUndistortRectifyMap(
            values['camera_matrix'],
            values['distortion_coefficients'],
            values['rectification_matrix'],
            projection[:, :3],
            (320, 240),
            cv2.CV_32FC1,
        )
    P = projection
    camera = StereoCamera(320, 240, P[0, 0], P[1, 1], P[0, 2], P[1, 2], -P[0, 3] / P[0, 0])

    def read(i: int):
        return [
            cv2.remap(
                deblocked(cv2.imread(str(folder / side / f'{side}{i}.jpg'), 0)),
                *maps[side],
                cv2.INTER_LINEAR,
            )
            for side in ('left', 'right')
        ]

    return camera, read


def test_library(shared_data):
    camera, read = rectified_reader(shared_data / 'library')
    stage = FloorSegmentation(camera, FloorSegmentationSettings())
    counts = np.zeros(5, np.int64)
    for i, outline in read_outlines(OUTLINES).items():
        mask = stage.process(*read(i + 1), LIBRARY_MOUNT).mask
        counts += count_pixels(mask, draw_outline(outline, mask.shape))
    hit, false, missed, *_ = counts
    assert hit / (hit + false) > 0.93
    assert hit / (hit + missed) > 0.75


@pytest.mark.parametrize('floor_kind', FLOORS)
def test_weak_texture_survives_compression(floor_kind):
    """What a cheap camera sends: blocks of 8 by 8 pixels that hardly differ within."""

    def compressed(image):
        _, data = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, 30])
        return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)

    scene = Scene([floor_patch(**{**floor_kind, 'contrast': 4.0}), wall(3.0)], SMALL_CAMERA)
    left, right, floor, depth = scene.render()
    recall = {}
    for name, treat in (('as it is', lambda image: image), ('deblocked', deblocked)):
        pair = (treat(compressed(image)) for image in (left, right))
        stage = FloorSegmentation(SMALL_CAMERA, FloorSegmentationSettings())
        called = stage.process(*pair, MOUNT).mask == FLOOR
        assert (called & floor).sum() / called.sum() > 0.99
        near = floor & (depth > 0.5)
        recall[name] = (called & near).sum() / near.sum()
    assert recall['deblocked'] > max(0.92, recall['as it is'] + 0.04)


@pytest.mark.slow
def test_what_lies_right_before_a_rover_is_not_floor(shared_data):
    """A coil of rope, tyres and a stone: black, plain, or nearer than most of the floor."""
    settings = resolve(None, (), stereo_camera={'input': str(shared_data / 'rover')})
    source = open_source(settings.stereo_camera)
    stage = FloorSegmentation(source.camera, FloorSegmentationSettings())
    outlines = read_outlines(Path(__file__).with_name('rover_floor_outlines.yaml'))
    counts = np.zeros(5, np.int64)
    for frame in source.frames():
        if frame.index in (37, 39, 60, 341, 364):
            mask = stage.process(frame.left, frame.right, ROVER_MOUNT).mask
            counts += count_pixels(mask, draw_outline(outlines[frame.index], mask.shape))
        elif frame.index > 364:
            break
    hit, false, missed, _, pixels = counts
    assert false / (pixels - hit - missed) < 0.06
    assert hit / (hit + missed) > 0.7
