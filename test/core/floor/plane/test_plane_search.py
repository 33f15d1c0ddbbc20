"""What an accelerometer adds to the search for the floor's plane."""

import math

import cv2
import numpy as np
import pytest

from segfloor_ros.core.camera.model import OFFSET_SIGMA_PX, StereoCamera
from segfloor_ros.core.contracts import Mount, Up
from segfloor_ros.core.floor.disparity.matching import BLOCK_PX, refined
from segfloor_ros.core.floor.plane.mount import MountViewer, PlaneSearch, level_prior
from segfloor_ros.core.floor.plane.plane import (
    LEVEL_SIGMA,
    PlaneFit,
    Samples,
    plane_of,
    refine,
    shares,
)
from segfloor_ros.core.twists import se3_exp

UNKNOWN, STILL = np.full(3, np.nan), np.zeros((0, 3))
NOTHING = Samples(np.zeros((0, 3)), *np.zeros((3, 0)), 1.0, 0.0)
DISPARITY_M = 40.0
CAMERA = StereoCamera(320, 240, 160.0, 160.0, 159.5, 119.5, 0.25)
VGA = StereoCamera(640, 480, 320.0, 320.0, 319.5, 239.5, 0.25)
TRUE = np.array([0.3, 0.0, 0.5])
"""Pitch, roll and height of the camera."""


def weighing_alike(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (N,) of samples, and how their disparities grow, which is not known."""
    return np.ones(count), np.full(count, np.nan)


def little_floor(seed: int) -> Samples:
    """Samples of a far, narrow piece of floor, with an error of disparity that they share."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-0.1, 0.1, 80), rng.uniform(0.06, 0.12, 80)
    rays = np.stack([u, v, np.ones(80)], axis=1)
    disparity = -DISPARITY_M * rays @ plane_of(TRUE)
    disparity += 0.4 + 3 * u + rng.normal(0, 0.2, 80)
    return Samples(rays, disparity, *weighing_alike(80), DISPARITY_M, 0.0)


def found(frames: list[Samples], up: Up | None) -> np.ndarray:
    """Return pitch, roll and height by all frames."""
    search = PlaneSearch(UNKNOWN)
    fits = [search.add(frame, level_prior(up, np.eye(4)), STILL, []) for frame in frames]
    assert fits[-1] is not None
    return fits[-1].angles_height


def test_a_floor_is_level_in_the_camera_as_it_is_in_a_world_that_leans() -> None:
    """The world has the axes of a camera that was pitched, turned and rolled."""
    mount = Mount(0.4, pitch_rad=0.35, roll_rad=-0.2)
    T_world_left = se3_exp(np.array([0.4, 0.1, -0.3, 0.7, -0.4, 0.3]))
    up_world = T_world_left[:3, :3] @ mount.up_in_camera
    mean, sigma = level_prior(Up(up_world, 0.01), T_world_left)
    np.testing.assert_allclose(mean[:2], [mount.pitch_rad, mount.roll_rad], atol=1e-9)
    assert 0.01 < sigma[0] == sigma[1] < LEVEL_SIGMA[0]


def test_with_little_floor_in_view_up_tells_pitch_and_roll() -> None:
    frames = [little_floor(seed) for seed in range(6)]
    up = Up(plane_of(np.array([*TRUE[:2], 1.0])), math.radians(0.5))
    error, error_alone = np.abs(found(frames, up) - TRUE), np.abs(found(frames, None) - TRUE)
    assert (error[:2] < 0.8 * error_alone[:2]).all()
    assert np.degrees(error[:2]).max() < 1.0


def test_a_floor_that_is_plain_to_see_counts_more_than_what_was_felt() -> None:
    rng = np.random.default_rng(1)
    u, v = rng.uniform(-0.8, 0.8, 3000), rng.uniform(0.0, 0.8, 3000)
    rays = np.stack([u, v, np.ones(3000)], axis=1)
    disparity = -DISPARITY_M * rays @ plane_of(TRUE) + rng.normal(0, 0.2, 3000)
    frame = Samples(rays, disparity, *weighing_alike(3000), DISPARITY_M, 0.0)
    # The robot starts on a ramp of 4 degrees.
    ramp = plane_of(np.array([TRUE[0] + math.radians(4.0), 0.0, 1.0]))
    angles = found([frame] * 4, Up(ramp, math.radians(0.5)))
    assert np.degrees(angles[:2]) == pytest.approx(np.degrees(TRUE[:2]), abs=0.2)


@pytest.mark.parametrize('rises_are_known', [True, False])
def test_what_stands_far_away_does_not_tilt_the_floor(rises_are_known: bool) -> None:
    """The feet of far things lie a little above the floor, and do not rise down the image."""
    rng = np.random.default_rng(2)
    u, v = rng.uniform(-0.8, 0.8, 900), rng.uniform(0.1, 0.5, 900)
    rays = np.stack([u, v, np.ones(900)], axis=1)
    down = 1.0 / 300
    level = np.array([0.0, 0.0, 0.5])
    slope = -DISPARITY_M * down * plane_of(level)[1]
    is_thing = v < 0.2
    disparity = -DISPARITY_M * rays @ plane_of(level) + rng.normal(0, 0.1, 900)
    disparity[is_thing] += 1.5
    rise = np.where(is_thing, 0.0, slope) if rises_are_known else np.full(len(rays), np.nan)
    weight = np.where(is_thing, 4.0, 1.0)
    frame = Samples(rays, disparity, weight, rise, DISPARITY_M, down)
    height_m = found([frame] * 4, None)[2]
    assert (abs(height_m - 0.5) < 0.01) == rises_are_known


def test_a_floor_runs_along_the_path_on_it() -> None:
    """The camera is pitched by 0.3: a level path leads up to the floor's plane that is steeper."""
    path = np.array([[0.0, -np.sin(0.3), np.cos(0.3)], [0.2, -np.sin(0.3), np.cos(0.3)]])
    start, unsure = TRUE + np.array([0.2, 0.1, 0.0]), np.array([0.5, 0.5, 0.1])
    fit = refine(NOTHING, start, UNKNOWN, path, start, unsure)
    climb = np.abs(plane_of(fit.angles_height) * TRUE[2] @ path.T)
    assert climb.max() < 0.1 * np.abs(plane_of(start) * TRUE[2] @ path.T).max()
    assert fit.angles_height[0] == pytest.approx(TRUE[0], abs=0.03)


def test_all_samples_near_a_plane_refine_it() -> None:
    rng = np.random.default_rng(5)
    search = PlaneSearch(UNKNOWN)
    for _ in range(12):
        u, v = rng.uniform(-0.8, 0.8, 3000), rng.uniform(0.0, 0.8, 3000)
        rays = np.stack([u, v, np.ones(3000)], axis=1)
        disparity = -DISPARITY_M * rays @ plane_of(TRUE) + rng.normal(0, 0.4, 3000)
        fit = search.add(
            Samples(rays, disparity, *weighing_alike(3000), DISPARITY_M, 0.0),
            level_prior(None, np.eye(4)),
            STILL,
            [],
        )
    assert fit is not None
    mean, sigma = level_prior(None, np.eye(4))
    every = Samples.joined(search.frames)
    by_all = refine(every, TRUE, UNKNOWN, STILL, mean, sigma / math.sqrt(len(search.frames)))
    assert np.abs(fit.angles_height - by_all.angles_height).max() < 1e-5


def test_how_a_plane_is_known() -> None:
    """An error that all disparities share is in it, and little is known by what does not rise."""
    rng = np.random.default_rng(4)
    u, v = rng.uniform(-0.6, 0.6, 3000), rng.uniform(0.1, 0.8, 3000)
    rays = np.stack([u, v, np.ones(3000)], axis=1)
    true_px = -DISPARITY_M * rays @ plane_of(TRUE)
    down = 1.0 / 300
    rise = np.full(3000, -DISPARITY_M * down * plane_of(TRUE)[1])
    unsure = np.array([0.5, 0.5, 1.0])

    def fit(disparity: np.ndarray, rise: np.ndarray) -> PlaneFit:
        frame = Samples(rays, disparity, np.ones(3000), rise, DISPARITY_M, down)
        return refine(Samples.joined([frame] * 20), TRUE, UNKNOWN, STILL, TRUE, unsure)

    exact, off = fit(true_px, rise), fit(true_px + OFFSET_SIGMA_PX, rise)
    np.testing.assert_allclose(exact.angles_height, TRUE, atol=1e-6)
    frame = Samples(rays, true_px, np.ones(3000), rise, DISPARITY_M, down)
    assert shares(frame, exact.angles_height) == (1.0, 0.0)
    moved = np.abs(off.angles_height - TRUE)[[0, 2]]
    assert (moved < 1.05 * exact.sigma[[0, 2]]).all()
    assert (moved > 0.5 * exact.sigma[[0, 2]]).all()
    assert (fit(true_px, 0 * rise).sigma > 1.2 * exact.sigma)[1]


def test_what_differs_between_parts_of_a_drive_is_not_known() -> None:
    """Each look alone shows a plane as well as all of them together; they show others."""
    rng = np.random.default_rng(5)
    u, v = rng.uniform(-0.8, 0.8, 3000), rng.uniform(0.1, 0.8, 3000)
    rays = np.stack([u, v, np.ones(3000)], axis=1)
    known = {}
    for spread in (0.0, 0.1):
        search = PlaneSearch(UNKNOWN)
        for height_m in 0.5 * (1 + spread * np.array([-1.0, 1.0, -0.6, 0.8])):
            disparity = -DISPARITY_M * rays @ plane_of(np.array([0.3, 0.0, height_m]))
            frame = Samples(rays, disparity, *weighing_alike(3000), DISPARITY_M, 0.0)
            search.add(frame, level_prior(None, np.eye(4)), STILL, [])
        known[spread] = search.is_known()
    assert known == {0.0: True, 0.1: False}


@pytest.mark.parametrize(
    ('share_below', 'share_above', 'is_known'),
    [(0.0, 0.0, True), (0.02, 0.0, True), (0.2, 0.0, False), (0.01, 0.8, True), (0.04, 0.8, False)],
)
def test_a_plane_below_which_much_is_seen_is_no_floor(
    share_below: float, share_above: float, is_known: bool
) -> None:
    """A floor hides what is below it: a mirror, or a table, lets one see through. Where little of
    the floor is seen, little below it is much.
    """
    rng = np.random.default_rng(1)
    u, v = rng.uniform(-0.8, 0.8, 3000), rng.uniform(0.1, 0.8, 3000)
    rays = np.stack([u, v, np.ones(3000)], axis=1)
    disparity = -DISPARITY_M * rays @ plane_of(TRUE) + rng.normal(0, 0.2, 3000)
    disparity[: int(share_below * 3000)] *= 0.5
    disparity[3000 - int(share_above * 3000) :] += rng.uniform(5, 40, int(share_above * 3000))
    search = PlaneSearch(UNKNOWN)
    for _ in range(4):
        fit = search.add(
            Samples(rays, disparity, *weighing_alike(3000), DISPARITY_M, 0.0),
            level_prior(None, np.eye(4)),
            STILL,
            [],
        )
    assert fit is not None
    assert fit.angles_height == pytest.approx(TRUE, abs=0.01)
    assert fit.violations == pytest.approx(share_below, abs=0.01)
    assert search.is_known() is is_known


@pytest.mark.parametrize(('spread', 'is_known'), [(1.0, True), (0.05, False)])
def test_wrong_matches_are_no_surface_that_is_seen_through_the_floor(
    spread: float, is_known: bool
) -> None:
    """A quarter of the samples lie below the plane: anywhere, as wrong matches do, or on a wall."""
    rng = np.random.default_rng(2)
    u, v = rng.uniform(-0.8, 0.8, 3000), rng.uniform(0.1, 0.8, 3000)
    rays = np.stack([u, v, np.ones(3000)], axis=1)
    disparity = -DISPARITY_M * rays @ plane_of(TRUE) + rng.normal(0, 0.2, 3000)
    disparity[:750] *= rng.uniform(0, 0.9, 750)
    wall_px = 0.3 * disparity.min()
    disparity[:750] = spread * disparity[:750] + (1 - spread) * wall_px
    search = PlaneSearch(UNKNOWN)
    for _ in range(4):
        frame = Samples(rays, disparity, *weighing_alike(3000), DISPARITY_M, 0.0)
        fit = search.add(frame, level_prior(None, np.eye(4)), STILL, [])
    assert fit is not None
    assert fit.angles_height == pytest.approx(TRUE, abs=0.01)
    assert np.mean(disparity < 0.9 * (-DISPARITY_M * rays @ plane_of(TRUE))) > 0.2
    assert search.is_known() is is_known


def rows_of(samples: Samples, camera: StereoCamera = CAMERA) -> np.ndarray:
    """Return the rows (N,) at which a level camera at the origin took samples."""
    return samples.rays[:, 1] * camera.fy + camera.cy


def test_a_disparity_belongs_where_the_texture_of_its_block_is() -> None:
    stripe = 150
    image = np.full((CAMERA.height, CAMERA.width), 100, np.uint8)
    image[stripe - 1 : stripe + 2] = np.random.default_rng(0).choice([0, 255], 80).repeat(4)
    disparity = np.full(image.shape, 12.0, np.float32)
    samples = MountViewer(CAMERA).surfaces(image, np.roll(image, -12, 1), disparity, 2.0)
    rows = rows_of(samples)[samples.weight > 0.1]
    assert len(rows) > 100
    # Blocks that reach it are centred farther away.
    assert np.abs(rows - stripe).max() < 3 < BLOCK_PX


@pytest.mark.parametrize('true_px', [12.0, 12.3, 12.6])
def test_disparities_are_refined_and_their_errors_known(true_px: float) -> None:
    """Matched to half a pixel, with noise in both images."""
    rng = np.random.default_rng(3)
    wide = cv2.GaussianBlur(rng.normal(0, 60, (240, 3600)), (0, 0), 24)
    columns = 10 * np.arange(320.0) + 100
    rows = np.arange(240)[:, None]
    clean = (wide[rows, np.rint(columns + 10 * by).astype(int)] for by in (0.0, true_px))
    left, right = (
        np.clip(120 + 16 * one + rng.normal(0, 2.0, one.shape), 0, 255).astype(np.uint8)
        for one in clean
    )
    disparity = np.full(left.shape, np.rint(2 * true_px + 0.6) / 2, np.float32)
    at = tuple(grid.ravel() for grid in np.mgrid[20:220:12, 40:300:12])
    _, _, found_px, sigma = refined(left, right, disparity, 2.0, at)
    error = (found_px - true_px)[sigma < 0.5]
    assert len(error) > 100
    assert abs(np.median(error)) < 0.05
    assert abs(disparity[0, 0] - true_px) > 0.15
    ratio = np.sqrt(np.median((error / sigma[sigma < 0.5]) ** 2)) / 0.6745
    assert 0.5 < ratio < 1.5


def test_samples_lie_on_even_and_odd_rows_alike() -> None:
    image = np.zeros((480, 640), np.uint8)
    disparity = np.full(image.shape, 12.0, np.float32)
    samples = MountViewer(VGA).surfaces(image, image, disparity, None)
    assert np.mean(np.rint(rows_of(samples, VGA)) % 2) == pytest.approx(0.5, abs=0.05)
