"""How well points determine the pose, in images drawn for it."""

from dataclasses import replace

import numpy as np
import pytest
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.contracts import WheelPose
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.slam.rig import Observations
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.tracking.front_end import FrontEnd
from segfloor_ros.core.slam.tracking.images import smooth
from segfloor_ros.core.slam.tracking.patch_alignment import (
    MIN_SIGMA_DISPARITY,
    MIN_SIGMA_PIXEL,
    align_patches,
    sample_patches,
)
from segfloor_ros.core.slam.tracking.pose import (
    FIRST_INFORMATION,
    PoseEstimate,
    knows_more,
    refine_pose,
)

RNG = np.random.default_rng(3)
START = RNG.bit_generator.state


@pytest.fixture(autouse=True)
def the_same_noise_whatever_ran_before():
    RNG.bit_generator.state = START


V, U = np.mgrid[: CAMERA.height, : CAMERA.width]
MIDDLE = np.array([CAMERA.cx, CAMERA.cy])


def noisy(image):
    return np.clip(image + RNG.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8)


def sigmas_px(image, uv_px):
    """Return the standard deviations (N, 3) of pixels (N, 2) and disparities, by their patches."""
    grey, zoom = smooth(image), np.ones(len(uv_px))
    patches = sample_patches(grey, uv_px)
    by_pixel = align_patches(patches, grey, uv_px, zoom).sigma_px
    by_row = align_patches(patches, grey, uv_px, zoom, along_row=True).sigma_px
    sigma_px = np.column_stack([by_pixel, by_row[:, 0]])
    return np.maximum(sigma_px, [MIN_SIGMA_PIXEL, MIN_SIGMA_PIXEL, MIN_SIGMA_DISPARITY])


NOTHING = PoseEstimate(np.eye(4), np.zeros(0, bool), np.diag(1 / FIRST_INFORMATION), 1.0)


def fused(image, uv_px, prior=NOTHING, depth_m=2.0):
    """Return the pose by points in one plane, seen where they are from the origin, and a prior."""
    points = CAMERA.back_project(uv_px, np.full(len(uv_px), depth_m))
    disparity = np.full(len(uv_px), CAMERA.disparity_times_depth / depth_m)
    uvd_px = np.column_stack([uv_px, disparity])
    measured = Observations(uvd_px, sigmas_px(image, uv_px))
    return refine_pose(CAMERA, np.eye(4), points, measured, prior, is_noise_known=True)


def sigmas_m(image, uv_px):
    """Return the standard deviations of the place along x, y and z."""
    return np.sqrt(np.diag(fused(image, uv_px).covariance))[:3]


def anywhere(count):
    return RNG.uniform(12, [CAMERA.width - 12, CAMERA.height - 12], (count, 2))


@pytest.mark.parametrize('contrast', [12, 30, 80])
@pytest.mark.parametrize('slope', [0.0, -1.3])
def test_points_on_an_edge_determine_nothing_along_it(contrast, slope):
    image = noisy(np.where(U - MIDDLE[0] > slope * (V - MIDDLE[1]), 100 + contrast, 100.0))
    rows = np.arange(30, CAMERA.height - 30, 2)
    on_edge = np.stack([MIDDLE[0] + slope * (rows - MIDDLE[1]), rows], axis=1)
    covariance = fused(image, on_edge).covariance[:3, :3]
    along = np.array([slope, 1.0, 0.0]) / np.hypot(slope, 1.0)
    assert np.sqrt(along @ covariance @ along) > 0.045


def test_a_plain_face_determines_nothing():
    assert sigmas_m(noisy(np.full(U.shape, 90.0)), anywhere(200)).min() > 0.06


def test_corners_and_weak_textures_determine_the_place_to_millimetres():
    corners = noisy(100 + 40.0 * ((U // 40 + V // 40) % 2))
    columns, rows = (np.arange(40, n - 20, 40) - 0.5 for n in (CAMERA.width, CAMERA.height))
    at = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    assert sigmas_m(corners, at).max() < 0.003
    weak = noisy(100 + 6 * np.sin(U * 0.9) * np.sin(V * 1.1))
    assert sigmas_m(weak, anywhere(100)).max() < 0.003


def test_no_point_determines_nothing():
    assert sigmas_m(noisy(np.full(U.shape, 90.0)), np.zeros((0, 2))).min() == pytest.approx(1.0)


def test_what_edges_do_not_determine_the_prior_does():
    image = noisy(np.where(U - MIDDLE[0] > 0, 150.0, 100.0))
    rows = np.arange(30.0, CAMERA.height - 30, 12)
    on_edge = np.stack([np.full(len(rows), MIDDLE[0]), rows], axis=1)
    off = np.eye(4)
    off[:3, 3] = 0.01, 0.01, 0.0
    prior = PoseEstimate(off, np.zeros(0, bool), np.diag([0.005] * 3 + [1e-4] * 3) ** 2, 1.0)
    found = fused(image, on_edge, prior)
    across_m, along_m = found.T_camera_world[:2, 3]
    assert abs(across_m) < 0.001 and along_m == pytest.approx(0.01, abs=0.002)
    sigma_m = np.sqrt(np.diag(found.covariance))
    assert sigma_m[0] < 0.001 and sigma_m[1] > 0.004


def test_a_prior_is_outdone_where_points_know_every_direction_better():
    rows = np.arange(30.0, CAMERA.height - 30, 12)
    on_edge = np.stack([np.full(len(rows), MIDDLE[0]), rows], axis=1)
    edge = noisy(np.where(U - MIDDLE[0] > 0, 150.0, 100.0)), on_edge
    texture = noisy(RNG.uniform(60, 160, U.shape)), anywhere(300)
    wide = np.diag([0.02] * 6) ** 2
    sure_of_turns = np.diag([0.02] * 3 + [1e-5] * 3) ** 2
    assert knows_more(wide, fused(*edge))
    assert not knows_more(wide, fused(*texture))
    assert knows_more(sure_of_turns, fused(*texture))


def test_pixels_are_as_sure_with_wheels_as_without_where_the_images_know_more():
    room = StereoRoom()
    frames = [room.frame(k, planar_pose(0.04 * k, 0, 0)) for k in range(8)]

    def median_sigma_px(measured):
        slam = equipped_slam(CAMERA, StereoSlamSettings(num_features=800), MOUNT)
        for pose in measured:
            slam.add(pose)
        for frame in frames:
            slam.process(frame)
        assert len(slam.map.keyframes) > 1
        assert (slam.map.keyframes[-1].motion is not None) is bool(measured)
        return np.median(slam.map.keyframes[-1].observations.sigma_px[:, :2])

    period_ns = frames[1].stamp_ns // 2
    wheels = [WheelPose(k * period_ns, planar_pose(0.02 * k, 0, 0)) for k in range(20)]
    assert median_sigma_px(wheels) < 1.1 * median_sigma_px([])


def test_points_at_the_border_and_none_at_all_have_the_noise_of_what_is_there():
    image = noisy(np.full((40, 60), 90.0)).astype(np.float32)
    assert sigmas_px(image, np.zeros((0, 2))).shape == (0, 3)
    assert (sigmas_px(image, np.array([[0.0, 0.0], [59.4, 39.4]])) > 2.0).all()


def test_a_prior_leaves_the_noise_of_the_images_as_it_is(monkeypatch):
    weigh, weighed = FrontEnd._weighed, []

    def weigh_blurred(front_end, track):
        blurred = replace(track, estimate=replace(track.estimate, noise_factor=3.0))
        weighed.append(weigh(front_end, blurred))
        return weighed[-1]

    monkeypatch.setattr(FrontEnd, '_weighed', weigh_blurred)
    room, slam = StereoRoom(), equipped_slam(CAMERA, StereoSlamSettings(num_features=800), MOUNT)
    frames = [room.frame(k, planar_pose(0.04 * k, 0, 0)) for k in range(4)]
    for k in range(10):
        slam.add(WheelPose(k * frames[1].stamp_ns // 2, planar_pose(0.02 * k, 0, 0)))
    for frame in frames:
        slam.process(frame)
    fused = [track for track in weighed if track.prior is not None]
    assert fused and all(track.estimate.noise_factor == 3.0 for track in fused)
    assert all(track.estimate.covariance.trace() < 0.05**2 for track in fused)


def test_a_pixel_on_an_edge_is_sure_across_it_alone():
    image = noisy(np.where(U - MIDDLE[0] > 0, 150.0, 100.0))
    (sigma_px,) = sigmas_px(image, MIDDLE[None])
    assert sigma_px[0] < 0.3 and sigma_px[1] > 3.0


def test_a_pose_that_the_images_hardly_determine_is_said_to_be_uncertain(monkeypatch):
    room = StereoRoom()
    slam = equipped_slam(CAMERA, StereoSlamSettings(num_features=800), MOUNT)
    frames = [room.frame(k, planar_pose(0.04 * k, 0, 0)) for k in range(4)]
    seen = [result.state for frame in frames[:2] for result in slam.process(frame)]
    seen += [result.state for result in slam.process(frames[2])]
    follow = FrontEnd._followed

    def follow_blurred(front_end, *args):
        track = follow(front_end, *args)
        unsure = replace(track.estimate, covariance=np.eye(6) * 0.02**2)
        return replace(track, estimate=unsure)

    monkeypatch.setattr(FrontEnd, '_followed', follow_blurred)
    seen += [result.state for result in slam.process(frames[3])]
    assert seen[:3] == ['tracking'] * 3
    assert seen[3].startswith('tracking: what is seen leaves the place uncertain by 2')
