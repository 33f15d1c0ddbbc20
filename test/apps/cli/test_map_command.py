"""Saved maps, merged and compared without driving."""

from dataclasses import replace

import numpy as np
import pytest
from command_line import segfloor
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.apps.cli.maps import (
    APPEARED_BGR,
    GONE_BGR,
    SavedMap,
    changes,
    draw_changes,
    merge,
    open_map,
)
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.errors import InputError, MapError
from segfloor_ros.core.files.results import from_bytes, to_bytes, write_map_file
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.grid.keyframe_evidence import evidence_from_arrays, evidence_to_arrays
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED
from segfloor_ros.core.plugins.assembly import make_pipeline
from segfloor_ros.core.plugins.maps.pruning import prune
from segfloor_ros.core.plugins.maps.saved_pipeline import load_pipeline, save_pipeline
from segfloor_ros.core.plugins.maps.saved_slam import loaded_map
from segfloor_ros.nodes.configuration import resolve

OTHER_CAMERA = StereoCamera(320, 240, 163.0, 162.0, 157.0, 120.5, 0.125)
"""Of a robot of the same build."""

THERE = [planar_pose(0.06 * k, 0.0, 0.01 * k) for k in range(24)]
BESIDE = [planar_pose(0.2 + 0.06 * k, 0.1, 0.05 - 0.004 * k) for k in range(24)]


def mapped(poses, seed=0, camera=CAMERA, noise=0, height_m=MOUNT.height_m):
    """Return the map of a drive through a room, as its file gives it back."""
    room = StereoRoom(seed)
    room.reset_noise(noise)
    mount = {'height_m': height_m, 'pitch_rad': MOUNT.pitch_rad, 'roll_rad': 0.0}
    given = [f'stereo_slam.camera_{name}={value}' for name, value in mount.items()]
    pipeline = make_pipeline(camera, resolve(assignments=given))
    for k, pose in enumerate(poses):
        pipeline.process(room.frame(k, pose, camera=camera))
    pipeline.finish_tracking()
    pipeline.finish()
    return SavedMap(f'{seed}.map', from_bytes(to_bytes(save_pipeline(pipeline)), 'x'))


@pytest.fixture(scope='module')
def first():
    return mapped(THERE)


@pytest.fixture(scope='module')
def second():
    return mapped(BESIDE, camera=OTHER_CAMERA, noise=1)


@pytest.fixture(scope='module')
def merged(first, second):
    return merge(first, second)


def paths(saved, count):
    """Return the poses of the first keyframes, and of the others, with their frames."""
    poses, frames = loaded_map(saved.file, 0).path.T_map_base, saved.slam['keyframe_frame_index']
    return (poses[:count], frames[:count]), (poses[count:], frames[count:])


@pytest.mark.slow
def test_a_map_that_is_merged_is_straightened_and_said_to_be_bent(first, tmp_path, caplog):
    bent = first.slam['keyframe_T_camera_world'].copy()
    bent[:, :3, 0] *= 1.05
    parts = first.file.parts | {'slam': first.slam | {'keyframe_T_camera_world': bent}}
    write_map_file(tmp_path / 'old.map', replace(first.file, parts=parts))
    turns = open_map(tmp_path / 'old.map').slam['keyframe_T_camera_world'][:, :3, :3]
    np.testing.assert_allclose(turns @ turns.swapaxes(1, 2), [np.eye(3)] * len(turns), atol=1e-9)
    assert 'old.map: is bent by up to 5 %' in caplog.text


def test_two_robots_maps_are_one_in_the_frame_of_the_first(first, second, merged):
    drives = paths(merged, len(first.slam['keyframe_stamp_ns']))
    for (poses, frames), truth in zip(drives, (THERE, BESIDE), strict=True):
        assert len(frames) >= 5
        true = np.array([invert(THERE[0]) @ truth[k] for k in frames.tolist()])
        assert np.linalg.norm((invert(true) @ poses)[:, :3, 3], axis=1).max() < 0.03
    points = [len(m.slam['point_stable_id']) for m in (first, second, merged)]
    assert points[2] < sum(points[:2])
    assert len(merged.slam['loop_ends']) >= 6


def test_labels_and_evidence_move_along(first, second, merged):
    parts = merged.file.parts
    np.testing.assert_array_equal(parts['cloud']['point_id'], parts['slam']['point_stable_id'])
    assert set(parts['grid']['stamp_ns']) <= set(parts['slam']['keyframe_stamp_ns'])
    assert np.all(np.diff(parts['slam']['keyframe_stamp_ns']) > 0)
    assert np.all(np.diff(parts['grid']['stamp_ns']) > 0)
    free = [(m.grid().cells == FREE).sum() for m in (first, second, merged)]
    assert max(free[:2]) < free[2] < sum(free[:2])


def heights_m(saved):
    """Return the heights above the floor by which the points of a map were judged, by id."""
    known, cloud = saved.file.parts['cloud'], loaded_map(saved.file, 0).cloud
    z_m = cloud.xyz_map[np.searchsorted(cloud.point_id, known['point_id']), 2]
    return dict(zip(known['point_id'].tolist(), z_m - known['floor_z_m'], strict=True))


def test_points_of_the_second_map_are_as_high_above_their_floor_as_before(first, second, merged):
    before, after = heights_m(second), heights_m(merged)
    count = int(first.slam['num_ever'][0])
    own = [i for i in before if i + count in after]
    assert len(own) > 200
    expected = np.array([before[i] for i in own])
    # A point that is in both maps lies where both saw it.
    gap_m = np.abs(np.array([after[i + count] for i in own]) - expected)
    assert np.median(gap_m) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize('finish', [lambda saved: saved, prune], ids=['merged', 'pruned'])
def test_a_robot_goes_on_with_a_merged_map(merged, finish):
    pipeline = make_pipeline(CAMERA, resolve(assignments=[]))
    load_pipeline(pipeline, from_bytes(to_bytes(finish(merged.file)), 'x'), 'x', localize=True)
    room, results = StereoRoom(0), []
    for k, pose in enumerate(BESIDE):
        results += pipeline.process(room.frame(k, pose))
    pipeline.close()
    tracked = [r for r in results if r.tracked]
    assert len(tracked) >= 20
    errors = [
        np.linalg.norm((invert(BESIDE[r.index]) @ r.T_map_odom @ r.T_odom_base)[:3, 3])
        for r in tracked
    ]
    assert np.median(errors) < 0.02


def test_each_drive_is_in_the_list_of_sessions(first, merged):
    assert len(first.facts()['sessions']) == 1
    sessions = merged.facts()['sessions']
    assert len(sessions) == 2
    assert sum(s['keyframes'] for s in sessions) == merged.facts()['keyframes']


def with_post(saved, xy_m):
    """Return a map in which every keyframe sees a post of four cells there as well."""
    grid, evidence = saved.file.parts['grid'], []
    cells = xy_m[:, None] + np.array([[0.0, 0.0, 0.05, 0.05], [0.0, 0.05, 0.0, 0.05]])
    for seen, (x, y, yaw) in zip(evidence_from_arrays(grid), grid['pose'], strict=True):
        c, s = np.cos(yaw), np.sin(yaw)
        post = np.array([[c, s], [-s, c]]) @ (cells - [[x], [y]])
        positions_m = np.concatenate([seen.positions_m, post.astype(np.float16)], axis=1)
        evidence.append(replace(seen, positions_m=positions_m))
    parts = saved.file.parts | {'grid': grid | evidence_to_arrays(evidence)}
    return SavedMap('later.map', replace(saved.file, parts=parts))


@pytest.mark.slow
def test_what_has_come_and_what_has_gone(first):
    xy_m = np.array([2.0, 0.2])
    later = with_post(first, xy_m)
    for pair, sign in (((first, later), 1), ((later, first), -1)):
        whole, change = changes(*pair)
        assert set(np.unique(change)) == {0, sign}
        at = (np.argwhere(change == sign)[:, ::-1] + 0.5) * whole.resolution_m
        assert np.abs(at + whole.origin_xy_m - xy_m).max() < 0.15
        picture = draw_changes(whole, change)
        zoom = len(picture) // len(change)
        shown = (picture[::zoom, ::zoom] == (APPEARED_BGR if sign > 0 else GONE_BGR)).all(axis=2)
        np.testing.assert_array_equal(shown[::-1], change == sign)  # y is up
        colours = picture.reshape(-1, 3)
        assert {APPEARED_BGR, GONE_BGR} & set(map(tuple, colours.tolist())) == {
            APPEARED_BGR if sign > 0 else GONE_BGR
        }


@pytest.mark.slow
def test_what_is_gone_goes_with_the_views_that_showed_it(first, second, tmp_path):
    xy_m = np.array([2.0, -1.2])  # where the second drive looks, but not from near
    whole = merge(with_post(first, xy_m), second)
    path = tmp_path / 'whole.map'
    write_map_file(path, whole.file)
    said = segfloor('map', 'prune', path)
    pruned = open_map(path)
    counts = [len(m.slam['keyframe_stamp_ns']) for m in (whole, pruned)]
    assert f'{counts[0]} keyframes before, {counts[1]} now' in said.stdout
    seen = [len(m.file.parts['grid']['stamp_ns']) for m in (whole, pruned)]
    assert seen[1] <= 0.7 * seen[0]
    at = xy_m[None] + 0.02
    for saved, stands in ((whole, True), (pruned, False)):
        grid = saved.grid()
        assert (grid.cells[tuple(grid.cells_of(at)[0])] == OCCUPIED) == stands
    free_m2 = [m.facts()['free_m2'] for m in (whole, pruned)]
    assert free_m2[1] > 0.9 * free_m2[0]


def test_stages_agree_on_what_is_left_of_a_pruned_map(merged):
    pruned = prune(merged.file)
    slam, parts = pruned.parts['slam'], pruned.parts
    np.testing.assert_array_equal(parts['cloud']['point_id'], slam['point_stable_id'])
    assert np.isin(parts['grid']['stamp_ns'], slam['keyframe_stamp_ns']).all()
    assert len(evidence_from_arrays(parts['grid'])) == len(parts['grid']['stamp_ns'])
    again = prune(pruned)
    for name, arrays in parts.items():
        for column, array in arrays.items():
            np.testing.assert_allclose(again.parts[name][column], array, atol=1e-9)
    # What stays lies where it was.
    row = np.searchsorted(merged.slam['point_stable_id'], slam['point_stable_id'])
    np.testing.assert_array_equal(slam['point_xyz_world'], merged.slam['point_xyz_world'][row])


@pytest.mark.slow
def test_what_stands_beside_what_stood_has_not_come(first):
    earlier = with_post(first, np.array([2.0, 0.2]))
    for apart_m, has_come in ((0.05, False), (0.3, True)):
        _, change = changes(earlier, with_post(earlier, np.array([2.0 + apart_m, 0.2])))
        assert (change == 1).any() == has_come


@pytest.mark.slow
def test_nothing_has_changed_where_nothing_did(first, second):
    _, change = changes(first, second)
    assert (change != 0).sum() <= 4


@pytest.mark.slow
def test_maps_of_different_places_stay_apart(first):
    with pytest.raises(MapError, match=r'77\.map: shows no place of 0\.map'):
        merge(first, mapped(THERE, seed=77))


def test_a_camera_that_is_mounted_otherwise_is_said(first, second):
    header = second.file.header | {'mount': second.file.header['mount'] | {'height_m': 0.9}}
    with pytest.raises(InputError, match=r'0\.90 m above the floor, not 0\.40 m'):
        merge(first, SavedMap('tall.map', replace(second.file, header=header)))


def damaged(file):
    """Yield a saved map without a part, and with drives that nobody can have driven."""
    yield replace(file, parts={'slam': file.parts['slam']})
    for sessions in (3, [{'first_ns': 0}], ['monday']):
        yield replace(file, header=file.header | {'sessions': sessions})


def test_a_file_whose_parts_do_not_fit_is_one_line(first, tmp_path):
    path = tmp_path / 'x.map'
    for file in damaged(first.file):
        path.write_bytes(to_bytes(file))
        with pytest.raises(InputError, match=r'x\.map: parts of the map do not fit'):
            open_map(path)


@pytest.mark.parametrize(
    ('column', 'damage'),
    [
        ('feature_octave', lambda octave: octave[:-1]),
        ('feature_uvd_px', lambda uvd: uvd[:, 0]),
        ('feature_point', lambda point: point - 1),
    ],
)
def test_a_damaged_map_is_not_merged(first, second, column, damage):
    slam = second.slam | {column: damage(second.slam[column])}
    parts = second.file.parts | {'slam': slam}
    with pytest.raises(InputError, match=r'or broken\.map: parts of the map do not fit'):
        merge(first, SavedMap('broken.map', replace(second.file, parts=parts)))


@pytest.mark.parametrize('sessions', [3, [{'first_ns': 0}]])
def test_a_drive_does_not_begin_in_a_map_that_it_could_not_save(first, sessions):
    file = replace(first.file, header=first.file.header | {'sessions': sessions})
    pipeline = make_pipeline(CAMERA, resolve(assignments=[]))
    try:
        with pytest.raises(InputError, match=r'x\.map: parts of the map do not fit'):
            load_pipeline(pipeline, file, 'x.map', localize=False)
    finally:
        pipeline.close()
