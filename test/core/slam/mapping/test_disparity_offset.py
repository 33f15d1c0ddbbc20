"""The disparity offset: its filter, its place in the adjustment, and whole drives."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from bundle_problems import CAMERA as VGA
from bundle_problems import disturbed, make_problem
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.camera.model import OFFSET_SIGMA_PX
from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.core.geometry import make_transform, transform_points
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.slam.mapping.bundle_adjustment import adjust
from segfloor_ros.core.slam.rig import DisparityOffset, OffsetEstimate
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.twists import se3_exp

FRAMES, TURNED_FRAMES = 40, 21
BENT = [
    pytest.param(0, 60.0, 0.25, id='textured'),
    pytest.param(5, 35.0, -0.25, id='weaker texture, bent the other way', marks=pytest.mark.slow),
]
"""Seed and contrast of a room, and the offset of the rig in it."""


def with_offset(problem, offset_px):
    observations = problem.observations
    spoiled = replace(observations, uvd_px=observations.uvd_px + np.array([0.0, 0.0, offset_px]))
    return replace(problem, observations=spoiled)


def freed(problem, offset_px):
    return replace(problem, observations=problem.observations.without_offset(offset_px))


def test_adjustments_find_the_offset():
    truth = with_offset(make_problem(num_free=4), 0.3)
    first = adjust(VGA, disturbed(truth), iterations=20).offset.value_px
    assert first == pytest.approx(0.3, abs=0.03)
    result = adjust(VGA, freed(disturbed(truth), first), iterations=20)
    assert first + result.offset.value_px == pytest.approx(0.3, abs=1e-3)
    np.testing.assert_allclose(result.T_camera_world, truth.T_camera_world, atol=1e-3)


@pytest.mark.parametrize('scale', [0.97, 1.05])
def test_an_earlier_scale_is_no_offset(scale):
    # As if the keyframes that do not move had been placed with another offset than there is.
    problem = make_problem(num_free=4)
    poses = problem.T_camera_world.copy()
    poses[:, :3, 3] *= scale
    scaled = replace(problem, T_camera_world=poses, points_world=problem.points_world * scale)
    disparity_px = np.nanmedian(problem.observations.uvd_px[:, 2])
    result = adjust(VGA, scaled, iterations=1)
    assert abs(result.offset.value_px) < 0.05 * abs(scale - 1) * disparity_px


def test_an_offset_that_is_certain_is_kept():
    offset = DisparityOffset(expected_sigma_px=0.0, share=1.0)
    offset.learn(OffsetEstimate(0.3, 1e9))
    assert offset.value_px == 0.0


def test_the_information_is_that_of_the_eliminated_system():
    # Compare with a dense normal matrix over pose, points, offset and scale by numeric Jacobians.
    problem = make_problem(num_keyframes=2, num_points=6, num_free=1, sigma=0.1)
    result = adjust(VGA, problem, iterations=1)

    def residual(parameters):
        pose = se3_exp(parameters[:6]) @ problem.T_camera_world[0]
        points = problem.points_world + parameters[6:24].reshape(-1, 3)
        predicted = []
        for T in (pose, problem.T_camera_world[1]):
            uvr = VGA.project(transform_points(T, points))
            disparity = (uvr[:, 0] - uvr[:, 2]) * (1 + parameters[25]) + parameters[24]
            predicted.append(np.stack([uvr[:, 0], uvr[:, 1], disparity], axis=1))
        return (np.concatenate(predicted) - problem.observations.uvd_px).ravel() / 0.1

    J = np.stack([(residual(s) - residual(-s)) / 2e-6 for s in 1e-6 * np.eye(26)], axis=1)
    at_start = residual(np.zeros(26))
    chi2 = (at_start.reshape(-1, 3) ** 2).sum(axis=1)
    weight = np.repeat(np.sqrt(np.minimum(1, 7.815 / chi2)), 3)
    H = J.T @ (J * weight[:, None])
    damped = H + 1e-4 * np.diag(np.r_[np.diag(H)[:24], 0.0, 0.0])
    inverse = np.linalg.inv(damped)
    assert result.offset.information == pytest.approx(1 / inverse[24, 24], rel=1e-3)
    step = -inverse @ J.T @ (weight * at_start)
    assert result.offset.value_px == pytest.approx(step[24], rel=1e-3)


def test_the_filter_weighs_what_it_is_given():
    offset = DisparityOffset(expected_sigma_px=0.1, share=1.0)
    # 100 /px² around 0 before; an adjustment that adds much more, around 0.2, counts as 0.03 px.
    offset.learn(OffsetEstimate(0.2, 1e9))
    weight = 1 / 0.03**2
    assert offset.value_px == pytest.approx(0.2 * weight / (100 + weight), rel=1e-3)
    before = offset.estimate
    offset.learn(OffsetEstimate(0.4, 0.0))
    assert offset.estimate == before


def test_the_filter_never_runs_away_nor_grows_sure():
    offset = DisparityOffset(expected_sigma_px=0.1, share=0.5)
    for _ in range(2000):
        offset.learn(OffsetEstimate(5.0, 1000.0))
    assert offset.value_px <= 0.5
    assert offset.estimate.information <= 1.0001 / 0.01**2


@cache
def frames(step_m, step_rad, offset_px, seed, contrast):
    """Return the frames of a drive whose right image is shifted so that disparities are off."""
    room = StereoRoom(seed, contrast)
    shifted = replace(CAMERA, cx=CAMERA.cx - offset_px)
    right = make_transform(np.eye(3), np.array([CAMERA.baseline_m, 0.0, 0.0]))
    seen = []
    for k in range(FRAMES if step_m else TURNED_FRAMES):
        T = planar_pose(step_m * k, 0.0, step_rad * k) @ MOUNT.T_base_left
        left_right = room.view(T), room.view(T @ right, shifted)
        seen.append(StereoFrame(k, k * 100_000_000, *left_right))
    return seen


def room_drive(offset_px=0.0, step_m=0.05, step_rad=0.0, seed=0, contrast=60.0, is_known=False):
    """Drive through the room, straight ahead unless other poses are given."""
    slam = equipped_slam(CAMERA, StereoSlamSettings(num_features=800), MOUNT)
    if is_known:
        slam.rig.offset = DisparityOffset(0.0, 1.0)
    seen = frames(step_m, step_rad, offset_px, seed, contrast)
    results = [slam.process(frame)[0] for frame in seen]
    return slam, results


def length(results):
    last = results[-1].T_map_odom @ results[-1].T_odom_base
    return float(np.linalg.norm(last[:3, 3]))


@pytest.mark.slow
@pytest.mark.parametrize(('seed', 'contrast', 'offset_px'), BENT)
def test_a_bent_rig_is_found_and_its_distances_put_right(seed, contrast, offset_px):
    room = {'seed': seed, 'contrast': contrast}
    slam, results = room_drive(offset_px, **room)
    switched_off, believed = room_drive(offset_px, is_known=True, **room)
    assert slam.rig.offset.value_px == pytest.approx(offset_px, abs=0.1)
    assert switched_off.rig.offset.value_px == 0.0
    assert abs(length(results) - 1.95) < 0.5 * abs(length(believed) - 1.95)


@pytest.mark.slow
def test_an_exact_rig_stays_exact():
    slam, results = room_drive()
    assert abs(slam.rig.offset.value_px) < 0.03  # known to 0.036
    assert length(results) == pytest.approx(1.95, abs=0.01)


@pytest.mark.slow
def test_a_turn_on_the_spot_shows_little_and_changes_little():
    offsets = []
    for step in np.radians([1.5, 2.0, 2.5]):
        slam, results = room_drive(step_m=0.0, step_rad=float(step))
        assert len(slam.map.keyframes) > 5
        assert all(result.tracked for result in results)
        offsets.append(abs(slam.rig.offset.value_px))
    # One drive alone may err by as much as the noise of its matches.
    assert np.median(offsets) < 0.5 * OFFSET_SIGMA_PX
