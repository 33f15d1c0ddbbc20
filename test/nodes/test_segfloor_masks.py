"""The node that runs a network: what it publishes, and that late masks reach their keyframe."""

import json
import time

import numpy as np
import pytest
from moving_drive import MovingDrive
from node_messages import CALIBRATION, publish, stereo_messages
from node_messages import MOUNTED as GIVEN
from small_network import constant_network, grey_network
from stereo_room import CAMERA, MOUNT

from segfloor_ros.core.contracts import (
    FLOOR,
    MOVING,
    NO_POINT,
    FloorObservation,
    FloorScan,
    KeyframeFeatures,
    KeyframePath,
)
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.grid.occupancy import FREE, UNKNOWN, OccupancyGrid
from segfloor_ros.core.slam.tracking.images import is_inside
from segfloor_ros.nodes.messages.camera_infos import camera_info_message
from segfloor_ros.nodes.messages.grids import grid_message, grid_of
from segfloor_ros.nodes.messages.images import disparity_message, grey8_image, image_message
from segfloor_ros.nodes.messages.points import features_message
from segfloor_ros.nodes.messages.poses import PathMessages, transform_message
from segfloor_ros.nodes.messages.scans import scan_message
from segfloor_ros.nodes.messages.topics import to_ns
from segfloor_ros.nodes.segfloor_masks import SegfloorMasksNode
from segfloor_ros.nodes.stereo_slam import StereoSlamNode

MOUNTED = (*GIVEN, '-p', 'detect_moving:=false', '-p', 'background:=false')


def image(stamp_ns, dark_columns=30):
    picture = np.full((60, 80), 200, np.uint8)
    picture[:, :dark_columns] = 20
    return image_message(stamp_ns, 'left', picture)


def network(tmp_path, **changes):
    roles = {'width': 80, 'height': 60, 'moves': ['dark'], 'floor': ['light']}
    return grey_network(tmp_path / 'n.onnx', **(roles | changes))


def test_images_and_keyframes_are_labelled(make_graph, tmp_path):
    graph = make_graph('-p', f'network:={network(tmp_path)}')
    names = ('dynamic_mask', 'semantic_labels', 'semantic_classes', 'keyframe/semantic_mask')
    heard = {name: graph.collect(name) for name in names}
    graph.add(SegfloorMasksNode())
    graph.until(lambda: heard['semantic_classes'], 'the names of the classes')
    said = json.loads(heard['semantic_classes'][0].data)
    assert said['names'] == {'0': 'dark', '1': 'light'} and said['moves'] == ['dark']
    publish(graph, {'left/image_raw': image(5), 'keyframe/left/image_rect': image(5, 50)})
    graph.until(lambda: heard['semantic_labels'] and heard['keyframe/semantic_mask'], 'both')
    assert to_ns(heard['dynamic_mask'][0].header.stamp) == 5
    mask = grey8_image(heard['dynamic_mask'][0], '')
    np.testing.assert_array_equal(mask, np.where(np.arange(80) < 30, 255, 0)[None].repeat(60, 0))
    labels = grey8_image(heard['semantic_labels'][0], '')
    np.testing.assert_array_equal(labels, (mask == 0).astype(np.uint8))
    of_keyframe = grey8_image(heard['keyframe/semantic_mask'][0], '')
    assert (of_keyframe[:, :50] == MOVING).all() and (of_keyframe[:, 50:] == FLOOR).all()


def test_of_a_network_for_keyframes_alone_only_their_images_are_looked_at(make_graph, tmp_path):
    graph = make_graph('-p', f'network:={network(tmp_path, every=0)}')
    masks = graph.collect('dynamic_mask')
    graph.add(SegfloorMasksNode())
    inputs: dict = {}
    for stamp_ns in (1, 2, 3):
        inputs = publish(graph, {'left/image_raw': image(stamp_ns)}, inputs)
    publish(graph, {'keyframe/left/image_rect': image(2)}, inputs)
    graph.until(lambda: masks, 'the mask of the keyframe')
    assert [to_ns(mask.header.stamp) for mask in masks] == [2]


def test_a_network_that_sees_what_moves_everywhere_is_named_in_the_diagnostics(
    make_graph, tmp_path
):
    file = constant_network(tmp_path / 'n.onnx', 'person', ['person'], moves=['person'])
    graph = make_graph('-p', f'network:={file}')
    masks = graph.collect('dynamic_mask')
    node = graph.add(SegfloorMasksNode())
    publish(graph, {'left/image_raw': image(5)})
    graph.until(lambda: masks, 'a mask')
    assert not grey8_image(masks[0], '').any()
    node.find_problems()
    assert '100 % of an image' in str(node.reporter.health.problems)


def test_without_a_network_the_node_ends_in_one_line(make_graph):
    make_graph()
    with pytest.raises(InputError, match='is no ONNX file'):
        SegfloorMasksNode()


def test_a_mask_that_comes_after_its_keyframe_takes_its_points_back(make_graph):
    drive = MovingDrive(lambda index: (2.6, 0.3))
    graph = make_graph(*MOUNTED)
    features = graph.collect('keyframe/features')
    node = graph.add(StereoSlamNode())
    inputs: dict = {}
    for index in range(2):
        frame = drive.frame(index)
        inputs = publish(graph, stereo_messages(frame), inputs)
        graph.until(lambda: features, 'the keyframe')
        if index == 0:
            keyframe = node.slam.map.keyframes[0]
            on_board = is_inside(drive.mask(0), keyframe.observations.uvd_px[:, :2])
            on_board &= keyframe.point_id != NO_POINT
            assert on_board.sum() > 20
            mask = image_message(frame.stamp_ns, 'left', drive.mask(0))
            inputs = publish(graph, {'dynamic_mask': mask}, inputs)
            graph.until(lambda: frame.stamp_ns in node.masks.images, 'the mask')  # noqa: B023
    graph.until(lambda: (keyframe.point_id[on_board] == NO_POINT).all(), 'points taken back')
    assert (keyframe.point_id != NO_POINT).sum() > 50


def test_each_map_comes_with_the_classes_of_its_cells(make_graph, tmp_path):
    """A plain floor of one class, and a mount, a path and a map to lay it on."""
    shape = (CAMERA.height, CAMERA.width)
    file = constant_network(tmp_path / 'n.onnx', 'floor', ['wall', 'floor'], floor=['floor'])
    graph = make_graph('-p', f'network:={file}')
    layers, masks = graph.collect('semantic_map'), graph.collect('keyframe/semantic_mask')
    graph.add(SegfloorMasksNode())
    stamp_ns, at = 7, (7, 'left')
    mask = np.full(shape, 127, np.uint8)
    mask[shape[0] * 3 // 4 :] = FLOOR
    scan = FloorScan(0.0, 0.1, np.zeros(3, np.float32), range_max_m=8.0)
    nothing = np.zeros(shape, np.float32)
    floor = FloorObservation(nothing, mask, np.zeros(shape[0]), scan, 64.0, None)
    features = KeyframeFeatures(
        np.zeros((1, 2), np.float32), np.array([NO_POINT], np.int32), np.zeros((1, 3))
    )
    T = transform_message(stamp_ns, 'base_link', 'left', MOUNT.T_base_left)
    picture = image_message(*at, np.full(shape, 90, np.uint8))
    inputs = publish(graph, {'camera_mount': T, 'keyframe/left/image_rect': picture})
    graph.until(lambda: masks, 'what the network says of the keyframe')
    keyframe = {
        'keyframe/left/camera_info': camera_info_message(*at, CALIBRATION.left),
        'keyframe/disparity': disparity_message(*at, CAMERA, floor),
        'keyframe/floor_mask': image_message(*at, mask),
        'keyframe/floor_scan': scan_message(stamp_ns, 'base_link', scan),
        'keyframe/features': features_message(*at, features),
        'keyframe/path': PathMessages('map').next(
            stamp_ns, KeyframePath(np.array([stamp_ns]), np.eye(4)[None])
        ),
    }
    inputs = publish(graph, keyframe, inputs)
    cells = np.full((30, 60), FREE, np.int8)
    cells[:, :30] = UNKNOWN
    grid = OccupancyGrid(cells, 0.1, (-3.0, -1.5))
    end_s = time.monotonic() + 20
    while not layers and time.monotonic() < end_s:
        inputs = publish(graph, {'map': grid_message(stamp_ns, 'map', grid)}, inputs)
        graph.comes(lambda: layers, 0.5)
    layer = grid_of(layers[-1])
    assert layers[-1].header.frame_id == 'map' and layer.cells.shape == (30, 60)
    assert set(np.unique(layer.cells)) == {UNKNOWN, 1}
    assert (layer.cells[:, :30] == UNKNOWN).all()
    ahead = np.nonzero(layer.cells[15] == 1)[0] * 0.1 - 3.0
    assert 0.2 < ahead.min() < 1.0
