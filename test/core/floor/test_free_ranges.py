"""What clears a costmap: the free ranges of a frame, and Nav2's rules applied to them."""

from dataclasses import replace

import numpy as np
import pytest
from costmap import Costmap
from stereo_room import CAMERA, MOUNT, ROOM_MAX, ROOM_MIN, StereoRoom, planar_pose

from segfloor_ros.core.camera.shrinking import shrunk_image
from segfloor_ros.core.contracts import CELL_M, FloorScan
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings
from segfloor_ros.nodes.messages.scans import free_ranges, near_obstacles
from segfloor_ros.nodes.slam_outputs import shrink_factor, shrunk_camera

NAN, INF = float('nan'), float('inf')


def test_ranges_are_as_rep_117_has_them() -> None:
    scan = FloorScan(
        0.0, 0.1,
        np.array([2.0, 2.0, 0.0, NAN, 4.0, 0.04], np.float32),
        np.array([NAN, 2.0, NAN, NAN, NAN, 0.05], np.float32),
        range_max_m=4.0,
    )  # fmt: skip
    sigma_m = 0.3 * (2.0 / 4.0) ** 2
    expected = [2.0, 2.0 - sigma_m - CELL_M, -INF, NAN, INF, -INF]
    np.testing.assert_allclose(free_ranges(scan), expected, rtol=1e-6)


def test_what_is_near_is_told_as_far_as_it_is_known_to_half_a_cell() -> None:
    scan = FloorScan(
        0.0, 0.1,
        np.array([0.0, 0.0, NAN, 1.0, 2.0], np.float32),
        np.array([0.8, 0.9, NAN, 1.4, 1.5], np.float32),
        range_max_m=5.0,
    )  # fmt: skip
    ranges, reach_m = near_obstacles(scan)
    assert scan.error_per_m * reach_m**2 == pytest.approx(CELL_M / 2)
    assert 1.4 < reach_m < 1.5
    np.testing.assert_allclose(ranges, [0.8, 0.9, INF, 1.4, INF], rtol=1e-6)
    ends = replace(scan, ranges_m=ranges).ends()
    np.testing.assert_allclose(np.hypot(*ends.T[:2]), [0.8, 0.9, 1.4], rtol=1e-6)
    np.testing.assert_allclose(ends[2], [1.4 * np.cos(0.3), 1.4 * np.sin(0.3), 0.0], rtol=1e-6)


def test_a_shrunk_camera_sees_a_point_where_its_pixel_has_gone() -> None:
    camera = shrunk_camera(CAMERA, 2)
    assert (camera.width, camera.height) == (160, 120)
    point = np.array([[0.3, -0.2, 2.0]])
    uv, uv_small = CAMERA.project(point)[0], camera.project(point)[0]
    # The centre of the small pixel (0, 0) is that of the four pixels (0, 0) to (1, 1).
    np.testing.assert_allclose((uv[:2] + 0.5) / 2 - 0.5, uv_small[:2])
    image = np.arange(20, dtype=np.uint8).reshape(4, 5)
    np.testing.assert_array_equal(shrunk_image(image, 2), [[3, 5], [13, 15]])
    assert shrink_factor(CAMERA) == 1
    assert shrink_factor(shrunk_camera(CAMERA, 2)) == 1


@pytest.mark.parametrize('seed', [3, 4])
def test_marks_on_free_floor_go_when_it_is_seen_and_those_on_walls_stay(seed) -> None:
    """Somebody has walked past and left marks; the room's walls are marked, too."""
    base = planar_pose(2.0, 0.3, 0.35)
    frame = StereoRoom(seed=seed).frame(0, base)
    stage = FloorSegmentation(CAMERA, FloorSegmentationSettings())
    scan = stage.process(frame.left, frame.right, MOUNT).scan
    costmap = Costmap(ROOM_MIN[:2] - 0.5, ROOM_MAX[:2] + 0.5)
    walls = wall_points()
    ghosts = np.array([[3.0, 0.5], [3.2, 0.8], [3.8, 1.0], [3.5, 0.4]])
    behind = np.array([[0.5, 0.0]])
    costmap.mark(np.vstack([walls, ghosts, behind]), base[:2, 3], 10.0)
    costmap.clear(base, scan.bearings_rad, free_ranges(scan), scan.range_max_m, 3.0)
    assert not costmap.is_lethal(ghosts).any()
    assert costmap.is_lethal(behind).all(), 'nobody looked there'
    assert costmap.is_lethal(walls).mean() > 0.99


def wall_points() -> np.ndarray:
    """Return points (N, 2) on the four walls of the room."""
    (x0, y0), (x1, y1) = ROOM_MIN[:2], ROOM_MAX[:2]
    x, y = np.arange(x0, x1, 0.02), np.arange(y0, y1, 0.02)
    along_x = [np.stack([x, np.full_like(x, end)]) for end in (y0, y1)]
    along_y = [np.stack([np.full_like(y, end), y]) for end in (x0, x1)]
    return np.hstack([*along_x, *along_y]).T


def test_the_costmap_follows_nav2s_rules() -> None:
    costmap = Costmap(np.array([-1.0, -1.0]), np.array([5.0, 1.0]))
    points = np.array([[1.0, 0.02], [2.0, 0.02], [3.0, 0.02], [4.5, 0.02]])
    origin = np.eye(4)
    costmap.mark(points, np.zeros(2), obstacle_max_range=4.0)
    np.testing.assert_array_equal(costmap.is_lethal(points), [True, True, True, False])
    costmap.clear(origin, np.zeros(1), np.array([NAN]), 4.0, raytrace_max_range=3.0)
    assert costmap.is_lethal(points[:3]).all()
    costmap.clear(origin, np.zeros(1), np.array([-INF]), 4.0, raytrace_max_range=3.0)
    assert costmap.is_lethal(points[:3]).all()
    costmap.clear(origin, np.zeros(1), np.array([1.5]), 4.0, raytrace_max_range=3.0)
    np.testing.assert_array_equal(costmap.is_lethal(points), [False, True, True, False])
    costmap.clear(origin, np.zeros(1), np.array([INF]), 4.0, raytrace_max_range=2.5)
    np.testing.assert_array_equal(costmap.is_lethal(points), [False, False, True, False])
