"""What the last evidence in a row or column is, by pixels that are drawn here."""

import numpy as np
import pytest
from floor_scenes import CAMERA, MOUNT

from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, NOT_FLOOR
from segfloor_ros.core.floor.disparity.profile import (
    FloorLine,
    FloorProfile,
    FloorView,
    pixels_where,
)
from segfloor_ros.core.floor.mask.filling import fill_gaps
from segfloor_ros.core.floor.mask.pixel_evidence import below_floor, last_evidence

VALUES = {'.': NO_EVIDENCE, 'f': FLOOR, 'x': NOT_FLOOR}


def drawn(*rows: str) -> np.ndarray:
    return np.array([[VALUES[one] for one in row] for row in rows], np.uint8)


MASK = drawn('..f.x', '.....', 'x.f..', 'f..xx')


def test_the_last_evidence_in_a_row_is_the_pixel_itself_or_lies_to_its_left():
    at, is_floor = last_evidence(MASK, axis=1)
    assert at.tolist() == [[-1, -1, 2, 2, 4], [-1] * 5, [0, 0, 2, 2, 2], [0, 0, 0, 3, 4]]
    assert is_floor.astype(int).tolist() == [
        [0, 0, 1, 1, 0],
        [0, 0, 0, 0, 0],
        [0, 0, 1, 1, 1],
        [1, 1, 1, 0, 0],
    ]


def test_the_last_evidence_in_a_column_lies_above():
    at, is_floor = last_evidence(MASK)
    assert at.tolist() == [
        [-1, -1, 0, -1, 0],
        [-1, -1, 0, -1, 0],
        [2, -1, 2, -1, 0],
        [3, -1, 2, 3, 3],
    ]
    assert is_floor.astype(int).tolist() == [
        [0, 0, 1, 0, 0],
        [0, 0, 1, 0, 0],
        [0, 0, 1, 0, 0],
        [1, 0, 1, 0, 0],
    ]
    assert np.array_equal(below_floor(MASK), is_floor)


def test_full_and_empty_masks():
    full, empty = np.full((3, 4), FLOOR, np.uint8), np.full((3, 4), NO_EVIDENCE, np.uint8)
    for axis in (0, 1):
        at, is_floor = last_evidence(full, axis)
        assert np.array_equal(at, np.indices((3, 4))[axis]) and is_floor.all()
        at, is_floor = last_evidence(empty, axis)
        assert (at == -1).all() and not is_floor.any()


def gap_filled(*rows: str) -> list[str]:
    """Return rows of a mask whose gaps are filled where 3.2 columns of floor are half a metre."""
    view = FloorView.of(CAMERA, MOUNT, 200)
    line = FloorLine.of(CAMERA, MOUNT)
    half_metre_px = 3.2 * view.step * CAMERA.disparity_times_depth / (0.5 * CAMERA.fx)
    profile = FloorProfile(line, 0.0, np.full(1000, half_metre_px), 1000.0)
    mask = drawn(*rows)
    names = {value: name for name, value in VALUES.items()}
    filled = fill_gaps(view, profile, mask, np.ones(mask.shape, bool))
    return [''.join(names[value] for value in row) for row in filled.tolist()]


@pytest.mark.parametrize(
    ('before', 'after'),
    [
        ('f..f' + 12 * 'x', 'ffff' + 12 * 'x'),  # three columns from floor to floor
        ('f...f' + 11 * 'x', 'f...f' + 11 * 'x'),  # four
        ('f..x' + 12 * 'x', 'f..x' + 12 * 'x'),
        ('...f' + 12 * 'x', '...f' + 12 * 'x'),  # nothing is known to the left of the image
        (13 * 'x' + 'f..', 13 * 'x' + 'f..'),  # it ends at the border
        (10 * 'x' + 'f.....', 10 * 'x' + 'f.....'),
    ],
)
def test_a_gap_is_filled_between_floor_that_is_near(before, after):
    assert gap_filled(before) == [after]


def test_pixels_are_found_as_by_nonzero():
    picture = np.random.default_rng(0).random((17, 23)) > 0.5
    assert np.array_equal(pixels_where(picture), np.nonzero(picture))
