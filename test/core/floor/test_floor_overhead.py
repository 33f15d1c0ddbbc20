"""What ends the scan although the floor goes on below it."""

import numpy as np
import pytest
from floor_scenes import CAMERA, FLOORS, MOUNT, Patch, Scene, floor_patch, wall

from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings

BOARD_M, WALL_M = 2.0, 4.0


def board(bottom_m: float, width_m: float = 1.0, height_m: float = 0.08, **looks: float) -> Patch:
    """The front of a board across the way."""
    corner = (BOARD_M, -width_m / 2, bottom_m)
    looks = {'grey': 90.0, 'seed': 8, **looks}
    return Patch(corner, (0.0, width_m, 0.0), (0.0, 0.0, height_m), False, **looks)


def scan_of(scene: Scene, **settings: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bearings (N,) in degrees, ranges of the floor and of what stands (N,) along x in metres."""
    left, right, _, _ = scene.render()
    stage = FloorSegmentation(CAMERA, FloorSegmentationSettings(**settings))
    scan = stage.process(left, right, MOUNT).scan
    along_x = np.cos(scan.bearings_rad)
    return np.degrees(scan.bearings_rad), scan.ranges_m * along_x, scan.obstacle_m * along_x


@pytest.mark.parametrize('floor_kind', FLOORS)
def test_a_board_at_the_robots_height_ends_the_scan(floor_kind):
    patches = [floor_patch(**floor_kind), wall(WALL_M), board(0.55)]
    bearing, floor_m, standing_m = scan_of(Scene(patches))
    below = np.abs(bearing) < 12  # the board reaches to 14 degrees
    assert np.median(floor_m[below]) == pytest.approx(BOARD_M, abs=0.05)
    assert np.nanmedian(standing_m[below]) == pytest.approx(BOARD_M, abs=0.05)
    beside = (np.abs(bearing) > 17) & (np.abs(bearing) < 30)
    assert np.median(floor_m[beside]) > 3.4


@pytest.mark.parametrize('floor_kind', FLOORS)
def test_a_table_top_of_six_centimetres_ends_the_scan(floor_kind):
    scene = Scene([floor_patch(**floor_kind), wall(WALL_M), board(0.55, height_m=0.06)])
    bearing, floor_m, _ = scan_of(scene)
    below = np.abs(bearing) < 12
    assert (np.abs(floor_m[below] - BOARD_M) < 0.1).mean() > 0.9


@pytest.mark.parametrize('floor_kind', FLOORS)
def test_a_board_of_one_colour_is_known_by_its_ends(floor_kind):
    patches = [floor_patch(**floor_kind), wall(WALL_M), board(0.5, height_m=0.3, contrast=0.0)]
    bearing, floor_m, _ = scan_of(Scene(patches))
    below = np.abs(bearing) < 12
    assert (floor_m[below] < BOARD_M + 0.15).mean() > 0.9
    beside = (np.abs(bearing) > 17) & (np.abs(bearing) < 30)
    assert np.median(floor_m[beside]) > 3.4


def test_what_hangs_higher_than_the_robot_does_not():
    bearing, floor_m, _ = scan_of(
        Scene([floor_patch(), wall(WALL_M), board(0.55)]), robot_height_m=0.5
    )
    assert np.median(floor_m[np.abs(bearing) < 12]) > 3.4


def test_a_board_is_not_much_wider_than_it_is():
    bearing, _, standing_m = scan_of(Scene([floor_patch(), wall(WALL_M), board(0.55)]))
    edge_deg = np.degrees(np.arctan2(0.5, BOARD_M))
    beyond = (np.abs(bearing) > edge_deg + 1.5) & (np.abs(bearing) < 40)
    assert not (np.abs(standing_m[beyond] - BOARD_M) < 0.2).any()


def test_a_wall_that_is_blank_below_is_known_by_what_is_above():
    blank = wall(2.5, contrast=0.0)
    poster = Patch((2.49, -1.0, 0.5), (0.0, 2.0, 0.0), (0.0, 0.0, 0.4), False, seed=3)
    bearing, _, standing_m = scan_of(Scene([floor_patch(far_m=2.5), blank, poster]))
    assert np.nanmedian(standing_m[np.abs(bearing) < 18]) == pytest.approx(2.5, abs=0.08)
    assert np.isfinite(standing_m[np.abs(bearing) < 18]).mean() > 0.9
