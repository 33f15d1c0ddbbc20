"""The plane of the floor in one frame: as the camera is mounted, or level in the map."""

import re
from dataclasses import replace

import numpy as np
import pytest
from floor_scenes import CAMERA, MOUNT, SMALL_CAMERA, Patch, Scene, box, floor_patch, wall

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, NOT_FLOOR, Mount
from segfloor_ros.core.floor.disparity.profile import FloorLine, column_step
from segfloor_ros.core.floor.plane.plane import expectations, likeliest, plane_of_frame, swung
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings

LONG_CAMERA = StereoCamera(1280, 480, 1000.0, 1000.0, 640.0, 200.0, 0.12)


def pitched(pitch_deg: float):
    """Return the pose (4, 4) of a base that looks down by so much."""
    angle, pose = np.radians(pitch_deg), np.eye(4)
    pose[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)
    return pose


@pytest.mark.parametrize(
    ('share', 'pitch_deg', 'expected'),
    [
        ((0.3, 0.1), 4.0, 0),
        ((0.01, 0.3), 4.0, 1),  # the robot brakes
        ((-0.1, 0.3), -4.0, 1),
        ((0.2, 0.3), 4.0, 0),
        ((-0.03, 0.02), 8.0, 0),  # wrong matches deny the floor, the path has tilted
        ((-0.1, -0.01), 8.0, 0),
        ((-0.1, 0.01), 1.0, 0),
    ],
)
def test_the_floor_is_where_the_map_has_it_only_if_that_is_what_is_seen(share, pitch_deg, expected):
    known = expectations(MOUNT, pitched(pitch_deg))
    assert np.degrees(known[1, 0] - known[0, 0]) == pytest.approx(pitch_deg)
    # What is seen speaks as well for the height in the map, which is that of the mount here.
    assert likeliest(np.array([*share, share[1]]), known) == expected


def test_a_camera_in_a_hand_is_as_high_as_the_map_has_it():
    pose = pitched(2.0)
    pose[2, 3] = 0.2
    height_m = (pose @ MOUNT.T_base_left)[2, 3]
    known = expectations(MOUNT, pose)
    np.testing.assert_allclose(known[:, 2], [MOUNT.height_m, MOUNT.height_m, height_m])
    assert likeliest(np.array([0.0, 0.05, 0.4]), known) == 2


@pytest.mark.filterwarnings('error')
def test_where_nothing_is_matched_the_camera_is_as_it_is_mounted():
    nothing = np.zeros((SMALL_CAMERA.height, SMALL_CAMERA.width), np.float32)
    expected = expectations(MOUNT, pitched(4.0))
    found = plane_of_frame(SMALL_CAMERA, 0, nothing, nothing, 1.0, expected).angles_height
    np.testing.assert_allclose(found, expected[0], atol=1e-6)


def plane_seen(camera: StereoCamera, true: Mount, first_row: int) -> np.ndarray:
    """Return pitch, roll and height that are found of a floor below a camera said to be on MOUNT,
    whose axes are `true`.
    """
    line = FloorLine.of(camera, true)
    rows = np.arange(first_row, camera.height)[:, None]
    columns = np.arange(0, camera.width, column_step(camera))
    derolled = rows + line.shear * (columns - camera.cx)
    disparity = (line.slope * (derolled - line.horizon)).astype(np.float32)
    texture = np.full_like(disparity, 50.0)
    expected = expectations(MOUNT, np.eye(4))
    return plane_of_frame(camera, first_row, disparity, texture, 1.0, expected).angles_height


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


@pytest.mark.parametrize('step_deg', [0.7, 2.0, 9.0])
def test_a_base_swings_as_far_as_robots_do_and_no_farther(step_deg):
    swings = swung(np.array([0.1, 0.0, 0.3]), np.radians(step_deg))[:, 0] - 0.1
    assert np.degrees(np.abs(swings)).max() == pytest.approx(3.0)
    assert np.degrees(np.abs(swings)).min() <= step_deg + 1e-9 or len(swings) == 2


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
