"""The disparity offset: its filter, its place in the adjustment, and whole drives."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from bundle_problems import CAMERA as VGA
from bundle_problems import disturbed, make_problem
from stereo_room import CAMERA, MOUNT, StereoRoom, depth_of_room, planar_pose

from segfloor_ros.core.camera.model import OFFSET_SIGMA_PX
from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.core.geometry import make_transform, transform_points
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.slam.mapping.bundle_adjustment import adjust
from segfloor_ros.core.slam.rig import MEMORY_SIGMA_PX, PAIR_SIGMA, DisparityOffset, OffsetEstimate
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.twists import se3_exp

FRAMES, TURNED_FRAMES, STEP_M = 60, 21, 0.05
WAY_M = (FRAMES - 1) * STEP_M
BENT = [
    pytest.param(0, 60.0, 0.25, id='textured'),
    pytest.param(5, 35.0, -0.25, id='weaker texture, bent the other way', marks=pytest.mark.slow),
]
"""Seed and contrast of a room, and the offset of the rig in it."""


def offset_of(*value_px):
    """Return an offset with this value: in the middle, at the right edge, as far below."""
    offset = DisparityOffset(VGA)
    offset.estimate = OffsetEstimate(np.array(value_px), np.eye(3))
    return offset


def freed(problem, value_px):
    observations = problem.observations.without_offset(offset_of(*value_px))
    return replace(problem, observations=observations, offset=DisparityOffset(VGA))


PAIRS = [(0.3, 0.0, 0.0), (0.0, 0.32, 0.0), (0.0, 0.0, -0.3), (-0.2, 0.25, 0.3)]
"""Offsets of disparities by an eye that looks aside, has another focal length, or is rolled."""


@pytest.mark.parametrize('value_px', PAIRS)
def test_adjustments_find_the_offset(value_px):
    truth = freed(make_problem(num_free=4), np.negative(value_px))
    first = adjust(VGA, freed(disturbed(truth), (0, 0, 0)), iterations=20).offset.value_px
    np.testing.assert_allclose(first, value_px, atol=0.03)
    result = adjust(VGA, freed(disturbed(truth), first), iterations=20)
    np.testing.assert_allclose(first + result.offset.value_px, value_px, atol=1e-3)
    np.testing.assert_allclose(result.T_camera_world, truth.T_camera_world, atol=1e-3)


@pytest.mark.parametrize('value_px', PAIRS)
def test_keyframes_that_were_placed_with_the_offset_do_not_confirm_it(value_px):
    # Keyframes and points are as an adjustment of them all has them that knows of no offset.
    true = freed(make_problem(num_free=4), np.negative(value_px))
    bent = adjust(VGA, true, iterations=30)
    placed = replace(true, T_camera_world=bent.T_camera_world, points_world=bent.points_world)
    for num_free in (1, 3):
        result = adjust(VGA, replace(placed, num_free=num_free), iterations=20)
        np.testing.assert_allclose(result.offset.value_px, value_px, atol=0.03)


@pytest.mark.parametrize('scale', [0.97, 1.05])
def test_an_earlier_scale_is_no_offset(scale):
    # As if the keyframes that do not move had been placed with another offset than there is.
    problem = make_problem(num_free=4)
    poses = problem.T_camera_world.copy()
    poses[:, :3, 3] *= scale
    scaled = replace(problem, T_camera_world=poses, points_world=problem.points_world * scale)
    disparity_px = np.nanmedian(problem.observations.uvd_px[:, 2])
    result = adjust(VGA, freed(scaled, (0, 0, 0)), iterations=1)
    assert abs(result.offset.value_px[0]) < 0.05 * abs(scale - 1) * disparity_px


def test_the_information_is_that_of_the_eliminated_system():
    # Compare with a dense normal matrix over pose, points and offset by numeric Jacobians.
    problem = make_problem(num_keyframes=2, num_points=12, num_free=1, sigma=0.1)
    result = adjust(VGA, freed(problem, (0, 0, 0)), iterations=0)
    uv = problem.observations.uvd_px[:, :2]
    parts = np.c_[np.ones(len(uv)), (uv - (VGA.cx, VGA.cy)) / (VGA.width / 2)]

    def residual(parameters):
        pose = se3_exp(parameters[:6]) @ problem.T_camera_world[0]
        points = problem.points_world + parameters[6:42].reshape(-1, 3)
        predicted = []
        for T in (pose, problem.T_camera_world[1]):
            uvr = VGA.project(transform_points(T, points))
            predicted.append(np.stack([uvr[:, 0], uvr[:, 1], uvr[:, 0] - uvr[:, 2]], axis=1))
        all_of_it = np.concatenate(predicted)
        all_of_it[:, 2] += parts @ parameters[42:]
        return (all_of_it - problem.observations.uvd_px).ravel() / 0.1

    J = np.stack([(residual(s) - residual(-s)) / 2e-6 for s in 1e-6 * np.eye(45)], axis=1)
    at_start = residual(np.zeros(45))
    chi2 = (at_start.reshape(-1, 3) ** 2).sum(axis=1)
    weight = np.repeat(np.sqrt(np.minimum(1, 7.815 / chi2)), 3)
    H = J.T @ (J * weight[:, None])
    inverse = np.linalg.inv(H)
    information = np.linalg.inv(inverse[42:, 42:])
    np.testing.assert_allclose(result.offset.information, information, rtol=1e-3)
    step = -inverse @ J.T @ (weight * at_start)
    np.testing.assert_allclose(result.offset.value_px, step[42:], rtol=1e-3)


def test_the_filter_weighs_what_it_is_given():
    offset = DisparityOffset(VGA, share=1.0)
    # Expected are 0.1 px, and 0.001 of half the width; what shows errs by three of its sigmas.
    offset.learn(OffsetEstimate(np.array([0.2, 0.3, -0.1]), np.diag([1e4, 2500.0, 0.0])))
    weight, known = np.array([0.03, 0.06]) ** -2, np.array([0.1, 0.32]) ** -2
    expected = np.array([0.2, 0.3]) * weight / (known + weight)
    np.testing.assert_allclose(offset.estimate.value_px, [*expected, 0.0], rtol=1e-3)
    before = offset.estimate
    offset.learn(OffsetEstimate(np.full(3, 0.4), np.zeros((3, 3))))
    np.testing.assert_allclose(offset.estimate.value_px, before.value_px)
    np.testing.assert_allclose(offset.estimate.information, before.information)


def test_what_no_rig_has_is_not_learnt():
    # A floor alone shows no offset that grows as its disparities do: that is another scale.
    offset = DisparityOffset(VGA, share=1.0)
    along = np.array([0.35, -0.03, 0.94])
    information = np.eye(3) * 1e-6 + np.outer(along, along)
    before = offset.estimate
    offset.learn(OffsetEstimate(70.0 * along, information))
    np.testing.assert_allclose(offset.estimate.value_px, before.value_px)
    np.testing.assert_allclose(offset.estimate.information, before.information)
    offset.learn(OffsetEstimate(0.1 * along, 1e3 * information))
    assert offset.estimate.value_px @ along > 0.05


def test_of_parts_that_are_known_together_the_filter_learns_no_more():
    # Only the sum of offset and slope shows: what is expected of either decides who has it.
    offset = DisparityOffset(VGA, share=1.0)
    along = np.array([1.0, 1.0, 0.0])
    offset.learn(OffsetEstimate(0.1 * along, 1e6 * np.outer(along, along)))
    middle, right, below = offset.estimate.value_px
    assert middle / right == pytest.approx((0.1 / 0.32) ** 2, rel=1e-3)
    assert 0.19 < middle + right < 0.2
    assert below == 0.0


def test_the_filter_never_runs_away_nor_grows_sure():
    offset = DisparityOffset(VGA, share=0.5)
    for _ in range(2000):
        offset.learn(OffsetEstimate(np.array([0.3, -0.3, 0.3]), 1000.0 * np.eye(3)))
    assert (np.abs(offset.estimate.value_px) <= [0.5, 1.6, 1.6]).all()
    assert np.linalg.eigvalsh(offset.estimate.information).max() <= 1.0001 / MEMORY_SIGMA_PX**2


@cache
def frames(step_m, step_rad, offset_px, seed, contrast, focal):
    """Return the frames of a drive whose right image is shifted, or larger by a share, so that
    disparities are off.
    """
    room = StereoRoom(seed, contrast)
    larger = CAMERA.fx * (1 + focal), CAMERA.fy * (1 + focal)
    shifted = replace(CAMERA, cx=CAMERA.cx - offset_px, fx=larger[0], fy=larger[1])
    right = make_transform(np.eye(3), np.array([CAMERA.baseline_m, 0.0, 0.0]))
    seen = []
    for k in range(FRAMES if step_m else TURNED_FRAMES):
        T = planar_pose(step_m * k, 0.0, step_rad * k) @ MOUNT.T_base_left
        left_right = room.view(T), room.view(T @ right, shifted)
        seen.append(StereoFrame(k, k * 100_000_000, *left_right))
    return seen


class BelievedOffset(DisparityOffset):
    """Takes disparities for exact."""

    def learn(self, left):
        pass


def room_drive(
    offset_px=0.0, step_m=STEP_M, step_rad=0.0, seed=0, contrast=60.0, focal=0.0, is_known=False
):
    """Drive through the room, straight ahead unless other poses are given."""
    slam = equipped_slam(CAMERA, StereoSlamSettings(num_features=800), MOUNT)
    if is_known:
        slam.rig.offset = BelievedOffset(CAMERA)
    seen = frames(step_m, step_rad, offset_px, seed, contrast, focal)
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
    assert slam.rig.offset.estimate.value_px[0] == pytest.approx(offset_px, abs=0.1)
    assert switched_off.rig.offset.estimate.value_px[0] == 0.0
    assert abs(length(results) - WAY_M) < 0.5 * abs(length(believed) - WAY_M)


@pytest.mark.slow
@pytest.mark.parametrize('focal', [0.002, -0.002])
def test_the_path_of_eyes_with_unlike_focal_lengths_hardly_turns(focal):
    slam, results = room_drive(focal=focal)
    believed = room_drive(focal=focal, is_known=True)[1]
    # A larger right image has larger u there: to the right disparities are smaller.
    assert slam.rig.offset.estimate.value_px[1] == pytest.approx(-focal * CAMERA.width / 2, abs=0.1)
    assert yaw(results) < 0.5 * yaw(believed)


@pytest.mark.slow
def test_keyframes_tell_how_well_the_offset_is_known_by_then():
    _, results = room_drive()
    told = [result.keyframe.offset_px2 for result in results if result.keyframe is not None]
    pair_px = PAIR_SIGMA * CAMERA.width / 2
    np.testing.assert_allclose(told[0], np.diag([OFFSET_SIGMA_PX, pair_px, pair_px]) ** 2)
    assert (np.diag(told[-1]) < 0.5 * np.diag(told[0])).all()


def yaw(results):
    last = results[-1].T_map_odom @ results[-1].T_odom_base
    return abs(float(np.arctan2(last[1, 0], last[0, 0])))


def measured_offset(slam):
    """Return by how much disparities of keyframes exceed those of the room, fitted (3,)."""
    parts, errors, sigmas = [], [], []
    for keyframe in slam.map.keyframes:
        place = planar_pose(STEP_M * (keyframe.stamp_ns // 100_000_000), 0.0, 0.0)
        inverse_m = (1000.0 / depth_of_room(place @ MOUNT.T_base_left)).astype(np.float32)
        seen = keyframe.observations.exact()
        seen = seen.take(seen.has_disparity)
        uvd_px = seen.uvd_px
        u, v = (uvd_px[:, k].astype(np.float32) for k in (0, 1))
        inverse_m = cv2.remap(inverse_m, u, v, cv2.INTER_LINEAR).ravel()
        seen_px = inverse_m * CAMERA.disparity_times_depth
        fits = np.abs(uvd_px[:, 2] - seen_px) < 1
        parts.append(slam.rig.offset.parts_of(uvd_px[fits]))
        errors.append((uvd_px[:, 2] - seen_px)[fits])
        sigmas.append(seen.sigma_px[fits, 2])
    sigma = np.concatenate(sigmas)
    A, b = np.concatenate(parts) / sigma[:, None], np.concatenate(errors) / sigma
    return np.linalg.lstsq(A, b, rcond=None)[0]


@pytest.mark.slow
@pytest.mark.parametrize('seed', [0, 3])
def test_an_exact_rig_stays_exact(seed):
    slam, results = room_drive(seed=seed)
    # The matcher itself is 0.01 px off in this room.
    off_px = slam.rig.offset.estimate.value_px - measured_offset(slam)
    assert abs(off_px[0]) < 0.03
    assert abs(off_px[1:]).max() < 0.06
    if seed == 0:
        assert length(results) == pytest.approx(WAY_M, abs=0.01)


@pytest.mark.slow
def test_a_turn_on_the_spot_shows_little_and_changes_little():
    offsets = []
    for step in np.radians([1.5, 2.0, 2.5]):
        slam, results = room_drive(step_m=0.0, step_rad=float(step))
        assert len(slam.map.keyframes) > 5
        assert all(result.tracked for result in results)
        offsets.append(abs(slam.rig.offset.estimate.value_px[0]))
    # One drive alone may err by as much as the noise of its matches.
    assert np.median(offsets) < 0.5 * OFFSET_SIGMA_PX
