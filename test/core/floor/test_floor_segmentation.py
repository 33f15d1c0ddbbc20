"""Floor masks of rendered scenes whose floor is known."""

import dataclasses

import cv2
import numpy as np
import pytest
from floor_scenes import (
    CAMERA,
    FLOORS,
    MOUNT,
    SMALL_CAMERA,
    Patch,
    Scene,
    box,
    floor_patch,
    ramp,
    wall,
)

from segfloor_ros.core.camera.depth import disparity_of_depth
from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, NOT_FLOOR, Mount
from segfloor_ros.core.floor.disparity.profile import FloorLine
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings

SETTINGS = FloorSegmentationSettings()


def segment(scene: Scene, poses=(None,)):
    left, right, floor, depth = scene.render()
    stage = FloorSegmentation(scene.camera, SETTINGS)
    for pose in poses:
        observation = stage.process(left, right, scene.mount, pose)
    return observation, floor, depth


def shares(observation, floor, depth):
    """Precision over the image; recall over floor from 0.5 to 6 m."""
    called = observation.mask == FLOOR
    wanted = floor & (depth > 0.5) & (depth < 6.0)
    return (called & floor).sum() / called.sum(), (called & wanted).sum() / wanted.sum()


def points_of(scene: Scene, depth):
    """Positions (H, W, 3) in the base frame of what the left image shows."""
    v, u = np.mgrid[0 : scene.camera.height, 0 : scene.camera.width]
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    z = np.where(np.isfinite(depth), depth, 100.0)
    T = scene.mount.T_base_left
    points = scene.camera.back_project(uv, z.ravel()) @ T[:3, :3].T + T[:3, 3]
    return points.reshape(*depth.shape, 3)


@pytest.mark.parametrize('roll_deg', [0.0, 5.0, -5.0])
def test_flat_floor_up_to_a_wall(roll_deg):
    mount = Mount(0.3, np.radians(7.0), np.radians(roll_deg))
    scene = Scene([floor_patch(), wall()], mount=mount)
    observation, floor, depth = segment(scene)
    precision, recall = shares(observation, floor, depth)
    assert precision > 0.99
    assert recall > 0.97
    assert observation.mask.dtype == np.uint8
    assert set(np.unique(observation.mask)) <= {FLOOR, NO_EVIDENCE, NOT_FLOOR}


def test_scan_ends_at_the_wall_and_not_behind_it():
    observation, _, _ = segment(Scene([floor_patch(), wall(3.0)]))
    scan = observation.scan
    distance = 3.0 / np.cos(scan.bearings_rad)
    ahead = np.abs(scan.bearings_rad) < np.radians(30)
    assert np.nanmax((scan.ranges_m - distance)[ahead]) < 0.10
    assert np.median((scan.ranges_m - distance)[ahead]) > -0.12


def test_no_ray_ends_in_what_the_right_camera_sees_at_its_border_alone():
    observation, _, _ = segment(Scene([floor_patch(), wall(6.0)]))
    scan = observation.scan
    known = scan.ranges_m > 0
    r, bearing = scan.ranges_m[known], scan.bearings_rad[known]
    ends = np.stack([r * np.cos(bearing), r * np.sin(bearing), np.zeros(len(r))], axis=1)
    T = np.linalg.inv(MOUNT.T_base_left)
    u_right = CAMERA.project(ends @ T[:3, :3].T + T[:3, 3])[:, 2]
    # A ray is cut back by 1.5 rows, that is 3 pixels of disparity at most.
    assert u_right.min() > 10 - 3


def test_a_blank_wall_is_not_floor():
    scene = Scene([floor_patch(), wall(contrast=0.0, grey=130.0)])
    precision, recall = shares(*segment(scene))
    assert precision > 0.99
    assert recall > 0.97


def test_a_blank_wall_right_ahead_is_no_floor():
    observation, floor, _ = segment(Scene([wall(0.4, contrast=0.0), floor_patch(far_m=0.4)]))
    assert np.mean(observation.mask[~floor] == FLOOR) < 0.01


@pytest.mark.parametrize('seed', [0, 8, 10])
def test_where_nothing_has_texture_the_floor_is_where_the_mount_says(seed):
    floor = Patch((0, -3, 0), (2.5, 0, 0), (0, 6, 0), is_floor=True, contrast=0.0)
    standing = Patch(
        (1.2, -1.5, 0), (1.6, 3, 0), (0, 0, 2), is_floor=False, contrast=0.0, grey=100.0
    )
    observation, _, _ = segment(Scene([floor, standing], SMALL_CAMERA, seed=seed))
    rows = np.arange(140, SMALL_CAMERA.height)
    line = FloorLine.of(SMALL_CAMERA, MOUNT)
    expected_px = line.slope * (rows - line.horizon)
    np.testing.assert_allclose(observation.profile_px[rows], expected_px, rtol=0.01)


@pytest.mark.parametrize(('lighter', 'is_floor'), [(6.0, True), (70.0, False)])
@pytest.mark.parametrize('floor_kind', FLOORS)
def test_a_blank_strip_between_floor_is_filled_if_it_looks_like_floor(
    floor_kind, lighter, is_floor
):
    scene = Scene(
        [
            floor_patch(far_m=1.2, **floor_kind),
            floor_patch(
                near_m=1.2, far_m=1.8, contrast=0.0, grey=floor_kind.get('grey', 120.0) + lighter
            ),
            floor_patch(near_m=1.8, **floor_kind),
            wall(),
        ]
    )
    observation, _, depth = segment(scene)
    x = points_of(scene, depth)[..., 0]
    strip = (x > 1.25) & (x < 1.75)
    share = np.mean(observation.mask[strip] == FLOOR)
    assert share > 0.9 if is_floor else share < 0.1


@pytest.mark.parametrize(('seed', 'grey'), [(33, 100.0), (21, 85.0)])
def test_blank_floor_is_filled_to_the_foot_of_what_stands_on_it(seed, grey):
    """Across the edge of a light, beyond which no floor has texture."""
    blank = [
        floor_patch(near_m=near_m, far_m=far_m, contrast=0.0, grey=grey + lighter)
        for near_m, far_m, lighter in ((1.0, 1.25, 4), (1.25, 2.0, 8))
    ]
    textured = floor_patch(far_m=1.0, seed=seed, grey=grey, contrast=9.0)
    scene = Scene([textured, *blank, wall(1.6)], SMALL_CAMERA)
    observation, floor, depth = segment(scene)
    # The last rows before the wall look like both.
    lit = floor & (np.abs(points_of(scene, depth)[..., 0] - 1.4) < 0.1)
    assert lit.sum() > 1000
    assert np.mean(observation.mask[lit] == FLOOR) > 0.9
    assert np.mean(observation.mask[~floor] == FLOOR) < 0.01


@pytest.mark.parametrize('floor_kind', FLOORS)
def test_a_lone_bit_of_floor_is_left_open(floor_kind):
    """Seen through an opening above a low sill, beside floor that is much larger."""
    whole = wall(1.0, contrast=14.0)
    ahead = [
        dataclasses.replace(whole, corner=(1.0, 0.175, 0.0), seed=5),
        dataclasses.replace(whole, corner=(1.0, -8.175, 0.0), seed=6),
        Patch((1.0, -0.175, 0.0), (0, 0.35, 0), (0, 0, 0.12), False, contrast=14.0, seed=7),
    ]
    scene = Scene([floor_patch(**floor_kind), wall(4.0), *ahead], SMALL_CAMERA)
    observation, floor, depth = segment(scene)
    behind = floor & (depth > 1.1)
    assert behind.sum() > 500
    assert (observation.mask[floor & (depth < 1.0)] == FLOOR).mean() > 0.95
    # At half the resolution its border may stay.
    assert (observation.mask[behind] == FLOOR).mean() < 0.1


def test_a_low_box_is_not_floor():
    scene = Scene([floor_patch(), wall(), *box(1.5, 0.0, 0.3, 0.05)])
    observation, floor, depth = segment(scene)
    points = points_of(scene, depth)
    raised = ~floor & (points[..., 0] < 2.0)
    assert np.mean(observation.mask[raised] == FLOOR) < 0.2
    ahead = np.abs(observation.scan.bearings_rad) < np.radians(3)
    assert np.allclose(observation.scan.ranges_m[ahead], 1.5, atol=0.06)


@pytest.mark.parametrize(('step_m', 'least_m', 'most_m'), [(0.03, 3.5, 4.1), (0.01, 1.3, 1.6)])
def test_a_door_sill_is_no_floor_but_a_robot_that_climbs_it_sees_what_is_behind(
    step_m, least_m, most_m
):
    scene = Scene([floor_patch(), wall(), *box(1.5, 0.0, 0.3, 0.02, is_floor=True)])
    left, right, _, depth = scene.render()
    settings = dataclasses.replace(SETTINGS, step_height_m=step_m)
    observation = FloorSegmentation(scene.camera, settings).process(left, right, scene.mount)
    points = points_of(scene, depth)
    sill = (points[..., 2] > 0.01) & (points[..., 0] < 1.9)
    assert np.mean(observation.mask[sill] == FLOOR) < 0.1
    if step_m > 0.02:
        assert np.mean(observation.mask[sill] == NOT_FLOOR) < 0.02
    ahead = np.abs(observation.scan.bearings_rad) < np.radians(3)
    ranges_m = observation.scan.ranges_m[ahead]
    assert np.all(ranges_m > least_m) and np.all(ranges_m < most_m)


@pytest.mark.parametrize('x_m', [1.0, 1.5])
def test_a_step_at_the_foot_of_what_stands_is_no_sill(x_m):
    scene = Scene([floor_patch(), wall(), *box(x_m, 0.0, 0.3, 0.02), *box(x_m + 0.1, 0, 0.3, 0.3)])
    observation, _, depth = segment(scene)
    points = points_of(scene, depth)
    step = (points[..., 2] > 0.01) & (points[..., 2] < 0.025) & (points[..., 0] < x_m + 0.1)
    step &= np.abs(points[..., 1]) < 0.14
    assert step.sum() > 300
    assert np.mean(observation.mask[step] == FLOOR) <= 0.1


@pytest.mark.parametrize(('stands', 'least', 'most'), [(False, 0.97, 1.0), (True, 0.0, 0.02)])
def test_what_looks_like_what_stands_on_it_is_not_floor(stands, least, most):
    """A dark patch alone is: it was measured."""
    dark = {'contrast': 10.0, 'grey': 25.0}
    patch = Patch((1.0, -0.2, 0.001), (0.2, 0, 0), (0, 0.4, 0), False, seed=4, **dark)
    scene = Scene([floor_patch(), wall(), patch, *(box(1.2, 0, 0.4, 0.3, **dark) * stands)])
    observation, _, depth = segment(scene)
    points = points_of(scene, depth)
    inside = (np.abs(points[..., 2]) < 0.005) & (np.abs(points[..., 0] - 1.1) < 0.09)
    inside &= np.abs(points[..., 1]) < 0.18
    assert least <= np.mean(observation.mask[inside] == FLOOR) <= most


@pytest.mark.parametrize('floor_kind', FLOORS)
@pytest.mark.parametrize(('slope_deg', 'least_recall'), [(10.0, 0.85), (15.0, 0.7)])
def test_a_ramp_is_floor(slope_deg, least_recall, floor_kind):
    slope_rad = np.radians(slope_deg)
    scene = Scene([floor_patch(far_m=1.5, **floor_kind), ramp(1.5, slope_rad, **floor_kind)])
    observation, floor, depth = segment(scene)
    precision, _ = shares(observation, floor, depth)
    below_horizon = points_of(scene, depth)[..., 2] < 0.25
    _, recall = shares(observation, floor & below_horizon, depth)
    assert precision > 0.99
    assert recall > least_recall


@pytest.mark.parametrize('floor_kind', FLOORS)
def test_a_ramp_is_floor_when_nothing_else_is_in_sight(floor_kind):
    slope_rad = np.radians(8.0)
    scene = Scene([floor_patch(far_m=0.25, **floor_kind), ramp(0.25, slope_rad, **floor_kind)])
    observation, floor, depth = segment(scene)
    precision, _ = shares(observation, floor, depth)
    below_camera = points_of(scene, depth)[..., 2] < 0.25
    _, recall = shares(observation, floor & below_camera, depth)
    assert precision > 0.99
    assert recall > 0.8


@pytest.mark.parametrize('fall', [0.02, 0.04])
def test_a_road_that_falls_to_both_sides_is_floor(fall):
    """Its profile is that of the middle: at 0.5 m to the side it lies 1 or 2 cm lower."""
    sides = [Patch((-1.0, 0, 0), (9.0, 0, 0), (0, 2.0 * y, -2.0 * fall), True) for y in (1, -1)]
    scene = Scene([*sides, wall()])
    observation, floor, depth = segment(scene)
    aside_m = np.abs(points_of(scene, depth)[..., 1])
    near = floor & (depth > 0.5) & (depth < 2.0) & (aside_m < 0.5)
    assert (observation.mask == FLOOR)[near].mean() > 0.94


@pytest.mark.parametrize('drop_m', [0.10, 0.15])
def test_the_floor_below_a_kerb_is_not_floor(drop_m):
    lower = dataclasses.replace(floor_patch(near_m=1.5, height_m=-drop_m), is_floor=False)
    scene = Scene([floor_patch(far_m=1.5), lower, wall(3.0)])
    observation, floor, depth = segment(scene)
    fallen = ~floor & (depth < 3.0) & (points_of(scene, depth)[..., 2] < 0)
    assert np.mean(observation.mask[fallen] == FLOOR) < 0.03
    ahead = np.abs(observation.scan.bearings_rad) < np.radians(20)
    assert (
        np.nanmax((observation.scan.ranges_m * np.cos(observation.scan.bearings_rad))[ahead]) < 1.6
    )


def test_unequal_exposure_does_no_harm():
    left, right, floor, depth = Scene([floor_patch(), wall()]).render()
    dark = (right * 0.75).astype(np.uint8)
    observation = FloorSegmentation(CAMERA, SETTINGS).process(left, dark, MOUNT)
    precision, recall = shares(observation, floor, depth)
    assert precision > 0.98
    assert recall > 0.95


@pytest.mark.parametrize('floor_kind', FLOORS)
@pytest.mark.parametrize(('pitch_deg', 'roll_deg'), [(2.5, 0.0), (0.0, -4.0), (0.0, 6.0)])
def test_a_robot_that_tilts_on_its_wheels_still_sees_its_floor(pitch_deg, roll_deg, floor_kind):
    """The pose in the map tells that the camera is not as it is mounted. Floor of weak texture,
    rolled by 6 degrees, is not found from the mount.
    """
    pitch_rad = MOUNT.pitch_rad + np.radians(pitch_deg)
    tilted = dataclasses.replace(MOUNT, pitch_rad=pitch_rad, roll_rad=np.radians(roll_deg))
    floor = floor_patch(**{**floor_kind, 'contrast': 6.0})
    scene = Scene([floor, wall(2.0)], SMALL_CAMERA, mount=tilted)
    left, right, floor, depth = scene.render()
    T_map_base = tilted.T_base_left @ np.linalg.inv(MOUNT.T_base_left)
    observation = FloorSegmentation(SMALL_CAMERA, SETTINGS).process(left, right, MOUNT, T_map_base)
    precision, recall = shares(observation, floor, depth)
    assert precision > 0.99
    assert recall > 0.93


def test_the_border_that_rectification_leaves_is_no_floor():
    left, right, floor, _ = Scene([floor_patch(), wall(2.0)]).render()
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    outside = (v > 479 - 60 * np.abs(u / 320 - 1) ** 2) | (u < 20)
    left, right = (np.where(outside, 0, np.maximum(image, 1)) for image in (left, right))
    mask = FloorSegmentation(CAMERA, SETTINGS).process(left, right, MOUNT).mask
    assert not (mask[outside] == FLOOR).any()
    inside = floor & (v < 400) & (u > 150)
    assert np.mean(mask[inside] == FLOOR) > 0.97


def test_same_input_same_output():
    scene = Scene([floor_patch(), wall(), *box(1.5, 0.3, 0.3, 0.2)])
    first, _, _ = segment(scene, (np.eye(4), np.eye(4)))
    second, _, _ = segment(scene, (np.eye(4), np.eye(4)))
    assert first.mask.tobytes() == second.mask.tobytes()
    assert first.scan.ranges_m.tobytes() == second.scan.ranges_m.tobytes()


def test_what_moves_is_no_obstacle_and_the_floor_it_hides_is_unknown():
    with_box = Scene([floor_patch(), *box(1.5, 0.0, 0.6, 0.6, 0.8)])
    left, right, _, _ = with_box.render()
    empty = Scene([floor_patch()]).render()
    moving = np.where(np.abs(left.astype(int) - empty[0]) > 12, 255, 0).astype(np.uint8)
    moving = cv2.morphologyEx(moving, cv2.MORPH_CLOSE, np.ones((21, 21), np.uint8))
    moving = cv2.dilate(moving, np.ones((9, 9), np.uint8))
    assert 0.03 < (moving > 0).mean() < 0.4
    stage = FloorSegmentation(with_box.camera, SETTINGS)
    seen = stage.process(left, right, with_box.mount)
    unseen = stage.process(left, right, with_box.mount, None, moving)
    ahead = np.abs(seen.scan.bearings_rad) < np.radians(8)
    assert np.nanmedian(seen.scan.obstacle_m[ahead]) == pytest.approx(1.5, abs=0.1)
    assert np.isnan(unseen.scan.obstacle_m[ahead]).all()
    assert np.nanmax(unseen.scan.ranges_m[ahead]) < 1.6
    # The mask is found in every other column.
    inside = cv2.erode(moving, np.ones((3, 3), np.uint8)) > 0
    assert (unseen.mask[inside] != FLOOR).all()


@pytest.mark.parametrize('near_m', [0.15, 0.002])
def test_measured_depth_may_be_nearer_than_any_floor(near_m):
    scene = Scene([floor_patch(), wall(4.0)])
    left, _, floor, depth = scene.render()
    near = np.zeros(depth.shape, bool)
    near[-120:, 200:300] = True
    measured = np.where(near, near_m, depth).astype(np.float32)
    disparity = disparity_of_depth(measured, scene.camera)
    observation = FloorSegmentation(scene.camera, SETTINGS).process(left, disparity, scene.mount)
    assert np.mean(observation.mask[near] == NOT_FLOOR) > 0.95
    precision, recall = shares(observation, floor & ~near, depth)
    assert precision > 0.99
    assert recall > 0.95
    assert observation.max_disparity_px >= observation.disparity_px.max()


@pytest.mark.parametrize(('near', 'below'), [(5.0, 30.0), (3.0, 8.0)])
def test_a_drop_close_ahead_does_not_take_the_floor_before_it(near, below):
    """What lies below has more texture, and a plane that is tilted and lowered would fit it."""
    lower = floor_patch(near_m=0.8, height_m=-0.2, contrast=below)
    lower = dataclasses.replace(lower, is_floor=False)
    scene = Scene([floor_patch(far_m=0.8, contrast=near), lower, wall(4.0)])
    observation, floor, depth = segment(scene)
    assert np.mean(observation.mask[floor] == FLOOR) > 0.85
    fallen = ~floor & (points_of(scene, depth)[..., 2] < 0)
    assert np.mean(observation.mask[fallen] == FLOOR) < 0.03


def test_what_stands_before_a_camera_that_looks_down_hides_no_floor_before_it():
    """The foot of a face is farther from such a camera than what is above it."""
    mount = Mount(1.1, 0.7)
    scene = Scene([floor_patch(), *box(1.2, 0.0, 0.5, 0.5, contrast=40.0)], mount=mount)
    observation, floor, depth = segment(scene)
    stands = ~floor & np.isfinite(depth)
    near_foot = cv2.dilate(stands.astype(np.uint8), np.ones((35, 1), np.uint8), anchor=(0, 34)) > 0
    called = observation.mask == FLOOR
    assert called[near_foot & floor].mean() > 0.75
    assert called[stands].mean() < 0.001


def test_images_that_differ_everywhere_are_compared_by_how_much_they_do():
    """As those of blocks of a compressed image, or of a blur of only one eye."""
    scene = Scene([floor_patch(contrast=45.0), wall(), *box(1.2, 0.3, 0.3, 0.3)], SMALL_CAMERA)
    left, right, floor, depth = scene.render()
    rng = np.random.default_rng(0)

    def spoilt(image):
        spots = cv2.GaussianBlur(rng.normal(size=image.shape), (0, 0), 1.5)
        return np.clip(image + 20 * spots / spots.std(), 0, 255).astype(np.uint8)

    observation = FloorSegmentation(SMALL_CAMERA, SETTINGS).process(
        spoilt(left), spoilt(right), MOUNT
    )
    called = observation.mask == FLOOR
    assert called[floor & (depth < 4.0)].mean() > 0.5
    assert floor[called].mean() > 0.99


@pytest.mark.parametrize('reflectance', [0.15, 0.6])
@pytest.mark.parametrize('contrast', [4.0, 18.0])
def test_what_a_floor_mirrors_is_no_obstacle_and_what_stands_on_it_no_floor(contrast, reflectance):
    """The image in the floor is seen as far below it as what it is of stands above."""
    things = [wall(3.0, contrast=40.0), *box(1.4, 0.3, 0.3, 0.3), *box(1.8, -0.6, 0.3, 0.4)]
    floor = floor_patch(contrast=contrast, grey=150.0)
    scene = Scene([floor, *things], SMALL_CAMERA, reflectance=reflectance)
    observation, is_floor, depth = segment(scene)
    assert (observation.mask == NOT_FLOOR)[is_floor & (depth < 3.0)].mean() < 0.03
    assert (observation.mask == FLOOR)[~is_floor & np.isfinite(depth)].mean() < 0.001
    assert not (observation.scan.obstacle_m < 1.3).any()


@pytest.mark.parametrize('low_m', [0.1, 0.2])
@pytest.mark.parametrize('is_measured', [False, True])
def test_what_lies_below_the_floor_is_neither_floor_nor_an_obstacle(low_m, is_measured):
    """A drop, or what a shiny patch of floor mirrors: of the one no more is known than of the
    other.
    """
    lower = dataclasses.replace(floor_patch(1.2, 3.0, height_m=-low_m), is_floor=False)
    scene = Scene([floor_patch(far_m=1.2), lower, floor_patch(near_m=3.0), wall(4.0)], SMALL_CAMERA)
    left, right, floor, depth = scene.render()
    if is_measured:
        right = disparity_of_depth(depth.astype(np.float32), SMALL_CAMERA)
    mask = FloorSegmentation(SMALL_CAMERA, SETTINGS).process(left, right, MOUNT).mask
    height_m = points_of(scene, depth)[..., 2]
    fallen = np.isfinite(depth) & (height_m < -low_m / 2)
    assert (mask[fallen] == NO_EVIDENCE).mean() > 0.95
    assert (mask == FLOOR)[floor & (depth < 1.2)].mean() > 0.9
