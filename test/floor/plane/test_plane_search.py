"""What an accelerometer adds to the search for the floor's plane."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from segfloor_ros.camera.model import StereoCamera, Up
from segfloor_ros.floor.disparity.matching import BLOCK_PX
from segfloor_ros.floor.plane.mount import MountViewer, PlaneSearch, level_prior
from segfloor_ros.floor.plane.plane import Samples, plane_of, refine
from segfloor_ros.geometry import se3_exp

UNKNOWN = np.full(3, np.nan)
DISPARITY_M = 40.0
CAMERA = StereoCamera(320, 240, 160.0, 160.0, 159.5, 119.5, 0.25)
VGA = StereoCamera(640, 480, 320.0, 320.0, 319.5, 239.5, 0.25)
TRUE = np.array([0.3, 0.0, 0.5])
"""Pitch, roll and height of the camera."""


def little_floor(seed: int) -> Samples:
    """Samples of a far, narrow piece of floor, with an error of disparity that they share."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-0.1, 0.1, 80), rng.uniform(0.06, 0.12, 80)
    rays = np.stack([u, v, np.ones(80)], axis=1)
    disparity = -DISPARITY_M * rays @ plane_of(TRUE)
    disparity += 0.4 + 3 * u + rng.normal(0, 0.2, 80)
    return Samples(rays, np.zeros(3), disparity, np.ones(80), DISPARITY_M)


def found(frames: list[Samples], up: Up | None) -> np.ndarray:
    """Return pitch, roll and height by all frames."""
    search = PlaneSearch(UNKNOWN)
    fits = [search.add(frame, level_prior(up), []) for frame in frames]
    assert fits[-1] is not None
    return fits[-1].angles_height


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
    frame = Samples(rays, np.zeros(3), disparity, np.ones(3000), DISPARITY_M)
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
    down = np.array([0.0, 1.0, 0.0]) / 300
    level = np.array([0.0, 0.0, 0.5])
    slope = -DISPARITY_M * float(down @ plane_of(level))
    is_thing = v < 0.2
    disparity = -DISPARITY_M * rays @ plane_of(level) + rng.normal(0, 0.1, 900)
    disparity[is_thing] += 1.5
    rise = np.where(is_thing, 0.0, slope) if rises_are_known else None
    weight = np.where(is_thing, 4.0, 1.0)
    frame = Samples(rays, np.zeros(3), disparity, weight, DISPARITY_M, rise, down)
    height_m = found([frame] * 4, None)[2]
    assert (abs(height_m - 0.5) < 0.01) == rises_are_known


def test_a_floor_runs_along_the_path_on_it() -> None:
    """The camera is pitched by 0.3: a level path leads up to the floor's plane that is steeper."""
    path = np.array([[0.0, -np.sin(0.3), np.cos(0.3)], [0.2, -np.sin(0.3), np.cos(0.3)]])
    start, unsure = TRUE + np.array([0.2, 0.1, 0.0]), np.array([0.5, 0.5, 0.1])
    fit = refine([], start, UNKNOWN, path, start, unsure)
    climb = np.abs(plane_of(fit.angles_height) * TRUE[2] @ path.T)
    assert climb.max() < 0.1 * np.abs(plane_of(start) * TRUE[2] @ path.T).max()
    assert fit.angles_height[0] == pytest.approx(TRUE[0], abs=0.03)


def test_a_plane_is_that_of_the_first_camera_also_where_others_are_elsewhere() -> None:
    """Each frame is seen from another place, and turned; no two of them agree by chance."""
    rng = np.random.default_rng(4)
    frames = []
    for position_m, turn in (((0.4, -0.05, 0.8), 0.15), ((-0.3, 0.1, 1.5), -0.2)):
        u, v = rng.uniform(-0.6, 0.6, 500), rng.uniform(0.1, 0.8, 500)
        axes = np.array(
            [[1, 0, 0], [0, np.cos(turn), np.sin(turn)], [0, -np.sin(turn), np.cos(turn)]]
        )
        rays = np.stack([u, v, np.ones(500)], axis=1) @ axes
        above = 1 + plane_of(TRUE) @ np.array(position_m)
        disparity = -DISPARITY_M * rays @ plane_of(TRUE) / above
        seen = disparity > 2
        down = axes[1] / 300
        rise = np.full(seen.sum(), -DISPARITY_M * float(plane_of(TRUE) @ down) / above)
        frames.append(
            Samples(
                rays[seen],
                np.array(position_m),
                disparity[seen],
                np.ones(seen.sum()),
                DISPARITY_M,
                rise,
                down,
            )
        )
    unsure = np.array([0.5, 0.5, 1.0])
    fit = refine(frames, TRUE + 0.02, UNKNOWN, np.zeros((0, 3)), TRUE + 0.02, unsure)
    np.testing.assert_allclose(fit.angles_height, TRUE, atol=0.003)
    assert fit.support == pytest.approx(1.0)
    # As much as they weigh says how well it is known: a tenth says as much if it rises otherwise.
    flat = [replace(frame, rise=np.zeros_like(frame.rise)) for frame in frames]
    other = refine(flat, TRUE, UNKNOWN, np.zeros((0, 3)), TRUE, unsure)
    assert (other.sigma > 2 * fit.sigma).all()


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
            Samples(rays, np.zeros(3), disparity, np.ones(3000), DISPARITY_M), level_prior(None), []
        )
    assert fit is not None
    assert fit.angles_height == pytest.approx(TRUE, abs=0.01)
    assert fit.violations == pytest.approx(share_below, abs=0.01)
    assert search.is_known() is is_known


def rows_of(samples: Samples, camera: StereoCamera = CAMERA) -> np.ndarray:
    """Return the rows (N,) at which a level camera at the origin took samples."""
    return samples.rays[:, 1] * camera.fy + camera.cy


def test_a_disparity_belongs_where_the_texture_of_its_block_is() -> None:
    stripe = 150
    image = np.full((CAMERA.height, CAMERA.width), 100, np.uint8)
    image[stripe - 1 : stripe + 2] = np.random.default_rng(0).choice([0, 255], 80).repeat(4)
    disparity = np.full(image.shape, 12.0, np.float32)
    samples = MountViewer(CAMERA).surfaces(image, disparity, 2.0, np.eye(4))
    rows = rows_of(samples)[samples.weight > 0.1]
    assert len(rows) > 100
    # Blocks that reach it are centred farther away.
    assert np.abs(rows - stripe).max() < 3 < BLOCK_PX


def test_samples_lie_on_even_and_odd_rows_alike() -> None:
    image = np.zeros((480, 640), np.uint8)
    disparity = np.full(image.shape, 12.0, np.float32)
    samples = MountViewer(VGA).surfaces(image, disparity, None, np.eye(4))
    assert np.mean(np.rint(rows_of(samples, VGA)) % 2) == pytest.approx(0.5, abs=0.05)


def test_disparities_of_a_floor_rise_also_for_a_camera_upside_down() -> None:
    """Of a floor by its plane in the world, which hangs upside down in it."""
    T_world_left = se3_exp(np.array([0.2, 0.1, -0.3, 0.0, 0.0, np.pi]))
    plane = plane_of(TRUE)
    uv_px = np.random.default_rng(1).uniform((60, 130), (260, 230), (50, 2))

    def disparity_of(uv_px: np.ndarray) -> np.ndarray:
        """Points of the plane are those X with plane @ X = -1."""
        rays = CAMERA.back_project(uv_px, np.ones(len(uv_px))) @ T_world_left[:3, :3].T
        return -CAMERA.disparity_times_depth * rays @ plane / (1 + plane @ T_world_left[:3, 3])

    half = np.array([0, 0.5])
    rise = disparity_of(uv_px + half) - disparity_of(uv_px - half)
    assert np.abs(rise).min() > 0.01
    floor, board = (
        Samples.of(CAMERA, uv_px, disparity_of(uv_px), np.ones(50), T_world_left, of)
        for of in (rise, np.zeros(50))
    )
    assert (floor.weight_on(plane) == 1).all()
    assert (board.weight_on(plane) < 0.5).all()
