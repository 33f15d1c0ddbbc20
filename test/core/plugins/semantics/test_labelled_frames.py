"""A network beside a drive: which frames it looks at, and when it is not believed."""

import logging

import cv2
import numpy as np
import pytest
from small_network import constant_network, conv, grey_network, write_network
from stereo_drive import room_drive, write_kitti

from segfloor_ros.apps.recordings.opening import open_source
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.contracts import FLOOR, MOVING, NO_EVIDENCE, StereoFrame
from segfloor_ros.core.plugins.semantics.network import ImageLabeller
from segfloor_ros.core.timing import StageTimes
from segfloor_ros.nodes.network_files import open_network


def frames(count, dark_columns=20):
    image = np.full((60, 80), 220, np.uint8)
    image[:, :dark_columns] = 10
    return [StereoFrame(i, i * 10**8, np.roll(image, i, axis=1), image) for i in range(count)]


def labeller(tmp_path, **changes):
    settings = {'width': 80, 'height': 60, 'moves': ['dark'], 'floor': ['light']} | changes
    times = StageTimes()
    return ImageLabeller(open_network(grey_network(tmp_path / 'n.onnx', **settings)), times), times


def test_every_image_is_looked_at_once_and_has_its_mask(tmp_path) -> None:
    stage, times = labeller(tmp_path)
    masked = list(stage.with_masks(iter(frames(4))))
    for frame in masked:
        np.testing.assert_array_equal(frame.excluded == 255, frame.left == 10)
        said = stage.says(frame.stamp_ns, frame.left)
        assert set(np.unique(said)) == {MOVING, FLOOR}
    assert len(times.durations_s['network']) == 4
    assert stage.remarks == []


def test_frames_between_keep_the_mask_of_the_last_one(tmp_path) -> None:
    stage, times = labeller(tmp_path, every=3)
    masked = list(stage.with_masks(iter(frames(5))))
    masks = [frame.excluded for frame in masked]
    assert masks[0] is not None and (masks[1] == masks[0]).all() and (masks[2] == masks[0]).all()
    np.testing.assert_array_equal(masks[3] == 255, masked[3].left == 10)
    assert len(times.durations_s['network']) == 2


def test_one_for_keyframes_alone_gives_no_masks_ahead(tmp_path) -> None:
    stage, times = labeller(tmp_path, every=0)
    assert stage.is_late
    assert [frame.excluded for frame in stage.with_masks(iter(frames(3)))] == [None] * 3
    assert 'network' not in times.durations_s


def test_a_mask_given_beside_is_joined(tmp_path) -> None:
    stage, _ = labeller(tmp_path)
    given = np.zeros((60, 80), np.uint8)
    given[:, 70:] = 255
    frame = frames(1)[0]
    frame = StereoFrame(0, 0, frame.left, frame.right, given)
    joined = next(iter(stage.with_masks(iter([frame])))).excluded
    assert joined is not None
    np.testing.assert_array_equal(joined == 255, (frame.left == 10) | (given == 255))


def test_where_nearly_everything_moves_nothing_is_left_out_and_it_is_said_once(
    tmp_path, caplog
) -> None:
    classes = ['floor', 'person']
    file = constant_network(tmp_path / 'n.onnx', 'person', classes, moves=['person'])
    stage = ImageLabeller(open_network(file))
    with caplog.at_level(logging.WARNING):
        masked = list(stage.with_masks(iter(frames(3))))
    assert not any(frame.excluded.any() for frame in masked if frame.excluded is not None)
    assert (stage.says(0, masked[0].left) == NO_EVIDENCE).all()
    assert len(caplog.records) == len(stage.remarks) == 1
    assert '100 % of an image are of classes that move' in stage.remarks[0]


@pytest.mark.parametrize('every', [0, 1, 2])
def test_a_network_for_colours_gets_those_of_the_recording(tmp_path, every) -> None:
    folder = write_kitti(tmp_path / 'drive', room_drive(3)[0])
    for file in (folder / 'image_0').iterdir():
        bgr = np.stack([cv2.imread(str(file), cv2.IMREAD_UNCHANGED)] * 3, axis=2)
        half = bgr.shape[1] // 2
        bgr[:, :half, 0] //= 2
        bgr[:, half:, 2] //= 2
        cv2.imwrite(str(file), bgr)
    file = write_network(
        tmp_path / 'red.onnx', [conv('image', 'scores', 'w', 'b')],
        {'w': np.eye(3)[[0, 2]].reshape(2, 3, 1, 1), 'b': np.zeros(2)}, [1, 3, 48, 64],
        {'scores': [1, 2, 48, 64]}, kind='semantic', input=[64, 48], classes=['red', 'blue'],
        every=every,
    )  # fmt: skip
    stage = ImageLabeller(open_network(file))
    source = open_source(StereoCameraSettings(input=str(folder)))
    source.takes_colour = stage.sees_colours
    frames = list(stage.with_masks(source.frames()))
    for frame in frames:
        assert frame.left.ndim == 2 and frame.colour is None
        labels = stage.labels(frame.stamp_ns, frame.left)
        half = labels.shape[1] // 2
        assert (labels[:, : half - 8] == 0).mean() > 0.99
        assert (labels[:, half + 8 :] == 1).mean() > 0.99
