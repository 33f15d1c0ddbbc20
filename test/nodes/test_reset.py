"""A map reset: by service, by a recording that is played again, by SLAM started again."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from floor_scenes import Patch, Scene, floor_patch, wall
from node_messages import cloud_messages, grid_arrays, publish
from std_srvs.srv import Trigger
from stereo_drive import room_drive, write_kitti
from stereo_room import CAMERA, MOUNT

from segfloor_ros.apps.stereo_camera import make_stereo_camera
from segfloor_ros.core.contracts import Mount, StereoFrame
from segfloor_ros.core.plugins.assembly import make_pipeline
from segfloor_ros.nodes.cloud_labelling import CloudLabellingNode
from segfloor_ros.nodes.configuration import resolve
from segfloor_ros.nodes.floor_segmentation import FloorSegmentationNode
from segfloor_ros.nodes.messages.camera_infos import camera_info_message, rectified_calibration
from segfloor_ros.nodes.messages.images import image_message
from segfloor_ros.nodes.messages.points import labelled_arrays
from segfloor_ros.nodes.messages.poses import transform_array
from segfloor_ros.nodes.messages.saved_maps import map_start_ns
from segfloor_ros.nodes.messages.topics import MAP_START, TOPICS, to_ns
from segfloor_ros.nodes.occupancy_grid import OccupancyGridNode
from segfloor_ros.nodes.shared.stamp_order import AGREEING
from segfloor_ros.nodes.stereo_slam import StereoSlamNode

S = 1_000_000_000
FRAMES, MIDDLE = 12, 6
CALIBRATION = rectified_calibration(CAMERA)
MOUNTED = (
    '-p', f'camera_height_m:={MOUNT.height_m}', '-p', 'camera_roll_rad:=0.0',
    '-p', f'camera_pitch_rad:={MOUNT.pitch_rad}',
)  # fmt: skip
BEHIND_SLAM = (FloorSegmentationNode, CloudLabellingNode, OccupancyGridNode)


class Chain:
    """The four nodes behind the camera, fed frame by frame."""

    def __init__(self, make_graph, *options: str) -> None:
        self.graph = make_graph(
            '-p', 'background:=false', '-p', 'publish_period_s:=0.0', *(options or MOUNTED)
        )  # fmt: skip
        self._maps = self.graph.collect('map')
        self._labelled = self.graph.collect('labelled_points')
        for make in BEHIND_SLAM:
            self.graph.add(make())
        self.start_slam()
        names = ('left/image_raw', 'right/image_raw', 'left/camera_info', 'right/camera_info')
        self._inputs = {name: self.graph.publisher(name) for name in names}
        self.connect()

    def start_slam(self) -> None:
        self.slam = self.graph.add(StereoSlamNode())

    def connect(self) -> None:
        self.graph.connected(list(self._inputs.values()))
        self.graph.statuses.clear()
        self.graph.until(self._connected, 'the connections of all nodes')

    def send(self, frames) -> list[Any]:
        """Send frames, each once the one before is answered; returns the answers."""
        self.graph.statuses.clear()
        for done, frame in enumerate(frames, start=1):
            for side in ('left', 'right'):
                info = camera_info_message(frame.stamp_ns, side, getattr(CALIBRATION, side))
                self._inputs[f'{side}/camera_info'].publish(info)
                image = image_message(frame.stamp_ns, side, getattr(frame, side))
                self._inputs[f'{side}/image_raw'].publish(image)
            self.graph.until(
                lambda done=done: len(self.graph.reports('stereo_slam')) == done, 'the answer'
            )
        return self.graph.reports('stereo_slam')

    def drive(self, frames) -> tuple[Any, Any]:
        """Send frames; returns the map and the labelled points of the last keyframe."""
        keyframes = [s.stamp_ns for s in self.send(frames) if s.values['keyframe'] == '1']
        assert len(keyframes) > 1
        for messages in (self._maps, self._labelled):
            self.graph.until(
                lambda messages=messages: (
                    messages and to_ns(messages[-1].header.stamp) == keyframes[-1]
                ),
                'the results of the last keyframe',
            )
        return grid_arrays(self._maps[-1], ''), labelled_arrays(self._labelled[-1], '')

    def _connected(self) -> bool:
        counts = {s.node: s.values for s in self.graph.statuses if s.kind == 'connections'}
        found = {name: int(n) for values in counts.values() for name, n in values.items()}
        return len(counts) == 4 and all(
            found.get(topic.name, 0) >= len(counts.keys() & topic.subscribers)
            for topic in TOPICS.values()
            if topic.publisher in counts
        )


def assert_same(found, expected) -> None:
    np.testing.assert_array_equal(found[0].cells, expected[0].cells)
    assert found[0].origin_xy_m == expected[0].origin_xy_m
    for name in ('point_id', 'xyz_map', 'label', 'confidence'):
        np.testing.assert_array_equal(getattr(found[1], name), getattr(expected[1], name))


def test_a_recording_that_begins_again_gives_the_map_of_a_fresh_run(make_graph) -> None:
    """Of all but the pairs that show that time has jumped back."""
    frames, _ = room_drive(FRAMES)
    chain = Chain(make_graph)
    chain.drive(frames)
    chain.send(frames[: AGREEING - 1])
    again = chain.drive(frames[AGREEING - 1 :])
    chain.graph.close()
    assert_same(again, Chain(make_graph).drive(frames[AGREEING - 1 :]))


@pytest.mark.parametrize('how', ['service', 'killed'])
def test_slam_begun_anew_in_mid_drive_takes_all_nodes_along(make_graph, how) -> None:
    """Keyframes before and after do not mix: the result is that of the second half alone."""
    frames, _ = room_drive(FRAMES)
    chain = Chain(make_graph)
    chain.drive(frames[:MIDDLE])
    if how == 'service':
        assert chain.graph.call(Trigger, 'stereo_slam/reset', Trigger.Request()).success
    else:
        chain.graph.remove(chain.slam)
        chain.start_slam()
        chain.connect()
    after = chain.drive(frames[MIDDLE:])
    chain.graph.close()
    assert_same(after, Chain(make_graph).drive(frames[MIDDLE:]))


@pytest.mark.slow
def test_a_mount_that_turns_out_to_be_wrong_has_all_nodes_map_anew(make_graph) -> None:
    """The robot begins before a stage: the map is the one that `run` makes of the same images."""
    stage = Patch((0.2, -2.0, 0.1), (1.2, 0, 0), (0, 4.0, 0), True, contrast=30.0, seed=5)
    scene = Scene([floor_patch(), wall(7.0), stage], camera=CAMERA, noise_grey=1.0)
    frames = []
    for i in range(48):
        here = Mount(0.35, np.radians(8.0), forward_m=0.1 * i)
        left, right, _, _ = replace(scene, mount=here, seed=i).render()
        frames.append(StereoFrame(i, (i + 1) * S // 10, left, right))
    chain = Chain(make_graph, '-p', 'keyframe_max_frames:=1', '-p', 'tf_wait_s:=0.0')
    names = ('camera_mount', MAP_START, 'map')
    mounts, starts, maps = (chain.graph.collect(name) for name in names)
    chain.send(frames)
    pipeline = make_pipeline(CAMERA, resolve(assignments=['stereo_slam.keyframe_max_frames=1']))
    results = [result for frame in frames for result in pipeline.process(frame)]
    assert len(results) > len(frames)
    last_ns = max(result.stamp_ns for result in results if result.keyframe is not None)
    chain.graph.until(lambda: maps and to_ns(maps[-1].header.stamp) == last_ns, 'the new map')
    heights_m = [Mount.from_transform(transform_array(mount)).height_m for mount in mounts]
    assert heights_m == pytest.approx([0.25, 0.35], rel=0.05)
    assert len({map_start_ns(start) for start in starts}) == 2
    expected = pipeline.finish()
    assert expected is not None
    cells = grid_arrays(maps[-1], '').cells
    assert cells.shape == expected.cells.shape
    # A few cells at the edges of what is seen differ, as they do where the mount is given.
    assert (cells != expected.cells).sum() < 0.002 * (expected.cells >= 0).sum()


def test_a_late_pair_is_dropped_and_does_not_begin_anew(make_graph) -> None:
    frames, _ = room_drive(4)
    chain = Chain(make_graph)
    chain.send([frames[0], frames[1], frames[3]])
    (late,) = chain.send([frames[2]])
    assert 'older than the pair before it' in late.message


def test_the_camera_reset_plays_from_the_first_frame(make_graph, tmp_path) -> None:
    frames, _ = room_drive(3)
    drive = write_kitti(tmp_path / 'drive', frames)
    graph = make_graph('-p', f'input:={drive}', '-p', 'rate:=50.0')
    received = graph.collect('left/image_raw')
    for name in ('right/image_raw', 'left/camera_info', 'right/camera_info'):
        graph.collect(name)
    graph.add(make_stereo_camera())
    graph.until(lambda: len(received) == 3, 'the recording')
    assert graph.call(Trigger, 'stereo_camera/reset', Trigger.Request()).success
    graph.until(lambda: len(received) == 6, 'the recording again')
    stamps = [to_ns(message.header.stamp) for message in received]
    assert stamps == [frame.stamp_ns for frame in frames] * 2


def test_a_reset_node_forgets_and_goes_on(make_graph) -> None:
    graph = make_graph()
    labelled = graph.collect('labelled_points')
    graph.add(CloudLabellingNode())
    publishers = publish(graph, cloud_messages(1 * S))
    graph.until(lambda: len(labelled) == 1, 'the first keyframe')
    assert graph.call(Trigger, 'cloud_labelling/reset', Trigger.Request()).success
    publish(graph, cloud_messages(2 * S), publishers)
    graph.until(lambda: len(labelled) == 2, 'the second keyframe')
    first, second = (labelled_arrays(message, '').confidence for message in labelled)
    np.testing.assert_array_equal(first, second)
