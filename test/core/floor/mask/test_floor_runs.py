"""Stretches of a picture drawn by hand."""

import numpy as np

from segfloor_ros.core.floor.disparity.profile import pixels_where
from segfloor_ros.core.floor.mask.filling import Runs

PICTURE = np.array([[1, 1, 0, 0, 1], [0, 0, 0, 0, 0], [0, 1, 1, 1, 0], [1, 0, 0, 1, 1]], bool)
VALUES = np.arange(20, dtype=np.uint8).reshape(4, 5)


def test_stretches_end_with_their_row():
    runs = Runs.of(PICTURE)
    found = list(zip(runs.row.tolist(), runs.first.tolist(), runs.stop.tolist(), strict=True))
    assert found == [(0, 0, 2), (0, 4, 5), (2, 1, 4), (3, 0, 1), (3, 3, 5)]


def test_neighbours_of_stretches():
    runs = Runs.of(PICTURE)
    assert runs.before(VALUES, 99).tolist() == [99, 3, 10, 99, 17]
    assert runs.after(VALUES, 99).tolist() == [2, 99, 14, 16, 99]


def test_chosen_stretches_are_painted():
    runs = Runs.of(PICTURE)
    some = runs.painted(np.array([False, True, True, False, True]))
    assert some.astype(int).tolist() == [
        [0, 0, 0, 0, 1],
        [0, 0, 0, 0, 0],
        [0, 1, 1, 1, 0],
        [0, 0, 0, 1, 1],
    ]
    assert np.array_equal(runs.painted(np.ones(5, bool)), PICTURE)
    assert not runs.painted(np.zeros(5, bool)).any()


def test_full_and_empty_pictures():
    full = Runs.of(np.ones((3, 4), bool))
    assert full.first.tolist() == [0, 0, 0]
    assert full.stop.tolist() == [4, 4, 4]
    assert len(Runs.of(np.zeros((3, 4), bool)).row) == 0


def test_pixels_are_found_as_by_nonzero():
    picture = np.random.default_rng(0).random((17, 23)) > 0.5
    assert np.array_equal(pixels_where(picture), np.nonzero(picture))
