"""Each node over DDS, against its stage called directly."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from floor_scenes import SMALL_CAMERA, blank_floored, box
from node_messages import (
    FEATURES,
    INPUTS,
    LABELLED,
    MASK,
    MOUNTED,
    POINTS,
    SCAN,
    SIDES,
    STAMP_NS,
    cloud_messages,
    grid_arrays,
    grid_messages,
    pose_message_at,
    publish,
    stereo_messages,
)
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger
from stereo_drive import room_drive, write_kitti
from stereo_room import CAMERA, MOUNT

from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.stereo_camera import make_stereo_camera
from segfloor_ros.core.camera.camera_info import eye_calibration
from segfloor_ros.core.cloud import CloudLabelling, CloudLabellingSettings
from segfloor_ros.core.contracts import (
    POINT_FLOOR,
    KeyframeFeatures,
    KeyframePath,
    Mount,
    SparseCloud,
)
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.grid.mapper import OccupancyGridMapper
from segfloor_ros.core.grid.occupancy import OccupancyGridSettings
from segfloor_ros.core.slam.drift import SCALE_SIGMA
from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.floor_segmentation import FloorSegmentationNode
from segfloor_ros.nodes.messages.camera_infos import (
    camera_info_message,
    compressed_message,
    rectified_calibration,
)
from segfloor_ros.nodes.messages.diagnostics import Level, Status
from segfloor_ros.nodes.messages.images import grey8_image, image_message
from segfloor_ros.nodes.messages.points import (
    features_message,
    labelled_arrays,
    sparse_cloud_arrays,
    sparse_cloud_message,
)
from segfloor_ros.nodes.messages.poses import (
    path_arrays,
    pose_array,
    transform_array,
    transform_message,
)
from segfloor_ros.nodes.messages.scans import free_ranges, near_obstacles
from segfloor_ros.nodes.messages.topics import to_ns
from segfloor_ros.nodes.occupancy_grid import OccupancyGridNode
from segfloor_ros.nodes.stereo_slam import StereoSlamNode


def test_the_camera_sends_every_pair_as_recorded(make_graph, tmp_path) -> None:
    frames, _ = room_drive(4)
    folder = write_kitti(tmp_path / 'drive', frames)
    graph = make_graph('-p', f'input:={folder}', '-p', 'rate:=50.0', '-p', 'start_paused:=true')
    names = ('left/image_raw', 'right/image_raw', 'left/camera_info', 'right/camera_info')
    received = {name: graph.collect(name) for name in names}
    graph.add(make_stereo_camera())
    resumed = graph.call(SetBool, 'stereo_camera/pause', SetBool.Request(data=False))
    assert resumed.success
    graph.until(lambda: any(s.kind == 'recording' for s in graph.statuses), 'the end')
    graph.until(lambda: all(len(m) == 4 for m in received.values()), 'all messages')
    stamps = [frame.stamp_ns for frame in frames]
    for name, messages in received.items():
        assert [to_ns(message.header.stamp) for message in messages] == stamps, name
    for frame, left, right in zip(
        frames, received['left/image_raw'], received['right/image_raw'], strict=True
    ):
        np.testing.assert_array_equal(grey8_image(left, 'left'), frame.left)
        np.testing.assert_array_equal(grey8_image(right, 'right'), frame.right)
    info = eye_calibration(received['right/camera_info'][0], 'right/camera_info')
    assert info.P[0, 3] == pytest.approx(-CAMERA.disparity_times_depth)
    assert received['left/camera_info'][0].header.frame_id == 'left_camera_optical_frame'
    (end,) = (s for s in graph.statuses if s.kind == 'recording')
    assert (end.values['frames'], end.values['skipped']) == ('4', '0')


def test_the_camera_waits_for_somebody_who_listens(make_graph, tmp_path) -> None:
    frames, _ = room_drive(2)
    folder = write_kitti(tmp_path / 'drive', frames)
    graph = make_graph('-p', f'input:={folder}', '-p', 'rate:=50.0')
    graph.add(make_stereo_camera())
    graph.until(lambda: any(s.kind == 'connections' for s in graph.statuses), 'a sign of life')
    received = graph.collect('left/image_raw')
    for name in ('right/image_raw', 'left/camera_info', 'right/camera_info'):
        graph.collect(name)
    graph.until(lambda: len(received) == 2, 'both images')
    # The first frame was not sent before somebody listened.
    assert [to_ns(m.header.stamp) for m in received] == [f.stamp_ns for f in frames]


@pytest.mark.parametrize(('coding', 'quality'), [('jpeg', 90), ('png', None)])
def test_the_camera_compresses_as_it_is_told(make_graph, tmp_path, coding, quality) -> None:
    (frame,), _ = room_drive(1)
    folder = write_kitti(tmp_path / 'drive', [frame])
    arguments = {'input': folder, 'image_transport': 'compressed', 'compression': coding}
    graph = make_graph(*(part for k, v in arguments.items() for part in ('-p', f'{k}:={v}')))
    received = graph.collect('left/image_raw/compressed')
    for name in ('right/image_raw/compressed', 'left/camera_info', 'right/camera_info'):
        graph.collect(name)
    graph.add(make_stereo_camera())
    graph.until(lambda: received, 'the image')
    expected = compressed_message(frame.stamp_ns, '', frame.left, quality)
    assert bytes(received[0].data) == bytes(expected.data)


class TestStereoSlam:
    """The node `stereo_slam` fed by hand."""

    def inputs(self, graph):
        publishers = {name: graph.publisher(name) for name in INPUTS}
        graph.connected(list(publishers.values()))
        return publishers

    def send(self, inputs, frame, sides=SIDES) -> None:
        for name, message in stereo_messages(frame, sides).items():
            inputs[name].publish(message)

    def test_it_tracks_and_everything_of_a_keyframe_has_its_stamp(self, make_graph) -> None:
        frames, truth = room_drive(8)
        graph = make_graph(*MOUNTED)
        names = (
            'odometry', 'keyframe/odometry', 'keyframe/left/image_rect', 'map_points',
            'keyframe/right/image_rect', 'keyframe/left/camera_info', 'keyframe/features',
            'keyframe/right/camera_info', 'keyframe/path',
        )  # fmt: skip
        received = {name: graph.collect(name) for name in names}
        graph.add(StereoSlamNode())
        inputs = self.inputs(graph)
        self._wait_for_outputs(graph)
        for frame in frames:
            self.send(inputs, frame)
            graph.until(
                lambda frame=frame: frame.stamp_ns in _stamps(graph.reports('stereo_slam')),
                f'frame {frame.index}',
            )
        answers = {s.stamp_ns: s for s in graph.reports('stereo_slam')}
        assert all(s.level is Level.OK for s in answers.values())
        keyframes = [t for t, s in answers.items() if s.values['keyframe'] == '1']
        assert keyframes[0] == frames[0].stamp_ns
        graph.until(lambda: len(received['odometry']) == 8, 'odometry')
        for name in names[1:]:
            graph.until(lambda name=name: len(received[name]) >= len(keyframes), name)
            assert [to_ns(m.header.stamp) for m in received[name]] == keyframes, name
        for message, frame in zip(received['odometry'], frames, strict=True):
            pose = pose_array(message.pose.pose)
            error = pose[:3, 3] - (invert(truth[0]) @ truth[frame.index])[:3, 3]
            assert np.linalg.norm(error) < 0.02, frame.index
            assert (message.header.frame_id, message.child_frame_id) == ('odom', 'base_link')
        assert received['odometry'][-1].twist.twist.linear.x == pytest.approx(0.6, abs=0.05)
        for message in received['odometry']:
            for covariance in (message.pose.covariance, message.twist.covariance):
                assert (np.diag(np.reshape(covariance, (6, 6))) > 0).all()
        assert 0 < received['odometry'][-1].twist.covariance[0] < 0.1
        # Errors of the calibration alone are a share of the way.
        grown = [message.pose.covariance[0] for message in received['odometry']]
        way_m = float(np.linalg.norm((invert(truth[0]) @ truth[frames[-1].index])[:3, 3]))
        assert grown == sorted(grown)
        assert SCALE_SIGMA * way_m < np.sqrt(grown[-1]) < 0.05 * way_m
        path = path_arrays(received['keyframe/path'][-1])
        assert path.stamp_ns.tolist() == keyframes
        np.testing.assert_array_equal(
            grey8_image(received['keyframe/left/image_rect'][0], ''), frames[0].left
        )
        cloud = sparse_cloud_arrays(received['map_points'][-1], 'map_points')
        assert len(cloud.point_id) > 100
        assert (np.diff(cloud.point_id) > 0).all()
        # Among two thousand points of a young map a wrong match may be left.
        assert (cloud.xyz_map[:, 2] < -0.2).mean() < 0.002

    def test_poses_that_were_provisional_come_corrected_on_topics_of_their_own(
        self, make_graph
    ) -> None:
        """Where the floor has no texture the mount takes a while: `odometry` waits for nothing, and
        its stamps grow.
        """
        scene = replace(
            blank_floored(Mount(0.35, np.radians(8.0)), *box(1.6, 0.5, 0.4, 0.3)),
            camera=SMALL_CAMERA,
        )
        calibration = rectified_calibration(SMALL_CAMERA)
        graph = make_graph('-p', 'keyframe_max_frames:=1', '-p', 'tf_wait_s:=0.0')
        names = ('odometry', 'odometry/corrected', 'pose/corrected')
        odometry, corrected, poses = (graph.collect(name) for name in names)
        graph.add(StereoSlamNode())
        inputs = self.inputs(graph)
        self._wait_for_outputs(graph)
        stamps = [(i + 1) * 100_000_000 for i in range(8)]
        for i, stamp_ns in enumerate(stamps):
            here = replace(scene, mount=replace(scene.mount, forward_m=0.1 * i))
            for side, image in zip(('left', 'right'), here.render()[:2], strict=True):
                info = camera_info_message(stamp_ns, side, getattr(calibration, side))
                inputs[f'{side}/camera_info'].publish(info)
                inputs[f'{side}/image_raw'].publish(image_message(stamp_ns, side, image))
            graph.until(lambda i=i: len(odometry) == i + 1, f'the pose of frame {i}')
        assert [to_ns(message.header.stamp) for message in odometry] == stamps
        graph.until(lambda: corrected and len(poses) == len(corrected), 'the corrected poses')
        settled = len(corrected)
        assert 1 < settled < len(stamps)
        for found in (corrected, poses):
            assert [to_ns(message.header.stamp) for message in found] == stamps[:settled]
            for i, message in enumerate(found):
                place = pose_array(message.pose.pose)[:3, 3]
                np.testing.assert_allclose(place, [0.1 * i, 0.0, 0.0], atol=0.02)

    def test_the_mount_reaches_those_who_come_late(self, make_graph) -> None:
        frames, _ = room_drive(1)
        graph = make_graph(*MOUNTED)
        graph.add(StereoSlamNode())
        self.send(self.inputs(graph), frames[0])
        graph.until(lambda: graph.reports('stereo_slam'), 'the answer')
        late = graph.collect('camera_mount')
        graph.until(lambda: late, 'the mount')
        assert (late[0].header.frame_id, late[0].child_frame_id) == ('base_link', 'left')
        found = Mount.from_transform(transform_array(late[0]))
        assert (found.height_m, found.pitch_rad) == pytest.approx((0.4, 0.15))

    def test_when_lost_it_says_so_and_publishes_no_pose(self, make_graph) -> None:
        frames, _ = room_drive(2)
        dark = np.zeros_like(frames[0].left)
        graph = make_graph(*MOUNTED)
        poses = graph.collect('odometry')
        graph.add(StereoSlamNode())
        inputs = self.inputs(graph)
        self._wait_for_outputs(graph)
        self.send(inputs, frames[0])
        blind = type(frames[1])(1, frames[1].stamp_ns, dark, dark)
        self.send(inputs, blind)
        graph.until(lambda: len(graph.reports('stereo_slam')) == 2, 'both answers')
        tracked, lost = graph.reports('stereo_slam')
        assert (tracked.level, lost.level) == (Level.OK, Level.ERROR)
        assert lost.message.startswith('lost')
        graph.until(lambda: poses, 'the first pose')
        assert [to_ns(message.header.stamp) for message in poses] == [frames[0].stamp_ns]

    def _wait_for_outputs(self, graph) -> None:
        def connected() -> bool:
            seen = [s for s in graph.statuses if s.kind == 'connections']
            return bool(seen) and seen[-1].values['odometry'] == '1'

        graph.until(connected, 'the connection of odometry')


def test_cloud_labelling_is_the_stage(make_graph) -> None:
    expected = CloudLabelling(CloudLabellingSettings()).update(POINTS, FEATURES, MASK, np.eye(4))
    graph = make_graph()
    labelled, floor = graph.collect('labelled_points'), graph.collect('floor_points')
    graph.add(CloudLabellingNode())
    publish(graph, cloud_messages(STAMP_NS))
    graph.until(lambda: labelled and floor, 'labelled points')
    assert to_ns(labelled[0].header.stamp) == STAMP_NS
    assert labelled[0].header.frame_id == 'map'
    found = labelled_arrays(labelled[0], '')
    for name in ('point_id', 'xyz_map', 'label', 'confidence'):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    ids = sparse_cloud_arrays(floor[0], '').point_id
    np.testing.assert_array_equal(ids, expected.point_id[expected.label == POINT_FLOOR])


def test_a_missing_partner_is_named_and_the_next_keyframe_goes_through(make_graph) -> None:
    graph = make_graph()
    labelled = graph.collect('labelled_points')
    graph.add(CloudLabellingNode())
    alone = cloud_messages(STAMP_NS)
    del alone['keyframe/floor_mask']
    publishers = publish(graph, alone)
    publish(graph, cloud_messages(STAMP_NS + 1), publishers)
    graph.until(lambda: labelled, 'the second keyframe')
    assert to_ns(labelled[0].header.stamp) == STAMP_NS + 1

    def errors() -> list[Status]:
        return [s for s in graph.reports('cloud_labelling') if s.level is Level.ERROR]

    graph.until(errors, 'the status')
    (error,) = errors()
    assert error.stamp_ns == STAMP_NS
    assert 'keyframe/floor_mask' in error.message


def test_the_grid_is_the_stage_and_is_saved_on_request(make_graph, tmp_path) -> None:
    path = KeyframePath(np.array([STAMP_NS]), np.eye(4)[None])
    stage = OccupancyGridMapper(OccupancyGridSettings())
    stage.update(STAMP_NS, LABELLED, FEATURES, path, SCAN)
    expected = stage.grid()
    file = tmp_path / 'saved.yaml'
    graph = make_graph('-p', f'map_file:={file}')
    graph.add(OccupancyGridNode())
    early = graph.call(Trigger, 'save_map', Trigger.Request())
    assert not early.success
    assert not file.exists()
    publish(graph, grid_messages(STAMP_NS))
    graph.until(lambda: graph.reports('occupancy_grid'), 'the update')
    late = graph.collect('map')
    graph.until(lambda: late, 'the map, latched')
    found = grid_arrays(late[0], 'map')
    assert (late[0].header.frame_id, to_ns(late[0].header.stamp)) == ('map', STAMP_NS)
    np.testing.assert_array_equal(found.cells, expected.cells)
    assert found.origin_xy_m == pytest.approx(expected.origin_xy_m)
    assert set(Counter(expected.cells.ravel().tolist())) >= {0, -1}
    saved = graph.call(Trigger, 'save_map', Trigger.Request())
    assert (saved.success, saved.message) == (True, str(file))
    np.testing.assert_array_equal(load_map(file).cells, expected.cells)


def test_that_nothing_is_new_is_published_while_a_tracked_robot_stands(make_graph) -> None:
    graph = make_graph()
    obstacles = graph.collect('obstacle_points')
    node = graph.add(CloudLabellingNode())
    ids = np.arange(3, dtype=np.int32)
    post = np.array([[2.0, 0.0, 0.3 + 0.1 * k] for k in ids], np.float32)
    features = KeyframeFeatures(np.full((3, 2), (5.0, 1.0), np.float32), ids, post)
    shown = {
        'map_points': sparse_cloud_message(STAMP_NS, 'map', SparseCloud(ids, post)),
        'keyframe/features': features_message(STAMP_NS, 'map', features),
    }
    publishers = publish(graph, cloud_messages(STAMP_NS) | shown)
    graph.until(lambda: len(obstacles) == 1, 'the keyframe')
    assert obstacles[0].width == 3
    assert not graph.comes(lambda: len(obstacles) > 1, 1.0), 'nothing while nobody tracks'
    graph.until(lambda: node.count_subscribers('odometry'), 'the subscription')
    later = [STAMP_NS + k * 100_000_000 for k in range(1, 21)]
    for stamp_ns in later:
        publish(graph, {'odometry': pose_message_at(stamp_ns)}, publishers)
    graph.until(lambda: len(obstacles) == 5, 'that nothing is new')
    stamps = [to_ns(message.header.stamp) for message in obstacles]
    assert stamps == [STAMP_NS, *later[4::5]], 'twice a second, at the stamps of tracked frames'
    assert [message.width for message in obstacles[1:]] == 4 * [0], 'who was there may have gone'
    late = graph.collect('obstacle_points')
    graph.until(lambda: node.count_subscribers('obstacle_points') == 2, 'who begins to listen')
    for k in range(26, 32):
        at = {'odometry': pose_message_at(STAMP_NS + k * 100_000_000)}
        publish(graph, at, publishers)
    graph.until(lambda: len(late) == 2, 'the points for him, then nothing new')
    assert [message.width for message in late] == [3, 0]


def test_a_keyframe_that_took_long_is_not_followed_at_once_by_nothing_new(make_graph) -> None:
    graph = make_graph()
    obstacles = graph.collect('obstacle_points')
    node = graph.add(CloudLabellingNode())
    first = cloud_messages(STAMP_NS)
    publishers = publish(graph, first)
    graph.until(lambda: len(obstacles) == 1, 'the keyframe')
    graph.until(lambda: node.count_subscribers('odometry'), 'the subscription')
    slow_ns = STAMP_NS + 1_000_000_000
    publish(graph, {'odometry': pose_message_at(slow_ns + 700_000_000)}, publishers)
    graph.until(lambda: len(obstacles) == 2, 'that nothing is new')
    publish(graph, cloud_messages(slow_ns), publishers)
    graph.until(lambda: len(obstacles) == 3, 'the keyframe, 0.7 s late')
    publish(graph, {'odometry': pose_message_at(slow_ns + 800_000_000)}, publishers)
    assert not graph.comes(lambda: len(obstacles) > 3, 0.5)
    publish(graph, {'odometry': pose_message_at(slow_ns + 1_200_000_000)}, publishers)
    graph.until(lambda: len(obstacles) == 4, 'that nothing is new')


class TestFrameScan:
    """The scan of every tracked frame."""

    def frame_messages(self, frame):
        return {
            f'frame/{topic.replace("image_raw", "image_rect")}': message
            for topic, message in stereo_messages(frame).items()
        }

    def test_it_is_that_of_the_stage(self, make_graph) -> None:
        (frame, *_), _ = room_drive(1)
        graph = make_graph()
        node = graph.add(FloorSegmentationNode())
        assert not node.count_subscribers('frame/left/image_rect'), 'nobody listens'
        scans = graph.collect('scan')
        mount = transform_message(0, 'base_link', 'left', MOUNT.T_base_left)
        publishers = publish(graph, {'camera_mount': mount})
        graph.until(lambda: node.mount is not None, 'the mount')
        publish(graph, self.frame_messages(frame), publishers)
        graph.until(lambda: scans, 'the scan')
        stage = FloorSegmentation(CAMERA, FloorSegmentationSettings())
        expected = stage.process(frame.left, frame.right, MOUNT).scan
        np.testing.assert_array_equal(np.array(scans[0].ranges), free_ranges(expected))
        assert scans[0].header.frame_id == 'base_link'
        assert to_ns(scans[0].header.stamp) == frame.stamp_ns
        ahead = scans[0].ranges[np.argmin(np.abs(expected.bearings_rad))]
        assert ahead > 3.0, 'the room is open ahead'

    def test_who_only_wants_what_is_near_is_told_it(self, make_graph) -> None:
        (frame, *_), _ = room_drive(1)
        graph = make_graph()
        node, near = graph.add(FloorSegmentationNode()), graph.collect('obstacle_scan')
        mount = transform_message(0, 'base_link', 'left', MOUNT.T_base_left)
        publishers = publish(graph, {'camera_mount': mount})
        graph.until(lambda: node.mount is not None, 'the mount')
        publish(graph, self.frame_messages(frame), publishers)
        graph.until(lambda: near, 'what is near')
        stage = FloorSegmentation(CAMERA, FloorSegmentationSettings())
        expected, reach_m = near_obstacles(stage.process(frame.left, frame.right, MOUNT).scan)
        np.testing.assert_array_equal(np.array(near[0].ranges), expected)
        assert near[0].range_max == pytest.approx(reach_m) and not near[0].intensities

    def test_it_follows_the_parameters_as_they_are_now(self, make_graph) -> None:
        (frame, *_), _ = room_drive(1)
        graph = make_graph()
        node, scans = graph.add(FloorSegmentationNode()), graph.collect('scan')
        mount = transform_message(0, 'base_link', 'left', MOUNT.T_base_left)
        publishers = publish(graph, {'camera_mount': mount})
        graph.until(lambda: node.mount is not None, 'the mount')
        expected = []
        for count, step_height_m in enumerate((0.03, 0.2), 1):
            parameter = Parameter('step_height_m', value=step_height_m)
            assert node.set_parameters([parameter])[0].successful
            later = replace(frame, stamp_ns=frame.stamp_ns + count)
            publish(graph, self.frame_messages(later), publishers)
            graph.until(lambda count=count: len(scans) == count, 'the scan')
            settings = FloorSegmentationSettings(step_height_m=step_height_m)
            floor = FloorSegmentation(CAMERA, settings).process(frame.left, frame.right, MOUNT)
            expected.append(free_ranges(floor.scan))
        assert (expected[0] != expected[1]).any()
        for message, ranges in zip(scans, expected, strict=True):
            np.testing.assert_array_equal(np.array(message.ranges), ranges)

    def test_slam_sends_every_tracked_frame_to_whoever_listens(self, make_graph) -> None:
        frames, _ = room_drive(4)
        graph = make_graph(*MOUNTED)
        received = {name: graph.collect(name) for name in self.frame_messages(frames[0])}
        graph.add(StereoSlamNode())
        slam = TestStereoSlam()
        inputs = slam.inputs(graph)
        graph.until(lambda: all(graph.tester.count_publishers(n) for n in received), 'the topics')
        for frame in frames:
            slam.send(inputs, frame)
            graph.until(
                lambda frame=frame: frame.stamp_ns in _stamps(graph.reports('stereo_slam')), 'SLAM'
            )
        graph.until(lambda: all(len(m) == 4 for m in received.values()), 'all frames')
        for name, messages in received.items():
            assert [to_ns(m.header.stamp) for m in messages] == [f.stamp_ns for f in frames], name
        left = grey8_image(received['frame/left/image_rect'][2], 'left')
        np.testing.assert_array_equal(left, frames[2].left)

    def test_they_are_ten_a_second_and_two_where_tracking_has_no_time_left(
        self, make_graph
    ) -> None:
        frames, _ = room_drive(7, step_m=0.02)
        frames = [replace(frame, stamp_ns=frame.index * 10**9 // 30) for frame in frames]
        graph = make_graph(*MOUNTED)
        small = graph.collect('frame/left/image_rect')
        node = graph.add(StereoSlamNode())
        slam = TestStereoSlam()
        inputs = slam.inputs(graph)
        graph.until(lambda: graph.tester.count_publishers('frame/left/image_rect'), 'the topic')
        graph.until(lambda: node.outputs.listeners('frame/left/image_rect'), 'the listener')
        for frame in frames:
            slam.send(inputs, frame)
            graph.until(
                lambda frame=frame: frame.stamp_ns in _stamps(graph.reports('stereo_slam')), 'SLAM'
            )
        graph.until(lambda: len(small) == 3, 'every third frame')
        begin_ns = frames[-1].stamp_ns
        for tenth in range(1, 11):
            later = replace(frames[0], stamp_ns=begin_ns + tenth * 10**8)
            node._results.topics.publish_frame(later, is_idle=False)
        graph.until(lambda: len(small) == 5, 'two in a second')
        assert not graph.comes(lambda: len(small) > 5, 0.3)
        seconds = [1e-9 * to_ns(message.header.stamp) for message in small]
        assert seconds == pytest.approx([0.0, 0.1, 0.2, 0.7, 1.2], abs=0.001)


def _stamps(statuses) -> set[int]:
    return {status.stamp_ns for status in statuses}
