"""A network beside a drive: which frames it looks at, and when it is not believed."""

from __future__ import annotations

import logging

import numpy as np
from small_network import constant_network, grey_network

from segfloor_ros.camera.model import StereoFrame
from segfloor_ros.floor.observation import FLOOR, MOVING, NO_EVIDENCE
from segfloor_ros.semantics.network import ImageLabeller, Network
from segfloor_ros.timing import StageTimes


def frames(count, dark_columns=20):
    image = np.full((60, 80), 220, np.uint8)
    image[:, :dark_columns] = 10
    return [StereoFrame(i, i * 10**8, np.roll(image, i, axis=1), image) for i in range(count)]


def labeller(tmp_path, **changes):
    settings = {'width': 80, 'height': 60, 'moves': ['dark'], 'floor': ['light']} | changes
    times = StageTimes()
    return ImageLabeller(Network(grey_network(tmp_path / 'n.onnx', **settings)), times), times


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
    stage = ImageLabeller(Network(file))
    with caplog.at_level(logging.WARNING):
        masked = list(stage.with_masks(iter(frames(3))))
    assert not any(frame.excluded.any() for frame in masked if frame.excluded is not None)
    assert (stage.says(0, masked[0].left) == NO_EVIDENCE).all()
    assert len(caplog.records) == len(stage.remarks) == 1
    assert '100 % of an image are of classes that move' in stage.remarks[0]
