"""The node `floor_segmentation` over DDS, against its stage called directly."""

import numpy as np
from node_messages import AT_ORIGIN, STAMP_NS, pose_message_at, publish, stereo_messages
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.core.floor.pictures import mask_overlay
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings
from segfloor_ros.nodes.floor_segmentation import FloorSegmentationNode
from segfloor_ros.nodes.messages.images import grey8_image
from segfloor_ros.nodes.messages.poses import transform_message
from segfloor_ros.nodes.messages.scans import scan_arrays
from segfloor_ros.nodes.messages.topics import to_ns


def keyframe_messages(stamp_ns: int, left, right, T_map_base=AT_ORIGIN) -> dict:
    """Return what `floor_segmentation` needs of one keyframe."""
    messages = {'keyframe/odometry': pose_message_at(stamp_ns, T_map_base)}
    for topic, message in stereo_messages(StereoFrame(0, stamp_ns, left, right)).items():
        messages[f'keyframe/{topic.replace("image_raw", "image_rect")}'] = message
    return messages


def test_floor_segmentation_is_the_stage(make_graph) -> None:
    frame = StereoRoom(seed=5).frame(0, planar_pose(0.0, 0.0, 0.0))
    expected = FloorSegmentation(CAMERA, FloorSegmentationSettings()).process(
        frame.left, frame.right, MOUNT, np.eye(4)
    )
    graph = make_graph()
    masks, scans = graph.collect('keyframe/floor_mask'), graph.collect('keyframe/floor_scan')
    graph.add(FloorSegmentationNode())
    messages = keyframe_messages(STAMP_NS, frame.left, frame.right)
    mount = transform_message(STAMP_NS, 'base_link', 'left', MOUNT.T_base_left)
    publish(graph, {**messages, 'camera_mount': mount})
    graph.until(lambda: masks and scans, 'mask and scan')
    assert to_ns(masks[0].header.stamp) == to_ns(scans[0].header.stamp) == STAMP_NS
    assert (masks[0].encoding, masks[0].header.frame_id) == ('mono8', 'left')
    np.testing.assert_array_equal(grey8_image(masks[0], ''), expected.mask)
    assert scans[0].header.frame_id == 'base_link'
    np.testing.assert_array_equal(scan_arrays(scans[0], '').ranges_m, expected.scan.ranges_m)
    assert (expected.mask == 255).mean() > 0.1


def test_pictures_of_the_floor_are_published_for_those_who_look(make_graph) -> None:
    frame = StereoRoom(seed=5).frame(0, planar_pose(0.0, 0.0, 0.0))
    graph = make_graph()
    masks, overlays = graph.collect('keyframe/floor_mask'), graph.collect('keyframe/floor_overlay')
    node = graph.add(FloorSegmentationNode())
    mount = transform_message(STAMP_NS, 'base_link', 'left', MOUNT.T_base_left)
    publishers = publish(graph, {'camera_mount': mount})
    publish(graph, keyframe_messages(STAMP_NS, frame.left, frame.right), publishers)
    graph.until(lambda: masks and overlays, 'mask and overlay')
    expected = mask_overlay(frame.left, grey8_image(masks[0], ''))
    assert (overlays[0].encoding, overlays[0].step) == ('bgr8', 3 * CAMERA.width)
    pixels = np.frombuffer(overlays[0].data, np.uint8).reshape(expected.shape)
    np.testing.assert_array_equal(pixels, expected)
    drawn = graph.collect('keyframe/v_disparity')
    (late,) = (p for p in node.publishers if p.topic_name.endswith('/v_disparity'))
    graph.until(late.get_subscription_count, 'the subscription')
    publish(graph, keyframe_messages(STAMP_NS + 1, frame.left, frame.right), publishers)
    graph.until(lambda: drawn, 'the v-disparity')
    assert to_ns(drawn[0].header.stamp) == STAMP_NS + 1
    picture = np.frombuffer(drawn[0].data, np.uint8).reshape(CAMERA.height, -1, 3)
    green = picture[..., 1].astype(int) - picture[..., 2] > 100
    # The profile: one line from the horizon down, to the right.
    rows, columns = np.nonzero(green)
    assert len(np.unique(rows)) > 0.3 * CAMERA.height
    assert np.corrcoef(rows, columns)[0, 1] > 0.98
