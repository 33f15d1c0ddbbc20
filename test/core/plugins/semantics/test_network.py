"""Networks from files: what they see, and one line for those that are no such files."""

import json
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from small_network import conv, grey_network, helper, write_network

from segfloor_ros.core.contracts import FLOOR, MOVING, NO_EVIDENCE, NOT_FLOOR
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.plugins.semantics.outputs import UNLABELLED, mask_rcnn, semantic, yolo_seg
from segfloor_ros.nodes.network_files import open_network

IMAGE = np.zeros((60, 80), np.uint8)
IMAGE[:, 30:] = 200


@pytest.mark.parametrize('runtime', ['opencv', 'onnxruntime'])
def test_a_network_labels_an_image_of_any_size(tmp_path, runtime) -> None:
    if runtime == 'onnxruntime':
        pytest.importorskip('onnxruntime')
    network = open_network(grey_network(tmp_path / 'grey.onnx', runtime=runtime))
    found = network.infer(IMAGE)
    assert found.labels.dtype == np.uint8
    assert found.labels.shape == IMAGE.shape
    assert (found.labels[:, :28] == 0).all()
    assert (found.labels[:, 32:] == 1).all()
    assert not found.instances.any()


def test_a_network_of_opencv_has_all_cores(tmp_path) -> None:
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        open_network(grey_network(tmp_path / 'grey.onnx', runtime='opencv'))
        assert cv2.getNumThreads() == cv2.getNumberOfCPUs()
    finally:
        cv2.setNumThreads(before)


def test_onnxruntime_also_runs_a_network_for_one_image_without_a_batch(tmp_path) -> None:
    pytest.importorskip('onnxruntime')
    file = write_network(
        tmp_path / 'n.onnx',
        [helper.make_node('Mul', ['image', 'factor'], ['numbers'])],
        {'factor': np.array([1 / 200])},
        [1, 6, 8],
        {'numbers': [1, 6, 8]},
        kind='semantic', input=[8, 6], classes=['a', 'b'], mean=[0.0], scale=[1.0],
        runtime='onnxruntime',
    )  # fmt: skip
    labels = open_network(file).infer(IMAGE).labels
    assert (labels[:, :20] == 0).all() and (labels[:, 40:] == 1).all()


def test_a_colour_image_goes_in_as_red_green_blue(tmp_path) -> None:
    file = write_network(
        tmp_path / 'red.onnx',
        [conv('image', 'scores', 'w', 'b')],
        {'w': np.eye(3).reshape(3, 3, 1, 1), 'b': np.zeros(3)},
        [1, 3, 4, 4],
        {'scores': [1, 3, 4, 4]},
        kind='semantic', input=[4, 4], classes=['red', 'green', 'blue'],
    )  # fmt: skip
    bgr = np.zeros((4, 4, 3), np.uint8)
    bgr[:, :2, 2], bgr[:, 2:, 0] = 255, 255
    labels = open_network(file).infer(bgr).labels
    assert (labels[:, :2] == 0).all()
    assert (labels[:, 2:] == 2).all()


def test_what_labels_mean_for_the_floor(tmp_path) -> None:
    network = open_network(grey_network(tmp_path / 'n.onnx', moves=['dark'], floor=['light']))
    labels = np.array([[0, 1, UNLABELLED]], np.uint8)
    assert network.says(labels).tolist() == [[MOVING, FLOOR, NO_EVIDENCE]]
    network = open_network(grey_network(tmp_path / 'n.onnx', barrier=['dark']))
    assert network.says(labels).tolist() == [[NOT_FLOOR, NO_EVIDENCE, NO_EVIDENCE]]
    said = json.loads(network.settings.as_json())
    assert said['names'] == {'0': 'dark', '1': 'light'}
    assert said['barrier'] == ['dark']


def test_a_yolo_file_gives_an_instance(tmp_path) -> None:
    """One box around (8, 4), 8 wide and 4 high, of the second of two classes; its mask is full."""
    found = np.array([8, 4, 8, 4, 0.1, 0.9, 1.0])  # box, scores, one coefficient
    file = write_network(
        tmp_path / 'yolo.onnx',
        [
            conv('image', 'all', 'w', 'b', strides=[8, 16]),
            helper.make_node('Reshape', ['all', 'shape'], ['output0']),
            conv('image', 'output1', 'wp', 'bp', strides=[2, 2]),
        ],
        {
            'w': np.zeros((7, 1, 8, 16)), 'b': found, 'shape': [1, 7, 1],
            'wp': np.zeros((1, 1, 2, 2)), 'bp': np.array([3.0]),
        },
        [1, 1, 8, 16],
        {'output0': [1, 7, 1], 'output1': [1, 1, 4, 8]},
        kind='yolo_seg', input=[16, 8], classes=['person', 'chair'], mean=[0.0],
    )  # fmt: skip
    seen = open_network(file).infer(np.zeros((16, 32), np.uint8))
    expected = np.full((16, 32), UNLABELLED, np.uint8)
    expected[4:12, 8:24] = 1
    assert np.array_equal(seen.labels, expected)
    assert np.array_equal(seen.instances > 0, expected == 1)


def described(classes=2, size=(16, 8), score=0.5):
    return SimpleNamespace(classes=[str(i) for i in range(classes)], input=list(size), score=score)


def test_of_boxes_that_overlap_the_surest_counts_and_one_that_is_unsure_does_not() -> None:
    boxes = np.array([[4, 4, 8, 8], [5, 4, 8, 8], [12, 4, 4, 4], [12, 4, 4, 4.0]])
    scores = np.array([[0.8, 0], [0.9, 0], [0, 0.7], [0.4, 0]])
    rows = np.hstack([boxes, scores, np.ones((4, 1))])
    prototypes = np.ones((1, 1, 8, 16))
    seen = yolo_seg([rows.T[None], prototypes], described(), (16, 8))
    assert sorted(np.unique(seen.instances)) == [0, 1, 2]
    assert (seen.labels[:, 1:9] == 0).all()
    assert (seen.labels[:, 0] == UNLABELLED).all()  # the box of the less sure one
    assert (seen.labels[3:5, 11:13] == 1).all()
    with_object = np.hstack([boxes, np.full((4, 1), 0.5), scores, np.ones((4, 1))])
    assert (yolo_seg([with_object[None], prototypes], described(), (16, 8)).instances == 0).all()


@pytest.mark.parametrize('whole', [False, True])
def test_mask_rcnn_gives_masks_of_boxes_or_of_the_image(whole) -> None:
    boxes = np.array([[4, 2, 12, 6], [0, 0, 4, 4.0]])
    mask = np.zeros((2, 1, 8, 16) if whole else (2, 1, 28, 28))
    if whole:
        mask[0, 0, 2:6, 4:8] = 1
    else:
        mask[0, 0, :, :14] = 1  # the left half of the box
    outputs = [boxes, np.array([1, 1]), np.array([0.9, 0.3]), mask]
    seen = mask_rcnn(outputs, described(), (16, 8))
    expected = np.full((8, 16), UNLABELLED)
    expected[2:6, 4:8] = 1
    assert np.array_equal(seen.labels, expected)
    none = [boxes[:0], np.zeros(0), np.zeros(0), mask[:0]]
    assert (mask_rcnn(none, described(), (16, 8)).labels == UNLABELLED).all()


def test_numbers_of_classes_instead_of_scores() -> None:
    numbers = np.array([[[0, 1], [7, 1]]])
    labels = semantic([numbers], described(), (2, 2)).labels
    assert labels.tolist() == [[0, 1], [UNLABELLED, 1]]


def changed(path: Path, **changes) -> None:
    file = path.with_suffix('.yaml')
    file.write_text(yaml.safe_dump({**yaml.safe_load(file.read_text()), **changes}))


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'kind': 'detection'}, "kind 'detection' is none of semantic, yolo_seg, mask_rcnn"),
        ({'inputs': [1, 2]}, 'unknown key inputs'),
        ({'input': [16]}, 'expected width and height'),
        ({'classes': [1, 2]}, '1 where str is expected'),
        ({'moves': ['person']}, "'person' is not among the classes"),
        ({'score': float('nan')}, 'where float is expected'),
        ({'classes': ['a', 'b', 'c']}, 'returns [1, 2, 8, 16], which is not semantic with 3'),
        ({'kind': 'yolo_seg'}, 'which is not yolo_seg with 2 classes'),
        ({'kind': 'mask_rcnn'}, 'which is not mask_rcnn with 2 classes'),
        ({'runtime': 'tensorrt'}, "runtime 'tensorrt' is none of opencv, onnxruntime"),
    ],
)
def test_a_description_that_does_not_fit_is_one_line(tmp_path, changes, words) -> None:
    file = grey_network(tmp_path / 'n.onnx')
    changed(file, **changes)
    with pytest.raises(InputError) as error:
        open_network(file)
    assert words in str(error.value)
    assert '\n' not in str(error.value)


def test_a_damaged_missing_or_foreign_file_is_one_line(tmp_path) -> None:
    file = grey_network(tmp_path / 'n.onnx')
    whole = file.read_bytes()
    for content in (b'', b'nothing', whole[: len(whole) // 2], b'\xff' * 500):
        file.write_bytes(content)
        with pytest.raises(InputError) as error:
            open_network(file)
        assert str(file) in str(error.value)
        assert '\n' not in str(error.value)
    file.write_bytes(whole)
    file.with_suffix('.yaml').unlink()
    with pytest.raises(InputError, match=r'n\.yaml: is missing'):
        open_network(file)
    with pytest.raises(InputError, match=r'none\.onnx'):
        open_network(tmp_path / 'none.onnx')
    with pytest.raises(InputError, match='is no ONNX file'):
        open_network(tmp_path / 'network.pt')
