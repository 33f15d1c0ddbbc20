"""Counts of masks worked out by hand, inputs that come back from disk, and scenes of low things."""

import dataclasses
import json
import math

import cv2
import numpy as np
import pytest
from stereo_drive import room_drive
from stereo_room import CAMERA, MOUNT

from segfloor_ros.apps.simulation.scene_file import scene_from_mapping
from segfloor_ros.apps.simulation.solids import floors, obstacles, true_map
from segfloor_ros.core.contracts import FLOOR, NOT_FLOOR
from segfloor_ros.core.errors import InputError
from segfloor_ros.nodes.configuration import resolve
from tools.floor_bench import (
    BenchRow,
    FrameRow,
    count,
    error_picture,
    height_table,
    rows_by_name,
    segment,
    table_of,
    tiles,
    write_sheet,
)
from tools.floor_inputs import (
    OBSTACLE,
    OTHER,
    TRUE_FLOOR,
    UNKNOWN,
    BenchDrive,
    FloorDrive,
    FloorFrame,
    Truth,
    bench_drives,
    outlined_truth,
)
from tools.low_things import HEIGHTS_CM, SCENES, Thing, make_scene

LABEL = np.array(
    [[OTHER, OTHER, OBSTACLE, UNKNOWN], [TRUE_FLOOR, TRUE_FLOOR, OBSTACLE, UNKNOWN]], np.uint8
)
NEAR = np.array([[0, 0, 0, 0], [1, 1, 1, 1]], np.uint8)
HEIGHT_CM = np.array([[0, 0, 2, 0], [0, 0, 3, 0]], np.uint8)
TRUTH = Truth(LABEL, NEAR, HEIGHT_CM)
CALLED = np.array([[1, 0, 1, 1], [1, 0, 0, 1]], bool)
MASK = np.where(CALLED, np.uint8(FLOOR), np.uint8(NOT_FLOOR))


def row_of(name: str, frame: FrameRow) -> BenchRow:
    return BenchRow(name, 'low things', [frame])


def frame_row() -> FrameRow:
    return FrameRow(7, *count(MASK, TRUTH), 20.0)


def test_pixels_are_counted_as_a_whole_and_near() -> None:
    counts, by_height = count(MASK, TRUTH)
    assert counts == {'whole': [1, 2, 1, 1, 2], 'near': [1, 0, 1, 0, 1]}
    assert by_height == {'2': [1, 1], '3': [0, 1]}


def test_shares_and_badness() -> None:
    row = row_of('a', frame_row())
    assert row.share('whole', 'precision') == pytest.approx(100 / 3)
    assert row.share('near', 'precision') == 100
    assert row.share('whole', 'recall') == 50
    assert row.share('whole', 'obstacles') == 50
    right = FrameRow(1, {'whole': [5, 0, 0, 0, 0], 'near': [0] * 5}, {}, 1.0)
    assert math.isnan(row_of('b', right).share('near', 'obstacles'))
    assert right.badness == 0 < frame_row().badness


def cells(table) -> list[list[str]]:
    return [list(column.cells) for column in table.columns]


def test_figures_of_before_stand_before_arrows(tmp_path) -> None:
    row = row_of('a', frame_row())
    file = tmp_path / 'before.json'
    file.write_text(json.dumps({'rows': [dataclasses.asdict(row)]}))
    before = rows_by_name(file)
    assert before == {'a': row}
    better = FrameRow(7, {'whole': [2, 0, 0, 0, 2], 'near': [1, 0, 1, 0, 1]}, {'2': [0, 1]}, 20.0)
    columns = cells(table_of([row_of('a', better)], before))
    assert columns[2][0] == '33.3 → 100.0'
    assert columns[4][0] == '50.00 → 0.00'
    assert columns[5][0] == '100.0'
    heights = cells(height_table([row_of('a', better)], before))
    assert heights[HEIGHTS_CM.index(2) + 1] == ['100.0 → 0.0'] * 2
    assert heights[HEIGHTS_CM.index(1) + 1] == ['–'] * 2


def test_what_is_no_file_of_figures_is_named(tmp_path) -> None:
    file = tmp_path / 'other.json'
    file.write_text('{"rows": [{"name": "a"}]}')
    with pytest.raises(InputError, match=r'other\.json'):
        rows_by_name(file)


def test_errors_have_their_colours() -> None:
    picture = error_picture(np.full((2, 4), 100, np.uint8), MASK, TRUTH).astype(int)
    small = cv2.resize(picture.astype(np.uint8), (4, 2), interpolation=cv2.INTER_NEAREST)
    blue, green, red = (small[..., i].astype(int) for i in range(3))
    assert red[0, 2] > green[0, 2] + 50  # an obstacle called floor
    assert blue[1, 1] > red[1, 1] + 50  # missed floor
    assert green[1, 0] > red[1, 0] and green[1, 0] > blue[1, 0]  # right floor
    assert red[0, 0] > blue[0, 0] and green[0, 0] > blue[0, 0]  # other false floor
    assert blue[0, 3] == green[0, 3] == red[0, 3]  # not known


def test_drawn_truth_has_borders_that_do_not_count() -> None:
    outline = {
        'floor': [[0, 10, 39, 10, 39, 39, 0, 39]],
        'obstacle': [[10, 15, 20, 15, 20, 25, 10, 25]],
    }
    truth = outlined_truth(outline, (40, 40))
    assert truth.label[20, 15] == OBSTACLE
    assert truth.label[30, 30] == TRUE_FLOOR
    assert truth.label[20, 10] == truth.label[5, 5] == UNKNOWN
    assert truth.near[20].all() and not truth.near[19].any()


def test_a_drive_comes_back_from_disk_and_is_segmented(tmp_path) -> None:
    frames, T_world_base = room_drive(3)
    shape = frames[0].left.shape
    label = np.full(shape, OTHER, np.uint8)
    label[-40:] = TRUE_FLOOR
    truth = Truth(label, (label == TRUE_FLOOR).astype(np.uint8), np.zeros(shape, np.uint8))
    moving = np.zeros(shape, np.uint8)
    moving[:10] = 255
    made = [
        FloorFrame(0, frames[0].left, frames[0].right, None, None),
        FloorFrame(1, frames[1].left, frames[1].right, T_world_base[1], moving),
        FloorFrame(2, frames[2].left, frames[2].right, T_world_base[2], None, truth),
    ]
    drive = FloorDrive(CAMERA, MOUNT, made)
    drive.save(tmp_path / 'inputs' / 'room.npz', 'key')
    assert FloorDrive.read(tmp_path / 'inputs' / 'room.npz', 'other') is None
    assert FloorDrive.read(tmp_path / 'absent.npz', 'key') is None
    read = FloorDrive.read(tmp_path / 'inputs' / 'room.npz', 'key')
    assert read is not None and (read.camera, read.mount) == (CAMERA, MOUNT)
    assert read.frames[0].T_map_base is None and read.frames[0].truth is None
    np.testing.assert_array_equal(read.frames[1].T_map_base, T_world_base[1])
    np.testing.assert_array_equal(read.frames[1].moving, moving)
    np.testing.assert_array_equal(read.frames[2].truth.label, label)
    masks, row = segment(BenchDrive('room', 'rooms', tmp_path), read, resolve())
    assert [frame.index for frame in row.frames] == [*masks] == [2]
    assert row.share('near', 'recall') > 80
    worst = write_sheet(tmp_path / 'sheets', read, masks, row)
    assert cv2.imread(str(tmp_path / 'sheets' / 'room.png')).shape[1] == 2 * 640
    assert tiles([worst] * 5).shape[0] == 2 * (worst.shape[0] // 2)


@pytest.mark.slow
def test_drives_without_a_recording_are_left_out(tmp_path) -> None:
    drives = bench_drives(tmp_path)
    assert {one.name for one in drives} >= SCENES.keys()
    assert 'rover' not in {one.name for one in drives}
    (tmp_path / 'rover').mkdir()
    rover = next(one for one in bench_drives(tmp_path) if one.name == 'rover')
    assert rover.outlines.is_file()
    assert dataclasses.replace(rover, lead_in=3).key != rover.key


@pytest.mark.parametrize('name', SCENES)
def test_low_things_stand_apart_and_the_way_is_clear(name) -> None:
    values, things = make_scene(name)
    assert make_scene(name)[0] == values
    assert {thing.height_cm for thing in things} == set(HEIGHTS_CM)
    scene = scene_from_mapping(values, name)
    start = np.array(scene.path.waypoints[0])
    true_map(scene, obstacles(scene), floors(scene), start)
    tallest = max(thing.height_cm for thing in things)
    highest = max(prism.top_m.max() for prism in floors(scene)) if scene.slopes else 0.0
    tops = [box.size[2] for box in scene.boxes if box.size[2] < 0.5]
    assert max(tops) <= tallest / 100 + highest + 1e-6


def test_how_far_points_are_from_a_thing() -> None:
    thing = Thing((1.0, 2.0), (0.5, 0.1), 90.0, 4)
    points = np.array([[1.0, 2.4], [1.3, 2.0], [1.0, 2.8], [1.4, 2.9]])
    np.testing.assert_allclose(thing.distance_m(points), [0, 0.2, 0.3, 0.5], atol=1e-9)
