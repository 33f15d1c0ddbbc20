"""What moves, over DDS: masks that come in, and what the nodes tell of it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from moving_drive import MovingDrive
from node_messages import (
    AT_ORIGIN,
    CALIBRATION,
    MOUNTED,
    SCAN,
    STAMP_NS,
    pose_message_at,
    publish,
    stereo_messages,
)
from stereo_room import CAMERA, MOUNT, planar_pose

from segfloor_ros.apps.cli.explore_session import Pilot
from segfloor_ros.apps.cli.replay_recorder import DriveNotes
from segfloor_ros.apps.evaluation.exploration import Exploration
from segfloor_ros.apps.navigation import Body, Explorer
from segfloor_ros.core.camera.rectification import StereoRectifier
from segfloor_ros.core.contracts import FLOOR, MovingPoints, SparseCloud
from segfloor_ros.core.slam.tracking.images import is_inside
from segfloor_ros.nodes.floor_segmentation import FloorSegmentationNode
from segfloor_ros.nodes.messages.diagnostics import Level, Status
from segfloor_ros.nodes.messages.images import grey8_image, image_message
from segfloor_ros.nodes.messages.odometry import odometry_message, pose_with_covariance_message
from segfloor_ros.nodes.messages.points import (
    FEATURE_DTYPE,
    MOVING_DTYPE,
    cloud_array,
    moving_points_message,
    sparse_cloud_message,
)
from segfloor_ros.nodes.messages.poses import transform_message
from segfloor_ros.nodes.messages.scans import free_scan_message, obstacle_scan_message
from segfloor_ros.nodes.messages.topics import to_ns
from segfloor_ros.nodes.slam_sensors import MaskInput
from segfloor_ros.nodes.stereo_slam import StereoSlamNode


def crossing(index):
    return (0.03 * index + 1.6, -1.0 + 0.05 * index)


def test_masks_on_dynamic_mask_keep_features_out_and_come_back_with_the_keyframe(make_graph):
    drive = MovingDrive(crossing)
    graph = make_graph(*MOUNTED, '-p', 'detect_moving:=false', '-p', 'mask_timeout_s:=0.0')
    features, masks = graph.collect('keyframe/features'), graph.collect('keyframe/moving_mask')
    node = graph.add(StereoSlamNode())
    inputs: dict = {}
    for index in range(8):
        frame = drive.frame(index)
        mask = image_message(frame.stamp_ns, 'left', drive.mask(index))
        inputs = publish(graph, {'dynamic_mask': mask}, inputs)
        stamp_ns = frame.stamp_ns
        graph.until(lambda stamp_ns=stamp_ns: stamp_ns in node.masks.images, 'the mask')
        publish(graph, stereo_messages(frame), inputs)
        graph.until(
            lambda stamp_ns=stamp_ns: (
                stamp_ns in {s.stamp_ns for s in graph.reports('stereo_slam')}
            ),
            f'frame {index}',
        )
    graph.until(lambda: len(masks) >= 2 and len(features) == len(masks), 'keyframes')
    for cloud, message in zip(features, masks, strict=True):
        assert cloud.header.stamp == message.header.stamp
        true_mask = drive.mask(round(to_ns(message.header.stamp) * 1e-8))
        found = grey8_image(message, '')
        assert (found[true_mask > 0] == 255).all() and 0.03 < (found > 0).mean() < 0.3
        points = cloud_array(cloud, FEATURE_DTYPE, '')
        uv = np.stack([points['u'], points['v']], axis=1)
        assert len(uv) > 300 and not is_inside(true_mask, uv).any()


def test_moving_points_tell_what_crosses_and_diagnostics_count_it(make_graph):
    drive = MovingDrive(lambda index: crossing(index - 8) if index >= 8 else None)
    graph = make_graph(*MOUNTED)
    clouds = graph.collect('moving_points')
    graph.add(StereoSlamNode())
    inputs: dict = {}
    for index in range(24):
        frame = drive.frame(index)
        inputs = publish(graph, stereo_messages(frame), inputs)
        stamp_ns = frame.stamp_ns
        graph.until(
            lambda stamp_ns=stamp_ns: (
                stamp_ns in {s.stamp_ns for s in graph.reports('stereo_slam')}
            ),
            f'frame {index}',
        )
    counts = {s.stamp_ns: int(s.values['moving']) for s in graph.reports('stereo_slam')}
    graph.until(lambda: len(clouds) >= 5, 'moving points')
    assert clouds[0].header.frame_id == 'map' and clouds[0].width == 0
    full = [cloud for cloud in clouds if cloud.width > 30]
    assert full and all(counts[to_ns(c.header.stamp)] == c.width for c in clouds)
    points = cloud_array(full[-1], MOVING_DTYPE, '')
    x, _ = crossing(round(to_ns(full[-1].header.stamp) * 1e-8) - 8)
    assert abs(np.median(points['x']) - x) < 0.15
    assert np.isfinite(points['vy']).any()


def make_pilot(graph):
    graph.tester.notes = DriveNotes(lambda: 0.0)
    explorer, found = Explorer(Body(0.3, 0.5, 0.3, 1.0), 0), Exploration((0.0, 0.0, 0.0))
    graph_of_pilot = SimpleNamespace(recorder=graph.tester)
    return explorer, Pilot(graph_of_pilot, explorer, found, lambda *_: None)


def command(graph, pilot, stamp_ns, T_map_base, scan):
    """Send what the nodes make of a frame, and wait for the command that answers it."""
    zeros = np.zeros((6, 6))
    answer = Status(stamp_ns, 'stereo_slam', Level.OK, '', {'tracked': '1'})
    graph.tester.notes.answers[stamp_ns] = answer
    publish(
        graph,
        {
            'pose': pose_with_covariance_message(stamp_ns, 'map', T_map_base, zeros),
            'scan': free_scan_message(stamp_ns, 'base_link', scan),
            'obstacle_scan': obstacle_scan_message(stamp_ns, 'base_link', scan),
            'ground_truth': odometry_message(stamp_ns, 'world', 'base_link', AT_ORIGIN, zeros),
        },
    )
    graph.until(lambda: pilot.answer() or stamp_ns in pilot.found.poses, 'a command')


def test_what_stands_counts_once_for_the_explorer_until_it_is_told_again(make_graph):
    graph, ahead = make_graph(), planar_pose(0.0, 0.0, 0.0)
    explorer, pilot = make_pilot(graph)
    clouds = graph.collect('obstacle_points')
    posts = np.array([[1.2, 0.0, 0.3], [-1.2, 0.0, 0.3]], np.float32)
    for k, post in enumerate(posts):
        cloud = SparseCloud(np.array([k], np.int32), post[None])
        publish(graph, {'obstacle_points': sparse_cloud_message(STAMP_NS + k, 'map', cloud)})
        graph.until(lambda k=k: len(clouds) > k, 'a keyframe')
    command(graph, pilot, STAMP_NS, planar_pose(0.0, 0.0, np.pi / 2), SCAN)
    np.testing.assert_allclose(explorer.obstacles, posts[:, :2], atol=1e-6)
    command(graph, pilot, STAMP_NS + 1, ahead, SCAN)
    np.testing.assert_allclose(explorer.obstacles, posts[1:, :2], atol=1e-6)
    command(graph, pilot, STAMP_NS + 2, planar_pose(0.0, 0.0, np.pi / 2), SCAN)
    np.testing.assert_allclose(explorer.obstacles, posts[1:, :2], atol=1e-6)


def test_who_walks_by_is_in_the_way_of_the_explorer(make_graph):
    graph, T_map_base = make_graph(), planar_pose(0.5, 0.0, 0.3)
    explorer, pilot = make_pilot(graph)
    seen = replace(SCAN, ranges_m=SCAN.ranges_m.copy(), range_max_m=5.0)
    seen.ranges_m[3] = 1.2
    legs = replace(seen, obstacle_m=np.where(seen.ranges_m < 1.5, seen.ranges_m, np.nan))
    clouds = graph.collect('moving_points')
    walking = MovingPoints(np.array([[2.0, 0.2, 0.4]]), np.full((1, 3), np.nan))
    publish(graph, {'moving_points': moving_points_message(STAMP_NS, 'map', walking)})
    graph.until(lambda: clouds, 'what walks')
    command(graph, pilot, STAMP_NS, T_map_base, legs)
    np.testing.assert_allclose(explorer.obstacles, [[2.0, 0.2]], atol=1e-6)
    place = [0.5 + 1.2 * np.cos(0.55), 1.2 * np.sin(0.55)]
    np.testing.assert_allclose(explorer.near, [place], atol=1e-6)


def test_the_floor_is_not_told_of_what_moves(make_graph):
    frame = MovingDrive(lambda index: (1.5, 0.0)).frame(0)
    mask = MovingDrive(lambda index: (1.5, 0.0)).mask(0)
    graph = make_graph()
    floors = graph.collect('keyframe/floor_mask')
    publisher = graph.publisher('keyframe/moving_mask')
    graph.add(FloorSegmentationNode())
    graph.connected([publisher])
    messages = {
        'keyframe/odometry': pose_message_at(frame.stamp_ns),
        'camera_mount': transform_message(0, 'base_link', 'left', MOUNT.T_base_left),
    }
    for topic, message in stereo_messages(frame).items():
        messages[f'keyframe/{topic.replace("image_raw", "image_rect")}'] = message
    publish(graph, messages)
    assert not graph.comes(lambda: floors, 1.0), 'did not wait for the mask of the keyframe'
    publisher.publish(image_message(frame.stamp_ns, 'left', mask))
    graph.until(lambda: floors, 'the floor mask')
    floor = grey8_image(floors[0], '')
    assert (floor == FLOOR).mean() > 0.1
    assert (floor[mask > 0] != FLOOR).mean() > 0.97


def test_a_mask_serves_later_frames_until_it_is_too_old():
    class NoInputs:
        def subscribe(self, name, callback):
            assert name == 'dynamic_mask'

    class Node:
        inputs = NoInputs()

    masks = MaskInput(Node(), timeout_s=0.2)
    rectifier = StereoRectifier(CALIBRATION)
    picture = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    picture[10:20, 30:50] = 255
    masks.take(image_message(1_000_000_000, 'left', picture))
    assert masks.mask_for(999_999_999, rectifier) is None
    for later_ns in (0, 200_000_000):
        found = masks.mask_for(1_000_000_000 + later_ns, rectifier)
        np.testing.assert_array_equal(found, picture)
    assert masks.mask_for(1_200_000_001, rectifier) is None
    masks.take(image_message(1_100_000_000, 'left', np.zeros_like(picture)))
    assert not masks.mask_for(1_150_000_000, rectifier).any()
