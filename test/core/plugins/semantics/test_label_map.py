"""Labels of points and cells: the likeliest class, where the keyframes lie now, and its files."""

import numpy as np
import pytest
from command_line import segfloor
from floor_scenes import CAMERA, MOUNT

from segfloor_ros.apps.label_files import draw_labels, filter_mask, save_labels
from segfloor_ros.apps.map_files import load_map
from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, NO_POINT, KeyframeFeatures, KeyframePath
from segfloor_ros.core.contracts import NOT_FLOOR as STANDING
from segfloor_ros.core.errors import InputError, SettingsError
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from segfloor_ros.core.plugins.semantics.label_map import LabelMap, Labels
from segfloor_ros.core.plugins.semantics.outputs import UNLABELLED
from segfloor_ros.nodes.map_files import save_map

CLASSES = ['carpet', 'tiles', 'door']
SHAPE = (CAMERA.height, CAMERA.width)


def features(uv=(), ids=()):
    uv_px = np.array(uv, np.float32).reshape(-1, 2)
    return KeyframeFeatures(uv_px, np.array(ids, np.int32), np.zeros((len(uv_px), 3)))


def seen(mask, depth_m=np.inf):
    """A floor mask, and the disparity where everything is as far away."""
    return mask, np.full(SHAPE, CAMERA.disparity_times_depth / depth_m, np.float32)


def floor_below(row=300):
    mask = np.full(SHAPE, NO_EVIDENCE, np.uint8)
    mask[row:] = FLOOR
    return mask


def grid(value, rows=60, columns=120):
    return OccupancyGrid(np.full((rows, columns), value, np.int8), 0.1, (-3.0, -3.0))


def path(*poses):
    stamps = np.arange(len(poses), dtype=np.int64)
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :2, 3] = np.reshape(poses, (-1, 2))
    return KeyframePath(stamps, T)


def where(cells, number):
    """Middle (x, y) of the cells of a class."""
    row, column = np.nonzero(cells == number)
    return np.array([column.mean(), row.mean()]) * 0.1 - 3.0


def test_floor_has_its_class_where_it_lies_and_follows_its_keyframe():
    labels = np.full(SHAPE, 0, np.uint8)
    labels[:, SHAPE[1] // 2 :] = 1  # on the right
    stage = LabelMap(CAMERA, CLASSES, 1.0)
    stage.add(0, labels, *seen(floor_below()), MOUNT, features(), 8.0)
    cells = stage.cells(grid(FREE), path((0, 0)))
    assert {*np.unique(cells)} == {0, 1, UNLABELLED}
    left, right = where(cells, 0), where(cells, 1)
    assert left[0] > 0.3 and left[1] > 0.1 and right[1] < -0.1
    moved = stage.cells(grid(FREE), path((1.0, -0.5)))
    np.testing.assert_allclose(where(moved, 0) - left, [1.0, -0.5], atol=0.05)
    # A quarter turn to the left: what was ahead is to the left, what was to the left is behind.
    turned = path((1.0, -0.5))
    turned.T_map_base[0, :2, :2] = [[0, -1], [1, 0]]
    here = where(stage.cells(grid(FREE, 120), turned), 0) - (1.0, -0.5)
    np.testing.assert_allclose(here, [-left[1], left[0]], atol=0.1)
    assert (stage.cells(grid(FREE), path()) == UNLABELLED).all()
    # What is seen as floor is no class of what stands there.
    assert (stage.cells(grid(OCCUPIED), path((0, 0))) == UNLABELLED).all()
    assert (stage.cells(grid(UNKNOWN), path((0, 0))) == UNLABELLED).all()


def test_what_stands_is_where_its_disparity_puts_it_and_not_above_the_robot():
    mask = np.full(SHAPE, STANDING, np.uint8)
    stage = LabelMap(CAMERA, CLASSES, 1.0)
    labels = np.full(SHAPE, 2, np.uint8)
    stage.add(0, labels, *seen(mask, 2.0), MOUNT, features(), 8.0)
    cells = stage.cells(grid(OCCUPIED), path((0, 0)))
    ahead = np.nonzero(cells[30] == 2)[0] * 0.1 - 3.0
    assert ahead.min() > 1.6 and ahead.max() < 2.2
    low = LabelMap(CAMERA, CLASSES, -9.0)
    low.add(0, labels, *seen(mask, 2.0), MOUNT, features(), 8.0)
    assert (low.cells(grid(OCCUPIED), path((0, 0))) == UNLABELLED).all()


def test_the_likeliest_class_of_a_point_counts_and_a_keyframe_told_anew_replaces_itself():
    stage = LabelMap(CAMERA, CLASSES, 1.0)
    nothing = seen(np.full(SHAPE, NO_EVIDENCE, np.uint8))
    uv = [[10, 10], [600, 400], [300, 5]]
    for stamp, number in enumerate((1, 2, 2)):
        labels = np.full(SHAPE, number, np.uint8)
        labels[:, :100] = UNLABELLED if stamp else 0
        stage.add(stamp, labels, *nothing, MOUNT, features(uv, [4, 7, NO_POINT]), 8.0)
    ids = np.array([2, 4, 7], np.int32)
    assert stage.points(ids).tolist() == [UNLABELLED, 0, 2]
    for stamp in (1, 2):
        labels = np.full(SHAPE, 1, np.uint8)
        stage.add(stamp, labels, *nothing, MOUNT, features(uv, [4, 7, -1]), 8.0)
    assert stage.points(ids).tolist() == [UNLABELLED, 1, 1]


@pytest.fixture
def saved(tmp_path):
    """A map of three rows and five columns, free but for one cell, with classes."""
    cells = np.full((3, 5), FREE, np.int8)
    cells[2, 4] = OCCUPIED
    numbers = np.full((3, 5), UNLABELLED, np.uint8)
    numbers[0, :2], numbers[1, 3], numbers[2, 4] = 0, 1, 2
    own = OccupancyGrid(cells, 0.05, (-1.0, 0.5))
    labels = Labels(CLASSES, numbers, np.zeros(0, np.uint8))
    save_labels(tmp_path / 'map_labels.yaml', own, labels)
    return tmp_path / 'map_labels.yaml', own, labels


def test_labels_are_read_by_the_rules_of_map_server(saved):
    file, own, labels = saved
    read = load_map(file)
    np.testing.assert_array_equal(read.cells, labels.cells.astype(np.int8))
    assert read.origin_xy_m == own.origin_xy_m and read.resolution_m == 0.05


def test_a_filter_has_its_values_where_its_classes_are(saved, tmp_path):
    file, *_ = saved
    expected = np.zeros((3, 5), np.int8)
    expected[0, :2] = 100
    np.testing.assert_array_equal(filter_mask(file, {'carpet': 100}).cells, expected)
    done = segfloor('map', 'filter', file, tmp_path / 'k.yaml', '--keepout', 'carpet')
    assert done.returncode == 0 and 'type: 0' in done.stdout
    np.testing.assert_array_equal(load_map(tmp_path / 'k.yaml').cells, expected)
    words = ('--speed', 'carpet=30', '--speed', 'tiles=80')
    done = segfloor('map', 'filter', file, tmp_path / 's.yaml', *words)
    assert 'type: 1, base: 100.0, multiplier: -1.0' in done.stdout
    expected[0, :2], expected[1, 3] = 70, 20
    np.testing.assert_array_equal(load_map(tmp_path / 's.yaml').cells, expected)


def test_what_is_no_class_or_no_share_is_one_line(saved, tmp_path):
    file, own, _ = saved
    with pytest.raises(SettingsError, match='lawn is none of carpet, tiles, door'):
        filter_mask(file, {'lawn': 100})
    save_map(own, tmp_path / 'map.yaml')
    with pytest.raises(InputError, match='names no classes'):
        filter_mask(tmp_path / 'map.yaml', {'carpet': 100})
    for words in (
        (),
        ('--speed', 'carpet'),
        ('--speed', 'carpet=0'),
        ('--speed', 'a=1', '--keepout', 'a'),
    ):
        done = segfloor('map', 'filter', file, tmp_path / 'm.yaml', *words)
        assert done.returncode == 2
    assert not (tmp_path / 'm.yaml').exists()


def test_the_picture_shows_each_class_and_names_it_below(saved):
    _, own, labels = saved
    picture = draw_labels(own, labels)
    side = (picture.shape[1]) // 5
    rows = [
        picture[(2 - row) * side + 5, column * side + 5] for row, column in ((0, 0), (1, 3), (2, 4))
    ]
    assert len({tuple(colour) for colour in rows}) == 3
    np.testing.assert_array_equal(picture[5, 5], (254, 254, 254))  # free, of no class
    assert picture.shape[0] > 3 * side


def test_labels_of_a_file_join_those_of_a_drive_by_their_names():
    first = LabelMap(CAMERA, CLASSES, 1.0)
    labels = np.full(SHAPE, 2, np.uint8)
    seen_here = seen(np.full(SHAPE, STANDING, np.uint8), 2.0)
    first.add(5, labels, *seen_here, MOUNT, features([[10, 10]], [4]), 8.0)
    second = LabelMap(CAMERA, ['door', 'lift'], 1.0)
    second.from_arrays(first.to_arrays(), -5, 100)
    assert second.classes == ['door', 'lift', 'carpet', 'tiles']
    second.add(1, labels - 1, *seen_here, MOUNT, features([[10, 10]], [7]), 8.0)
    made = second.labels(grid(OCCUPIED), path((0, 0), (0.8, 0)), np.array([7, 104], np.int32))
    assert made.points.tolist() == [1, 0]
    np.testing.assert_allclose(where(made.cells, 1) - where(made.cells, 0), [0.8, 0], atol=0.05)
    damaged = first.to_arrays() | {'names': np.zeros(0, np.uint8)}
    with pytest.raises((IndexError, ValueError)):
        LabelMap(CAMERA).from_arrays(damaged)
    assert LabelMap(CAMERA).labels(grid(FREE), path((0, 0)), np.zeros(0, np.int32)) is None


def test_what_could_move_has_its_class_where_the_mask_says_nothing():
    nothing = seen(np.full(SHAPE, NO_EVIDENCE, np.uint8), 2.0)
    for moves, expected in (((), {UNLABELLED}), (('door',), {2, UNLABELLED})):
        stage = LabelMap(CAMERA, CLASSES, 1.0, moves)
        stage.add(0, np.full(SHAPE, 2, np.uint8), *nothing, MOUNT, features(), 8.0)
        assert {*np.unique(stage.cells(grid(OCCUPIED), path((0, 0))))} == expected
