"""A drive that is broken off, as when its node is killed, and goes on some seconds later."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.contracts import WheelPose
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.plugins.maps.saved_slam import (
    last_pose_of,
    last_pose_values,
    load_slam,
    save_slam,
)
from segfloor_ros.core.plugins.maps.session import HARDLY_BEGUN
from segfloor_ros.core.slam.settings import StereoSlamSettings

SETTINGS = StereoSlamSettings(num_features=600)
ROOM, OTHER = StereoRoom(), StereoRoom(seed=77)
FRAMES, GAP = 25, 8
SIGMA_PER_S = 0.5
"""A third of 1.5 m/s: this robot is slower than a walk, and may be carried."""


def base_at(k):
    return planar_pose(0.04 * k, 0.0, 0.01 * k)


def wheels(count):
    """Return what wheels measure every 20 ms, in a frame of their own."""
    start = planar_pose(7.0, -3.0, 1.0)
    return [WheelPose(round(2e7 * k), start @ base_at(k / 5)) for k in range(5 * count + 2)]


@pytest.fixture(scope='module')
def frames():
    return [ROOM.frame(k, base_at(k)) for k in range(FRAMES + GAP + 10)]


def broken_off(frames, measured=()):
    """Return what goes on after the last of the frames."""
    slam, measured = equipped_slam(CAMERA, SETTINGS, MOUNT), list(measured)
    for frame in frames:
        while measured and measured[0].stamp_ns <= frame.stamp_ns + 20_000_000:
            slam.add(measured.pop(0))
        slam.process(frame)
    last = last_pose_of(json.loads(json.dumps(last_pose_values(slam.last_pose))))
    again = equipped_slam(CAMERA, SETTINGS)
    load_slam(again, CAMERA, save_slam(slam, CAMERA), 'kept map', last=last)
    return again, last


def sigma_m(result):
    return np.sqrt(np.diag(result.covariance)[:3].max())


def error_m(T, k):
    return np.linalg.norm((invert(base_at(k)) @ T)[:3, 3])


def test_a_robot_that_drove_on_is_found_with_the_first_frame(frames):
    slam, last = broken_off(frames[:FRAMES])
    (result,) = slam.process(frames[FRAMES + GAP])
    assert result.tracked
    assert not result.blind
    assert error_m(result.T_map_odom @ result.T_odom_base, FRAMES + GAP) < 0.03
    T_left_base = invert(MOUNT.T_base_left)
    np.testing.assert_allclose(
        result.T_map_odom, MOUNT.T_base_left @ last.T_world_odom @ T_left_base, atol=0.02
    )


@pytest.mark.slow
def test_a_place_that_is_not_seen_is_held_and_said_to_be_unsure(frames):
    slam, _ = broken_off(frames[:FRAMES])
    for k in range(FRAMES + GAP, FRAMES + GAP + 10):
        (result,) = slam.process(OTHER.frame(k, base_at(0)))
        assert result.tracked
        assert result.blind
        assert 'held where the drive was broken off' in result.state
        assert error_m(result.T_map_odom @ result.T_odom_base, FRAMES - 1) < 0.03
        assert sigma_m(result) == pytest.approx(SIGMA_PER_S * (k - FRAMES + 1) / 10, rel=0.1)
    held = result
    seen = frames[FRAMES + GAP - 2]
    for k in (0, 1):
        (result,) = slam.process(
            replace(seen, index=99 + k, stamp_ns=held.stamp_ns + (k + 1) * 10**8)
        )
    assert result.state == 'tracking'
    assert error_m(result.T_map_odom @ result.T_odom_base, FRAMES + GAP - 2) < 0.03
    # `odom` goes on from where the pose was held, but for the noise of a frame, which is a
    # hundredth of the correction; that is less than was said.
    np.testing.assert_allclose(result.T_odom_base, held.T_odom_base, atol=3e-3)
    jump_m = np.linalg.norm(result.T_map_odom[:3, 3] - held.T_map_odom[:3, 3])
    assert 0.1 < jump_m < 3 * sigma_m(held)


@pytest.mark.slow
def test_a_heading_that_is_unsure_makes_the_way_since_unsure_across_it(frames):
    """The robot was carried, and drives an arc of 1 m before the map is recognised."""
    slam, _ = broken_off(frames[:FRAMES])
    arc, pose = [planar_pose(1.0, 0.0, 2.4)] * 17, planar_pose(1.0, 0.0, 2.4)
    for _ in range(20):
        pose = pose @ planar_pose(0.05, 0.0, 0.06)
        arc.append(pose)
    for k, pose in enumerate(arc):
        slam.process(ROOM.frame(FRAMES + GAP + k, pose))
    assert slam.session.state.holds_results
    result = slam.session.provisional
    # From where the camera was held to where the base is now.
    held = base_at(FRAMES - 1) @ MOUNT.T_base_left
    way = (result.T_map_odom @ result.T_odom_base)[:3, 3] - held[:3, 3]
    assert np.linalg.norm(way[:2]) > 0.8
    covariance = result.covariance_in_map
    variance = np.diag(covariance)[3:].mean()
    expected = variance * ((1 + way @ way) * np.eye(3) - np.outer(way, way))
    np.testing.assert_allclose(covariance[:3, :3], expected, atol=0.1 * variance)


def test_wheels_tell_the_way_that_nobody_saw(frames):
    slam, _ = broken_off(frames[:FRAMES], wheels(FRAMES))
    for pose in wheels(FRAMES + GAP + 5):
        if pose.stamp_ns > frames[FRAMES + GAP - 2].stamp_ns:
            slam.add(pose)
    for k in (FRAMES + GAP, FRAMES + GAP + 1):
        (result,) = slam.process(OTHER.frame(k, base_at(0)))
        # On the second frame a keyframe is made, which was made where the wheels had the robot.
        assert k > FRAMES + GAP or result.state.startswith('on wheels')
        assert error_m(result.T_map_odom @ result.T_odom_base, k) < 0.05
        assert sigma_m(result) < 0.1


@pytest.mark.slow
def test_what_is_mapped_elsewhere_merges_when_the_map_is_recognised(frames):
    """The robot turned while nobody saw it; then it turns back to what is known."""
    slam, _ = broken_off(frames[:FRAMES])
    x, yaw = 0.04 * FRAMES, 0.01 * FRAMES
    away = [planar_pose(x, 0.06 * min(k, 4), yaw + 2.2) for k in range(26)]
    back = [planar_pose(x - 0.01 * k, 0.24, yaw + 2.2 - 0.1 * k) for k in range(23)]
    on = [planar_pose(x - 0.23, 0.24 - 0.03 * k, yaw - 0.1 + 0.03 * k) for k in range(20)]
    poses, known = away + back + on, slam.to_arrays()['keyframe_stamp_ns']
    published, results = [], []
    for k, pose in enumerate(poses):
        found = slam.process(ROOM.frame(FRAMES + GAP + k, pose))
        results.append(found)
        published.append(found[-1] if found else slam.session.provisional)
        assert np.isin(known, slam.to_arrays()['keyframe_stamp_ns']).all()
    assert sum(result == [] for result in results) > 20
    assert results[-1] != []
    # Every frame has a pose, and `odom` is continuous.
    steps = [invert(a.T_odom_base) @ b.T_odom_base for a, b in pairwise(published)]
    assert max(np.linalg.norm(step[:3, 3]) for step in steps) < 0.08
    merged = next(k for k, found in enumerate(results) if len(found) > 10)
    before, after = published[merged - 1], published[merged]
    jump_m = np.linalg.norm(
        (after.T_map_odom @ after.T_odom_base - before.T_map_odom @ before.T_odom_base)[:3, 3]
    )
    assert 0.1 < jump_m < 3 * sigma_m(before)
    last = published[-1]
    error = invert(poses[-1]) @ last.T_map_odom @ last.T_odom_base
    assert np.linalg.norm(error[:3, 3]) < 0.05
    assert len(slam.to_arrays()['keyframe_stamp_ns']) > len(known) + 3


@pytest.mark.slow
def test_the_farther_from_where_a_submap_began_the_less_is_known_of_the_place(frames):
    slam, _ = broken_off(frames[:FRAMES])
    mapped = []
    for k in range(36):
        pose = planar_pose(0.04 * FRAMES, -0.05 * k, 0.01 * FRAMES + 2.2)
        if not slam.process(ROOM.frame(FRAMES + GAP + k, pose)):
            mapped.append(slam.session.provisional)
    began, end = mapped[0], mapped[-1]
    way_m = np.linalg.norm((invert(began.T_odom_base) @ end.T_odom_base)[:3, 3])
    assert way_m > 0.7
    # As many radians are unsure as metres; the base is 0.4 m below the camera.
    expected = sigma_m(began) * np.sqrt(1 + way_m**2 / (1 + 0.4**2))
    assert sigma_m(end) == pytest.approx(expected, rel=0.1)


@pytest.mark.slow
def test_a_map_that_had_hardly_begun_stays(frames):
    slam, _ = broken_off(frames[:3])
    known = slam.to_arrays()['keyframe_stamp_ns']
    assert len(known) < HARDLY_BEGUN
    for k in range(10, 40):
        slam.process(OTHER.frame(k, base_at(k)))
    assert slam.session.state.holds_results
    np.testing.assert_array_equal(slam.to_arrays()['keyframe_stamp_ns'], known)


@pytest.mark.parametrize('name', ['stamp_ns', 'velocity', 'wheels'])
def test_a_note_that_does_not_tell_all_is_refused(frames, name):
    _, last = broken_off(frames[:5])
    values = last_pose_values(last)
    del values[name]
    with pytest.raises(InputError, match='broken off'):
        last_pose_of(values)
