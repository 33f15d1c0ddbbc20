"""A map that is saved, loaded, localized in, and mapped on."""

from dataclasses import replace

import numpy as np
import pytest
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import UNKNOWN_COVARIANCE
from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.core.files.results import from_bytes, to_bytes
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.plugins.assembly import equipped_slam, make_slam
from segfloor_ros.core.plugins.maps.known_map import KnownMap, as_seen_by
from segfloor_ros.core.plugins.maps.map_arrays import fill_map, moved
from segfloor_ros.core.plugins.maps.saved_slam import base_of, load_slam, mount_of, save_slam
from segfloor_ros.core.slam.rig import DisparityOffset, OffsetEstimate, Rig
from segfloor_ros.core.slam.session import SessionState
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.sparse_map import SparseMap
from segfloor_ros.core.slam.stereo_slam import CAMERA_AS_BASE
from segfloor_ros.core.slam.tracking.frame_to_frame import FrameToFrame
from segfloor_ros.core.slam.tracking.map_tracking import Tracker
from segfloor_ros.core.twists import se3_exp

SETTINGS = StereoSlamSettings(num_features=600)
ROOM = StereoRoom()


def there(count, aside=0.0):
    return [planar_pose(0.04 * k, aside, 0.03 * k) for k in range(count)]


def drive(slam, poses):
    """Return the latest result of each frame, and the errors in metres of those tracked."""
    come = [slam.process(ROOM.frame(k, pose)) for k, pose in enumerate(poses)]
    results = list({r.index: r for batch in come for r in batch}.values())
    pairs = [(r, p) for r, p in zip(results, poses, strict=True) if r.tracked]
    return results, [
        np.linalg.norm((invert(pose) @ r.T_map_odom @ r.T_odom_base)[:3, 3]) for r, pose in pairs
    ]


@pytest.fixture(autouse=True)
def the_same_noise_whatever_ran_before():
    ROOM.reset_noise()


@pytest.fixture(scope='module')
def mapped():
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    drive(slam, there(25))
    return slam


def loaded(mapped, localize, **options):
    slam = equipped_slam(CAMERA, SETTINGS)
    load_slam(slam, CAMERA, save_slam(mapped, CAMERA), 'x', localize, **options)
    return slam


def test_a_loaded_map_is_the_one_that_was_saved(mapped):
    slam = loaded(mapped, localize=True)
    alive = np.flatnonzero(mapped.map.alive)
    order = alive[np.argsort(mapped.map.stable_id[alive])]
    np.testing.assert_array_equal(slam.map.stable_id, mapped.map.stable_id[order])
    np.testing.assert_array_equal(slam.map.xyz_world, mapped.map.xyz_world[order])
    np.testing.assert_array_equal(slam.map.observer_count, mapped.map.observer_count[order])
    np.testing.assert_array_equal(slam.map.patch, mapped.map.patch[order])
    assert slam.map.points.num_ever == mapped.map.points.num_ever
    for a, b in zip(slam.map.keyframes, mapped.map.keyframes, strict=True):
        np.testing.assert_allclose(a.T_camera_world, b.T_camera_world, atol=1e-12)
        assert a.links == b.links
        assert (a.retired is None) == (b.retired is None)
    stamps = [k.stamp_ns for k in slam.map.keyframes]
    assert stamps[-1] < 0
    assert np.diff(stamps).tolist() == np.diff([k.stamp_ns for k in mapped.map.keyframes]).tolist()


def test_a_map_of_poses_alone_keeps_the_mount_that_was_measured_and_their_axes():
    room = StereoRoom(seed=5)
    slam = make_slam(CAMERA, SETTINGS, CAMERA_AS_BASE)
    for i in range(12):
        slam.process(room.frame(i, planar_pose(0.06 * i, 0.0, 0.0)))
    assert slam.rig.mount is not None
    saved = from_bytes(to_bytes(save_slam(slam, CAMERA)), 'x')
    assert mount_of(saved) == slam.rig.mount
    assert base_of(saved) == CAMERA_AS_BASE


def test_the_disparity_offset_is_that_of_the_rig_that_made_the_map(mapped):
    before = mapped.rig.offset.estimate
    value_px, information = np.array([0.37, 0.2, -0.1]), 4e3 * np.eye(3) + 500.0
    mapped.rig.offset.estimate = OffsetEstimate(value_px, information)
    try:
        found = loaded(mapped, localize=True).rig.offset.estimate
    finally:
        mapped.rig.offset.estimate = before
    np.testing.assert_array_equal(found.value_px, value_px)
    np.testing.assert_array_equal(found.information, information)


def test_older_maps_know_of_the_offset_in_the_middle_alone():
    unknown, offset = DisparityOffset(CAMERA).estimate, DisparityOffset(CAMERA)
    offset.restored(np.array([0.37, 4200.0]))
    np.testing.assert_array_equal(offset.estimate.value_px, [0.37, 0.0, 0.0])
    expected = [4200.0, *np.diag(unknown.information)[1:]]
    np.testing.assert_array_equal(offset.estimate.information, np.diag(expected))
    with pytest.raises(ValueError, match='reshape'):
        offset.restored(np.zeros(5))


def test_saving_again_does_not_grow_the_file(mapped):
    saved = mapped.to_arrays()

    def size(arrays):
        return len(to_bytes(MapFile({}, {'slam': arrays})))

    again = loaded(mapped, localize=True).to_arrays()
    assert size(again) == pytest.approx(size(saved), rel=0.01)
    assert size(saved) < 60_000 * len(saved['keyframe_stamp_ns'])
    back = from_bytes(to_bytes(MapFile({}, {'slam': saved})), 'x').parts['slam']
    for name, array in saved.items():
        np.testing.assert_array_equal(back[name], array)


def test_localizing_finds_the_camera_and_adds_nothing(mapped):
    saved = mapped.to_arrays()
    slam = loaded(mapped, localize=True)
    results, errors = drive(slam, there(20, aside=0.05)[3:])
    assert sum(not r.tracked for r in results[:3]) < 3
    assert all(r.tracked for r in results[3:])
    assert all(r.keyframe is None for r in results)
    assert max(errors) < 0.02
    again = slam.to_arrays()
    for name in ('point_xyz_world', 'point_found_count', 'keyframe_T_camera_world'):
        np.testing.assert_array_equal(again[name], saved[name])


def test_frames_that_saw_the_place_before_that_was_certain_come_once_more(mapped):
    slam, poses = loaded(mapped, localize=True), there(8)
    come = [slam.process(ROOM.frame(k, pose)) for k, pose in enumerate(poses)]
    found = next(k for k, results in enumerate(come) if results[-1].tracked)
    assert not any(results[0].tracked for results in come[:found])
    assert [r.index for r in come[found]] == list(range(found + 1))
    assert all(len(results) == 1 for results in come[found + 1 :])
    for result in come[found]:
        assert result.tracked
        pose = result.T_map_odom @ result.T_odom_base
        assert np.linalg.norm((invert(poses[result.index]) @ pose)[:3, 3]) < 0.02
        assert result.covariance[0, 0] < 1e-3


def test_mapping_goes_on_in_the_same_frame_with_new_ids(mapped):
    saved = mapped.to_arrays()
    slam = loaded(mapped, localize=False)
    before = slam.map.points.num_ever, len(slam.map.keyframes)
    poses = there(25)[15:] + [planar_pose(1.0, 0.04 * k, 0.75 + 0.06 * k) for k in range(12)]
    results, errors = drive(slam, poses)
    assert all(r.tracked for r in results[3:])
    assert max(errors) < 0.03
    assert len(slam.map.keyframes) > before[1]
    new = [r.keyframe for r in results if r.keyframe][-1]
    assert new.cloud.point_id.max() >= before[0]
    assert set(saved['point_stable_id'][:50]) & set(new.cloud.point_id.tolist())


def test_a_map_that_many_loops_have_bent_is_said_to_be_bent(mapped, caplog):
    saved, slam = save_slam(mapped, CAMERA), equipped_slam(CAMERA, SETTINGS)
    bent = saved.parts['slam']['keyframe_T_camera_world'].copy()
    bent[:, :3, 0] *= 1.05
    load_slam(
        slam,
        CAMERA,
        MapFile(saved.header, {'slam': saved.parts['slam'] | {'keyframe_T_camera_world': bent}}),
        'x',
    )
    assert 'x: is bent by up to 5 %' in caplog.text
    turns = np.stack([k.T_camera_world[:3, :3] for k in slam.map.keyframes])
    np.testing.assert_allclose(
        turns @ turns.swapaxes(1, 2), np.tile(np.eye(3), (len(turns), 1, 1)), atol=1e-9
    )
    caplog.clear()
    loaded(mapped, localize=True)
    assert caplog.text == ''


def test_a_drive_in_a_loaded_map_maps_on_its_own_at_once_and_gives_that_up_when_it_is_found(mapped):
    slam = loaded(mapped, localize=False)
    before, poses = len(slam.map.keyframes), there(25)[10:18]
    come = [slam.process(ROOM.frame(0, poses[0]))]
    assert slam.session.state.holds_results and len(slam.map.keyframes) == 1
    come += [slam.process(ROOM.frame(k, pose)) for k, pose in enumerate(poses) if k]
    # Nothing is said before it is certain; then all frames come that saw the place.
    assert [len(batch) for batch in come] == [0, 0, 3, 1, 1, 1, 1, 1]
    for result, pose in zip((r for batch in come for r in batch), poses, strict=True):
        assert result.tracked and not result.in_submap and not result.outside
        off = invert(pose) @ result.T_map_odom @ result.T_odom_base
        assert np.linalg.norm(off[:3, 3]) < 0.02
    assert slam.session.state is SessionState.MAPPING
    # Nobody saw these views in two lights: the map is the one that was loaded, and what is new.
    assert before <= len(slam.map.keyframes) < before + len(poses)


@pytest.mark.slow
def test_what_a_drive_maps_beside_a_loaded_map_comes_once_it_was_looked_for_in_vain(mapped):
    slam, other = loaded(mapped, localize=False), StereoRoom(seed=77)
    poses = there(25)
    come = [slam.process(other.frame(k, pose)) for k, pose in enumerate(poses)]
    sizes = [len(batch) for batch in come]
    first = next(k for k, size in enumerate(sizes) if size)
    assert 10 <= first <= 20
    assert sizes[first:] == [first + 1, *[1] * (len(poses) - first - 1)]
    results = [r for batch in come for r in batch]
    assert [r.index for r in results] == list(range(len(poses)))
    assert all(r.tracked and r.outside and not r.in_submap for r in results)
    assert all('outside the loaded map' in r.state for r in results)
    assert sum(r.keyframe is not None for r in results) == len(slam.map.keyframes)


@pytest.mark.slow
def test_what_a_short_drive_maps_beside_a_loaded_map_comes_at_its_end(mapped):
    slam, other = loaded(mapped, localize=False), StereoRoom(seed=77)
    assert not [r for k in range(8) for r in slam.process(other.frame(5 + k, there(8)[k]))]
    rest = slam.finish()
    assert [r.tracked and r.outside for r in rest] == [True] * 8


def test_a_late_mask_of_a_submap_that_was_given_up_takes_nothing_from_the_map(mapped):
    slam, other, poses = loaded(mapped, localize=False), StereoRoom(seed=77), there(25)
    alive = slam.map.alive.sum()
    frame = other.frame(5, poses[0])
    slam.process(frame)
    slam.late_masks.add(frame.stamp_ns, np.full_like(frame.left, 255))
    slam.search_near(poses[10], 1.0, 0.5)
    slam.late_masks.take_points_back()
    assert slam.map.alive.sum() == alive


@pytest.mark.slow
def test_a_frame_that_is_lost_is_looked_for_once(mapped, monkeypatch):
    """Two sightings by one frame and one by another are no proof."""
    slam, other = loaded(mapped, localize=False), StereoRoom(seed=77)
    stamps, find = [], KnownMap.find
    monkeypatch.setattr(KnownMap, 'find', lambda known, *a: stamps.append(a[2]) or find(known, *a))
    here = there(25)[10]
    rooms = [other, other, other, ROOM, ROOM, ROOM]
    for k, room in enumerate(rooms):
        slam.process(room.frame(5 + k, here))
        assert (slam.session.state is SessionState.MAPPING) == (k == 5)
    assert len(stamps) == len(set(stamps)) == len(rooms)


@pytest.mark.slow
def test_after_a_pose_that_was_wrong_the_whole_map_is_searched_again(mapped, monkeypatch):
    monkeypatch.setattr('segfloor_ros.core.slam.places.place_recognition.SEARCHED_FRAMES', 20)
    slam, other, poses = loaded(mapped, localize=False), StereoRoom(seed=77), there(25)
    slam.process(other.frame(5, poses[0]))
    slam.search_near(planar_pose(30.0, 0.0, 0.0), 1.0, 0.5)
    results = [r for k in range(25) for r in slam.process(other.frame(6 + k, poses[0]))]
    assert slam.session.state.holds_results
    assert not any(r.tracked for r in results)
    come = [slam.process(ROOM.frame(31 + k, pose)) for k, pose in enumerate(poses[10:18])]
    assert come[-1][-1].tracked and slam.session.state is SessionState.MAPPING


@pytest.mark.slow
def test_images_that_cannot_be_tracked_are_said_while_a_loaded_map_is_searched(mapped):
    slam, other, poses = loaded(mapped, localize=False), StereoRoom(seed=77), there(25)
    for k in range(3):
        assert slam.process(other.frame(5 + k, poses[k])) == []
    dark = [slam.process(replace(f, left=0 * f.left, right=0 * f.right)) for f in
            (other.frame(8 + k, poses[0]) for k in range(3))]  # fmt: skip
    results = [r for batch in dark for r in batch]
    assert len(results) == 6 and not any(r.tracked or r.in_submap for r in results)
    assert all('without contrast' in r.state for r in results[-3:])
    come = [slam.process(ROOM.frame(11 + k, pose)) for k, pose in enumerate(poses[10:18])]
    assert come[-1][-1].tracked and slam.session.state is SessionState.MAPPING


def test_another_room_is_not_this_one(mapped):
    slam = loaded(mapped, localize=True)
    other = StereoRoom(seed=77)
    for k in range(6):
        result = slam.process(other.frame(k, planar_pose(0.04 * k, 0, 0)))[0]
        assert not result.tracked
        assert result.covariance[0, 0] > 1e3


def test_frames_in_a_row_must_find_who_is_lost(mapped):
    slam = loaded(mapped, localize=True)
    here, other = there(25)[10], StereoRoom(seed=77)
    rooms = [ROOM, ROOM, other, other, ROOM, other, ROOM, ROOM, ROOM, ROOM]
    tracked = [slam.process(room.frame(k, here))[0].tracked for k, room in enumerate(rooms)]
    assert tracked == [False] * 8 + [True] * 2


def test_what_was_found_before_a_new_search_does_not_count_in_it(mapped):
    slam, here = loaded(mapped, localize=True), there(25)[10]
    tracked = []
    for k in range(7):
        if k == 2:
            slam.front_end.reset()
        tracked.append(slam.process(ROOM.frame(k, here))[0].tracked)
    assert tracked == [False] * 4 + [True] * 3


@pytest.mark.parametrize(('second', 'is_found'), [(1, False), (10, True)])
def test_finds_agree_as_far_as_the_camera_can_have_moved(mapped, second, is_found):
    """0.9 m in a tenth of a second is another place, in a second it is a drive."""
    slam = loaded(mapped, localize=True)
    for k, x in ((0, 0.05), (second, 0.95)):
        assert not slam.process(ROOM.frame(k, planar_pose(x, 0, 0)))[0].tracked
    # What one view says varies a little with OpenCV's version: it may take one more.
    here = [ROOM.frame(second + k, planar_pose(0.95, 0, 0)) for k in range(1, 2 + is_found)]
    assert [slam.process(frame)[0].tracked for frame in here][-1] == is_found


def test_one_frame_finds_a_camera_that_is_where_it_was_lost(mapped, monkeypatch):
    slam = loaded(mapped, localize=False, last=mapped.last_pose)
    here, other = there(25)[-1], StereoRoom(seed=77)
    assert slam.process(ROOM.frame(30, here))[0].tracked
    assert not slam.process(other.frame(31, here))[0].tracked
    # The whole map alone.
    monkeypatch.setattr(Tracker, 'best', lambda *_: None)
    monkeypatch.setattr(FrameToFrame, 'find', lambda *_: None)
    assert slam.process(ROOM.frame(32, here))[0].tracked


def test_who_is_lost_must_see_what_is_expected_all_over_the_image(mapped, monkeypatch):
    monkeypatch.setattr('segfloor_ros.core.slam.places.place_recognition.CHANCE_SHARE', 1.0)
    slam = loaded(mapped, localize=True)
    results = [slam.process(ROOM.frame(k, there(25)[10]))[0] for k in range(5)]
    assert not any(result.tracked for result in results)


def test_a_drive_goes_on_where_it_ended_with_its_stamps_and_its_odom(mapped):
    mapped.front_end.motion.T_world_odom = planar_pose(0.1, 0.2, 0.3)
    slam = loaded(mapped, localize=False, last=mapped.last_pose)
    stamps = [k.stamp_ns for k in slam.map.keyframes]
    assert stamps == [k.stamp_ns for k in mapped.map.keyframes]
    result = slam.process(ROOM.frame(30, there(25)[-1]))[0]
    assert result.tracked
    error = invert(there(25)[-1]) @ result.T_map_odom @ result.T_odom_base
    assert np.linalg.norm(error[:3, 3]) < 0.03
    np.testing.assert_allclose(
        slam.front_end.motion.T_world_odom, mapped.front_end.motion.T_world_odom, atol=1e-9
    )


def test_a_search_around_a_pose_finds_the_camera_there_alone(mapped):
    here, elsewhere = there(25)[20], planar_pose(30.0, 0.0, 0.0)
    slam = loaded(mapped, localize=True)
    slam.search_near(elsewhere, 1.0, 0.5)
    assert not any(slam.process(ROOM.frame(k, here))[0].tracked for k in range(3))
    # Far enough from the origin that axes of the camera would put it elsewhere.
    slam.search_near(here, 0.3, 0.3)
    assert slam.process(ROOM.frame(4, here))[0].tracked
    slam.search_near(elsewhere, 1.0, 0.5)
    assert not slam.process(ROOM.frame(5, here))[0].tracked


@pytest.mark.slow
def test_a_drive_that_starts_elsewhere_joins_the_map_once_it_recognises_it(mapped):
    slam = loaded(mapped, localize=False)
    # It looks at the wall behind, then turns to what is known.
    start = [planar_pose(0.0, 0.1 * min(k, 3), 2.6) for k in range(18)]
    turn = [planar_pose(0.02 * k, 0.3, 2.6 - 0.11 * k) for k in range(25)]
    on = [planar_pose(0.5 + 0.03 * k, 0.3 - 0.02 * k, -0.1 + 0.03 * k) for k in range(20)]
    results, _ = drive(slam, start + turn + on)
    apart = [r for r in results if 'outside the loaded map' in r.state]
    assert len(apart) > 10
    first = apart[0]
    np.testing.assert_allclose(first.T_map_odom @ first.T_odom_base, np.eye(4), atol=1e-6)
    # Until then nobody is to take the frame of its own for that of the map.
    assert all(r.outside == ('outside' in r.state) for r in results if r.tracked)
    assert min(np.diag(r.covariance_in_map).min() for r in apart) == UNKNOWN_COVARIANCE
    assert np.diag(results[-1].covariance_in_map).max() < 0.01
    last = [r.keyframe for r in results if r.keyframe][-1]
    before = [r.keyframe for r in apart if r.keyframe]
    assert len(before[0].path.stamp_ns) == 1
    assert len(last.path.stamp_ns) > len(mapped.map.keyframes) + 3
    assert results[-1].tracked and results[-1].state == 'tracking'
    error = invert((start + turn + on)[-1]) @ results[-1].T_map_odom @ results[-1].T_odom_base
    assert np.linalg.norm(error[:3, 3]) < 0.03
    # What was mapped apart has moved along, with its ids.
    own = before[-1].cloud.point_id
    assert own.min() >= mapped.map.points.num_ever
    assert np.isin(own, last.cloud.point_id).mean() > 0.5
    at = np.searchsorted(last.path.stamp_ns, before[0].stamp_ns)
    truth = start[[r.index for r in results].index(before[0].frame_index)]
    np.testing.assert_allclose(last.path.T_map_base[at], truth, atol=0.05)
    # odom goes on without a jump.
    odom = np.stack([r.T_odom_base for r in results if r.tracked])
    steps = np.linalg.norm(np.diff(odom[:, :3, 3], axis=0), axis=1)
    assert steps.max() < 0.15


def test_a_map_in_another_frame_looks_the_same_from_its_keyframes() -> None:
    rng = np.random.default_rng(8)
    views = se3_exp(rng.normal(size=(3, 6)))
    direction = rng.normal(size=(5, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    before = {
        'point_xyz_world': rng.normal(size=(5, 3)),
        'point_viewing_direction': direction,
        'keyframe_T_camera_world': views,
    }
    after = moved(before, se3_exp(np.array([1.0, -2.0, 0.5, 0.4, 1.2, -0.7])))
    for old, new in zip(views, after['keyframe_T_camera_world'], strict=True):
        for kind in ('point_xyz_world', 'point_viewing_direction'):
            shift = kind == 'point_xyz_world'
            there = before[kind] @ old[:3, :3].T + shift * old[:3, 3]
            here = after[kind] @ new[:3, :3].T + shift * new[:3, 3]
            np.testing.assert_allclose(here, there, atol=1e-9)


def test_loops_of_a_map_behind_another_join_its_own_keyframes(mapped):
    own = mapped.to_arrays()
    own |= {
        'loop_ends': np.array([[4, 1]], np.int32),
        'loop_T_i_j': planar_pose(0.1, 0.2, 0.3)[None],
        'loop_by_floor': np.array([True]),
    }
    count, ever = len(own['keyframe_stamp_ns']), own['num_ever']
    sparse_map = SparseMap(Rig(CAMERA))
    fill_map(sparse_map, own)
    later = {'point_stable_id': own['point_stable_id'] + ever[0], 'num_ever': 2 * ever}
    fill_map(sparse_map, own | later)
    ends = [(loop.i, loop.j, loop.by_floor) for loop in sparse_map.loops]
    assert ends == [(4, 1, True), (4 + count, 1 + count, True)]


def test_a_map_of_another_camera_is_as_this_one_would_have_measured_it():
    own = StereoCamera(640, 480, 400.0, 410.0, 310.0, 250.0, 0.12)
    camera = StereoCamera(320, 240, 210.0, 200.0, 165.0, 115.0, 0.07)
    point = np.array([[0.4, -0.3, 2.5]])

    def measured(by, middle_px, right_px, below_px):
        u, v, u_right = by.project(point)[0]
        right, below = 2 * (u - by.cx) / by.width, 2 * (v - by.cy) / by.width
        return [u, v, u - u_right + middle_px + right * right_px + below * below_px]

    arrays = {
        'feature_uvd_px': np.array([measured(own, 0.2, 0.3, -0.5)], np.float32),
        'feature_sigma_px': np.ones((1, 3), np.float16),
        'disparity_offset': np.r_[0.2, 0.3, -0.5, np.eye(3).ravel()],
    }
    offset = DisparityOffset(camera).restored(np.r_[-0.4, 0.1, 0.2, np.eye(3).ravel()])
    own_offset = DisparityOffset(own).restored(arrays['disparity_offset'])
    found = as_seen_by(offset, own_offset, arrays)['feature_uvd_px']
    np.testing.assert_allclose(found, [measured(camera, -0.4, 0.1, 0.2)], atol=1e-3)
