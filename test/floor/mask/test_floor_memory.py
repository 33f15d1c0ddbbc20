"""What is remembered of the floor, on a view whose geometry is known."""

import numpy as np
import pytest
from floor_scenes import CAMERA, MOUNT

from segfloor_ros.floor.mask.remembered_floor import FloorMemory
from segfloor_ros.floor.mask.view import FloorView
from segfloor_ros.floor.observation import FLOOR, NO_EVIDENCE

FIRST_ROW = 220
VIEW = FloorView.of(CAMERA, MOUNT, FIRST_ROW)
SHAPE = VIEW.derolled.shape
NOTHING_UPRIGHT = np.zeros((2, 0), np.float32)
OPEN = np.ones(SHAPE, np.bool_)
WALL_M = 2.0


def row_of(distance_m):
    """The view's row that shows the floor straight ahead at a distance."""
    return int(VIEW.pixels_of_floor(np.array([[distance_m], [0.0]], np.float32))[0, 0])


def floor_up_to(row):
    mask = np.full(SHAPE, NO_EVIDENCE, np.uint8)
    mask[row:] = FLOOR
    return mask


def filled(memory, mask):
    return memory.fill(VIEW, mask, OPEN, np.eye(4))


@pytest.fixture
def taught():
    memory = FloorMemory()
    for _ in range(3):
        memory.learn(VIEW, floor_up_to(row_of(WALL_M)), NOTHING_UPRIGHT, np.eye(4))
    return memory


def test_floor_seen_before_fills_what_says_nothing_now(taught):
    mask = filled(taught, np.full(SHAPE, NO_EVIDENCE, np.uint8))
    middle = SHAPE[1] // 2
    assert (mask[row_of(1.5) : row_of(0.8), middle] == FLOOR).all()
    assert not (mask[: row_of(WALL_M + 0.1)] == FLOOR).any()


def test_the_last_rows_of_floor_are_not_remembered(taught):
    mask = filled(taught, np.full(SHAPE, NO_EVIDENCE, np.uint8))
    last = row_of(WALL_M)
    assert not (mask[last : last + 2] == FLOOR).any()
