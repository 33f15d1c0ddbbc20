"""Faces that show nothing: the floor ends at their foot, and so does the scan."""

import numpy as np
import pytest
from floor_scenes import CAMERA, FLOORS, MOUNT, Patch, Scene, floor_patch, wall

from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings

AHEAD_DEG = 30.0


def ahead(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return how far along x the floor ends, and what stands there, on the bearings ahead."""
    left, right, _, _ = scene.render()
    scan = FloorSegmentation(CAMERA, FloorSegmentationSettings()).process(left, right, MOUNT).scan
    chosen = np.abs(np.degrees(scan.bearings_rad)) < AHEAD_DEG
    along_x = np.cos(scan.bearings_rad)
    return (scan.ranges_m * along_x)[chosen], (scan.obstacle_m * along_x)[chosen]


@pytest.mark.parametrize('floor_kind', FLOORS)
@pytest.mark.parametrize('distance_m', [1.3, 2.0, 2.9])
def test_a_blank_wall_stands_where_its_foot_is_seen(floor_kind, distance_m):
    blank = wall(distance_m, contrast=0.0, grey=160.0)
    floor_m, standing_m = ahead(Scene([floor_patch(**floor_kind), blank]))
    row_m = distance_m**2 / (MOUNT.height_m * CAMERA.fy)
    assert np.isfinite(standing_m).mean() > 0.9
    assert np.nanmedian(standing_m) == pytest.approx(distance_m, abs=row_m)
    assert np.nanmax(floor_m) < distance_m + 2 * row_m


@pytest.mark.parametrize('seed', range(3))
def test_noise_on_a_blank_wall_does_not_stand_behind_it(seed):
    patches = [floor_patch(), wall(2.6, contrast=0.0, grey=100.0)]
    floor_m, standing_m = ahead(Scene(patches, noise_grey=2.5, seed=seed))
    assert np.isfinite(standing_m).mean() > 0.9
    assert np.nanmax(np.maximum(floor_m, standing_m)) < 2.75


def test_nothing_stands_at_a_shadow_on_plain_floor():
    plain = floor_patch(contrast=0.0, grey=150.0)
    shadow = Patch((1.8, -4, 0.0005), (0.7, 0, 0), (0, 8, 0), True, contrast=0.0, grey=110.0)
    _, standing_m = ahead(Scene([plain, shadow, wall(3.2, contrast=25.0)]))
    assert not (standing_m < 2.9).any()


def test_nothing_stands_where_a_blank_patch_of_the_floor_begins():
    rug = Patch((1.6, -4, 0.0005), (0.6, 0, 0), (0, 8, 0), True, contrast=0.0, grey=170.0)
    _, standing_m = ahead(Scene([floor_patch(), rug, wall(3.0)]))
    assert not (standing_m < 2.7).any()
