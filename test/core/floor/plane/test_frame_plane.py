"""The plane of the floor in one frame: pitch, roll and height, by what is seen and expected."""

import re
from dataclasses import replace

import numpy as np
import pytest
from floor_scenes import CAMERA, MOUNT, SMALL_CAMERA, Patch, Scene, box, floor_patch, wall

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, NOT_FLOOR, Mount
from segfloor_ros.core.floor.disparity.profile import FloorLine, column_step
from segfloor_ros.core.floor.plane.plane import (
    PROVED,
    Fixture,
    PlaneFit,
    expectations,
    plane_of_frame,
)
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings

LONG_CAMERA = StereoCamera(1280, 480, 1000.0, 1000.0, 640.0, 200.0, 0.12)


def pitched(pitch_deg: float):
    """Return the pose (4, 4) of a base that looks down by so much."""
    angle, pose = np.radians(pitch_deg), np.eye(4)
    pose[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)
    return pose


def test_a_frame_is_expected_as_mounted_and_level_and_high_as_in_the_map():
    pose = pitched(4.0)
    pose[2, 3] = 0.2
    height_m = (pose @ MOUNT.T_base_left)[2, 3]
    known = expectations(MOUNT, pose)
    np.testing.assert_allclose(np.degrees(known[:, 0] - MOUNT.pitch_rad), [0.0, 4.0, 4.0])
    np.testing.assert_allclose(known[:, 2], [MOUNT.height_m, MOUNT.height_m, height_m])
    assert len(expectations(MOUNT, None)) == 1


@pytest.mark.filterwarnings('error')
def test_where_nothing_is_matched_the_camera_is_as_it_is_mounted():
    nothing = np.zeros((SMALL_CAMERA.height, SMALL_CAMERA.width), np.float32)
    expected = expectations(MOUNT, pitched(4.0))
    found = plane_of_frame(SMALL_CAMERA, 0, nothing, nothing, 1.0, expected).angles_height
    np.testing.assert_allclose(found, expected[0], atol=1e-6)


def disparity_of(camera: StereoCamera, true: Mount, first_row: int) -> np.ndarray:
    """Return the disparities (R, W) of a floor below `true` from a row on, negative above it."""
    line = FloorLine.of(camera, true)
    rows = np.arange(first_row, camera.height)[:, None]
    columns = np.arange(0, camera.width, column_step(camera))
    derolled = rows + line.shear * (columns - camera.cx)
    return (line.slope * (derolled - line.horizon)).astype(np.float32)


def fit_to(
    camera: StereoCamera, disparity: np.ndarray, first_row: int = 0, is_fixed: bool = True, **grey
) -> PlaneFit:
    """Return the plane in disparities (R, W) of a camera said to be level in the map on MOUNT."""
    texture = np.full_like(disparity, grey.get('texture', 50.0))
    expected = expectations(MOUNT, np.eye(4))
    return plane_of_frame(camera, first_row, disparity, texture, 1.0, expected, is_fixed)


def plane_seen(camera: StereoCamera, true: Mount, first_row: int, is_fixed: bool = True):
    """Return pitch, roll and height that are found of a floor below a camera said to be on MOUNT,
    whose axes are `true`.
    """
    return fit_to(camera, disparity_of(camera, true, first_row), first_row, is_fixed).angles_height


@pytest.mark.parametrize('camera', [SMALL_CAMERA, CAMERA])
def test_rows_of_a_view_that_begins_below_the_top_are_those_of_the_image(camera):
    """The robot brakes: the floor is higher in the image than as the camera is mounted."""
    true = Mount(0.29, MOUNT.pitch_rad + np.radians(2.0), np.radians(1.5))
    found = plane_seen(camera, true, camera.height // 2)
    np.testing.assert_allclose(found, [true.pitch_rad, true.roll_rad, true.height_m], atol=0.004)


@pytest.mark.parametrize('swing_deg', [-2.0, -1.2, 1.2, 2.5])
def test_a_floor_that_a_bump_moves_by_many_pixels_is_found(swing_deg):
    """The longer the focal length the farther it moves."""
    true = replace(MOUNT, pitch_rad=MOUNT.pitch_rad + np.radians(swing_deg))
    found = plane_seen(LONG_CAMERA, true, 120)
    np.testing.assert_allclose(found, [true.pitch_rad, 0.0, true.height_m], atol=0.002)


def test_far_floor_that_a_dip_lifts_above_what_is_looked_at_is_unknown():
    dipped = replace(MOUNT, pitch_rad=MOUNT.pitch_rad + np.radians(2.5))
    left, right, floor, _ = Scene([floor_patch()], LONG_CAMERA, dipped).render()
    stage = FloorSegmentation(LONG_CAMERA, FloorSegmentationSettings())
    mask = stage.process(left, right, MOUNT).mask
    assert (mask[floor] == FLOOR).mean() > 0.6
    before, now = (round(FloorLine.of(LONG_CAMERA, mount).horizon) for mount in (MOUNT, dipped))
    assert before - now > 40
    assert (mask[: now - 2] == NOT_FLOOR).all()
    assert (mask[now + 2 : before - 20] == NO_EVIDENCE).all()


@pytest.mark.parametrize(
    ('pitch_deg', 'roll_deg', 'height'),
    [(4.0, 3.0, 1.0), (-4.0, -5.0, 1.0), (2.0, 6.0, 0.92), (-3.0, 0.0, 1.08)],
)
def test_pitch_roll_and_height_of_a_frame_are_found_together(pitch_deg, roll_deg, height):
    """Wheels sink into sand: nothing but the image says how the base stands."""
    pitch_rad = MOUNT.pitch_rad + np.radians(pitch_deg)
    true = Mount(MOUNT.height_m * height, pitch_rad, np.radians(roll_deg))
    found = plane_seen(SMALL_CAMERA, true, 0)
    np.testing.assert_allclose(
        found, [true.pitch_rad, true.roll_rad, true.height_m], atol=np.radians(0.3)
    )


@pytest.mark.parametrize('height', [0.5, 0.8, 1.25, 2.0])
def test_a_plane_is_not_the_floor_of_a_fixed_camera_that_cannot_be_at_its_height(height):
    """It looks at nothing but a table top, or over the edge of a stage."""
    other = replace(MOUNT, height_m=height * MOUNT.height_m)
    assert plane_seen(SMALL_CAMERA, other, 0)[2] == pytest.approx(MOUNT.height_m, rel=0.13)


def test_a_plane_is_the_floor_of_a_camera_in_a_hand_at_another_height():
    other = replace(MOUNT, height_m=1.25 * MOUNT.height_m)
    found = plane_seen(SMALL_CAMERA, other, 0, is_fixed=False)
    np.testing.assert_allclose(found, [other.pitch_rad, 0.0, other.height_m], atol=0.01)


def test_a_raised_plane_with_floor_below_it_is_not_the_floor():
    """A table top fills two thirds of what a camera in a hand sees; below it is the floor."""
    table = replace(MOUNT, height_m=0.8 * MOUNT.height_m)
    disparity = disparity_of(SMALL_CAMERA, MOUNT, 0)
    disparity[:, 107:] = disparity_of(SMALL_CAMERA, table, 0)[:, 107:]
    for is_fixed in (True, False):
        found = fit_to(SMALL_CAMERA, disparity, is_fixed=is_fixed).angles_height
        np.testing.assert_allclose(found, [MOUNT.pitch_rad, 0.0, MOUNT.height_m], atol=0.01)


def test_noise_proves_no_plane():
    rng = np.random.default_rng(2)
    shape = SMALL_CAMERA.height, SMALL_CAMERA.width
    for texture in (50.0, 0.5):
        noise = rng.uniform(1, 40, shape).astype(np.float32)
        for is_fixed in (True, False):
            fit = fit_to(SMALL_CAMERA, noise, is_fixed=is_fixed, texture=texture)
            assert not fit.evidence > PROVED


def seen_at(height_m: float, pitch_deg: float = 7.0, evidence: float = 50.0) -> PlaneFit:
    plane = np.array([np.radians(pitch_deg), 0.0, height_m])
    return PlaneFit(plane, np.full(3, 0.01), 0.5, 0.0, evidence)


def test_where_most_frames_show_another_plane_it_is_expected():
    fixture, mounted = Fixture(), np.array([np.radians(7.0), 0.0, 0.3])
    for height_m in (0.40, 0.41, 0.30):
        fixture.note(seen_at(height_m))
        assert len(fixture.usual(mounted)) == 0
    fixture.note(seen_at(0.9, evidence=0.1))
    assert len(fixture.usual(mounted)) == 0
    fixture.note(seen_at(0.40))
    np.testing.assert_allclose(fixture.usual(mounted), [[np.radians(7.0), 0.0, 0.40]])
    for _ in range(5):
        fixture.note(seen_at(0.31, 8.0))
    assert len(fixture.usual(mounted)) == 0


def carried(heights_m: list[float], *patches: Patch) -> FloorSegmentation:
    """Return what segments the images of a camera that is carried at these heights in turn, and is
    said to sit 0.30 m above the floor.
    """
    stage = FloorSegmentation(SMALL_CAMERA, FloorSegmentationSettings())
    for height_m in heights_m:
        held = replace(MOUNT, height_m=height_m)
        left, right, _, _ = Scene(list(patches), SMALL_CAMERA, held).render()
        stage.process(left, right, MOUNT, held.T_base_left @ np.linalg.inv(MOUNT.T_base_left))
    return stage


def test_the_floor_is_found_once_frames_show_that_the_mount_is_another():
    """A wrong mount was given: too low, and without its roll of 8 degrees. One frame alone may look
    down from the edge of a stage.
    """
    true = Mount(1.3 * MOUNT.height_m, MOUNT.pitch_rad, np.radians(8.0))
    left, right, floor, _ = Scene([floor_patch(), wall()], SMALL_CAMERA, true).render()
    stage = FloorSegmentation(SMALL_CAMERA, FloorSegmentationSettings())
    masks = [stage.process(left, right, MOUNT, np.eye(4)).mask for _ in range(6)]
    found = [(mask[floor] == FLOOR).mean() for mask in masks]
    assert max(found[:4]) < 0.6
    assert min(found[4:]) > 0.9
    assert stage.fixture.problem is None


@pytest.mark.slow
def test_a_camera_in_a_hand_is_said_to_be_in_one():
    scene = floor_patch(), wall(), *box(1.6, 0.5, 0.4, 0.3)
    assert carried([0.30, 0.303, 0.30, 0.297, 0.30], *scene).fixture.problem is None
    assert carried([*6 * [0.30], 0.40], *scene).fixture.problem is None
    problem = carried([0.30, 0.33, 0.37, 0.40, 0.42], *scene).fixture.problem
    assert problem is not None
    varies_m = float(re.search(r'varies by (\d\.\d\d) m', problem)[1])
    assert varies_m == pytest.approx(0.12, abs=0.02)


def test_a_camera_in_a_hand_shows_floor_where_its_plane_is_seen():
    """It is turned to a wall, all that it sees: nothing says how high it is then."""
    scene = floor_patch(), wall(), *box(1.6, 0.5, 0.4, 0.3)
    stage = carried([0.30, 0.33, 0.37, 0.40, 0.42], *scene)
    for patches, sees_floor in ((scene, True), ((wall(0.4),), False)):
        held = replace(MOUNT, height_m=0.45)
        left, right, _, _ = Scene(list(patches), SMALL_CAMERA, held).render()
        pose = held.T_base_left @ np.linalg.inv(MOUNT.T_base_left)
        mask = stage.process(left, right, MOUNT, pose).mask
        assert (mask == FLOOR).any() == sees_floor
