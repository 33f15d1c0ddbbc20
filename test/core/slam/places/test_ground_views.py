"""The floor as seen from above: from the opposite side, and where it looks the same elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
import stereo_room
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.files.results import from_bytes, to_bytes
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.plugins.maps.known_map import KnownPlaces
from segfloor_ros.core.plugins.maps.saved_slam import load_slam, save_slam
from segfloor_ros.core.slam.places.loops import PlaceMatcher
from segfloor_ros.core.slam.places.views import GroundViews, motion_between
from segfloor_ros.core.slam.rig import Rig
from segfloor_ros.core.slam.session import SessionState
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.sparse_map import NOTHING, Match

HERE, OPPOSITE = planar_pose(0.0, 0.0, 0.1), planar_pose(1.9, 0.1, 3.0)
SAID = 2.0
"""Half of what a view can say for a place, in nats."""

RNG = np.random.default_rng(5)
SETTINGS = StereoSlamSettings(num_features=600)
TILE = np.kron(RNG.integers(60, 200, (8, 8)), np.ones((5, 5)))
"""0.4 m wide."""


def view(room, pose, mount=MOUNT):
    return GroundViews(Rig(CAMERA, mount)).take(room.view(pose @ MOUNT.T_base_left))


def test_the_same_floor_from_the_opposite_side_gives_the_motion_between():
    room = StereoRoom(1)
    T, log_ratio = motion_between(view(room, HERE), view(room, OPPOSITE), MOUNT.height_m)
    assert log_ratio > SAID
    off = invert(invert(HERE) @ OPPOSITE) @ T
    assert np.linalg.norm(off[:3, 3]) < 0.02
    assert abs(np.arctan2(off[1, 0], off[0, 0])) < 0.01


@pytest.mark.parametrize(
    'floor', [np.tile(TILE, (25, 25)), np.full((1000, 1000), 128)], ids=['tiles', 'plain']
)
def test_tiles_and_plain_floor_say_nothing(floor):
    room = StereoRoom(1, floor=floor)
    found = motion_between(view(room, HERE), view(room, OPPOSITE), MOUNT.height_m)
    assert found is None or found[1] < SAID


def test_different_floors_have_nothing_in_common():
    views = view(StereoRoom(1), HERE), view(StereoRoom(2), OPPOSITE)
    found = motion_between(*views, MOUNT.height_m)
    assert found is None or found[1] < SAID


def test_where_it_is_not_known_how_the_camera_is_mounted_there_is_no_floor():
    assert view(StereoRoom(1), HERE, mount=None) is NOTHING


THERE = [planar_pose(-1.5 + 0.09 * k, 0.0, 0.0) for k in range(34)]
TURN = [planar_pose(1.47, 0.0, np.pi * k / 26) for k in range(1, 27)]
BACK = [planar_pose(1.47 - 0.09 * k, 0.0, np.pi) for k in range(1, 34)]


@pytest.fixture(scope='module')
def driven_back():
    """There, a turn on the spot and back, with a focal length that is 1 % too long."""
    room = StereoRoom(0)
    room.reset_noise()
    camera = replace(CAMERA, fx=1.01 * CAMERA.fx, fy=1.01 * CAMERA.fy)
    slam, results = equipped_slam(camera, SETTINGS, MOUNT), []
    for k, pose in enumerate(THERE + TURN + BACK):
        results += slam.process(room.frame(k, pose))
    return slam, results


@pytest.mark.slow
def test_a_corridor_that_is_driven_back_is_known(driven_back):
    slam, results = driven_back
    assert len(slam.map.loops) >= 3
    assert all(loop.by_floor for loop in slam.map.loops)
    poses = THERE + TURN + BACK
    off = [
        invert(invert(poses[0]) @ poses[r.index]) @ r.T_map_odom @ r.T_odom_base for r in results
    ]
    # 0.057 m by points alone, which nothing ties together.
    assert np.linalg.norm(np.array(off)[:, :3, 3], axis=1).max() < 0.04


def test_a_saved_map_keeps_what_the_floor_ties_together(driven_back):
    slam, _ = driven_back
    again = equipped_slam(slam.rig.camera, StereoSlamSettings())
    load_slam(again, slam.rig.camera, save_slam(slam, slam.rig.camera), 'x')
    assert [loop.by_floor for loop in again.map.loops] == [True] * len(slam.map.loops)


IN_CORRIDOR = [planar_pose(-2.4 + 0.15 * k, 0.0, 0.0) for k in range(34)]
BEGIN = [planar_pose(3.5, 0.05, np.pi)] * 16
"""So long it is looked for in the map."""

TO_IT = BEGIN + [planar_pose(3.5 - 0.15 * k, 0.05, np.pi) for k in range(1, 18)]


FLOOR = StereoRoom(0).textures[4]
REPEATED = np.tile(FLOOR[:200, :200], (5, 5))
"""Every 2 m, as tiles of a carpet do."""


@pytest.fixture(scope='module')
def corridor():
    """A room that is 9 m long and 2 m wide."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stereo_room, 'ROOM_MIN', np.array([-3.0, -1.0, 0.0]))
        patch.setattr(stereo_room, 'ROOM_MAX', np.array([6.0, 1.0, 2.4]))
        yield


def driven_there(floor):
    slam, room = equipped_slam(CAMERA, SETTINGS, MOUNT), StereoRoom(0, floor=floor)
    for k, pose in enumerate(IN_CORRIDOR):
        slam.process(room.frame(k, pose))
    return slam, from_bytes(to_bytes(save_slam(slam, CAMERA)), 'there.map')


@pytest.fixture(scope='module')
def there(corridor):
    """The map of a corridor that is driven in one direction."""
    return driven_there(FLOOR)


@pytest.fixture(scope='module')
def there_on_tiles(corridor):
    return driven_there(REPEATED)


@pytest.mark.slow
def test_views_of_the_floor_are_saved(there):
    slam, saved = there
    other = equipped_slam(CAMERA, SETTINGS, MOUNT)
    load_slam(other, CAMERA, saved, 'there.map')
    for before, after in zip(slam.map.keyframes, other.map.keyframes, strict=True):
        np.testing.assert_array_equal(after.ground.descriptor, before.ground.descriptor)
        np.testing.assert_allclose(after.ground.xy_m, before.ground.xy_m, atol=0.001)
    assert sum(len(k.ground.xy_m) for k in other.map.keyframes) > 1000


@pytest.mark.slow
def test_maps_of_earlier_releases_have_no_views_of_the_floor(there):
    slam, corners = equipped_slam(CAMERA, SETTINGS, MOUNT), ('keyframe_corners', 'corner_')
    arrays = {n: a for n, a in there[1].parts['slam'].items() if not n.startswith(corners)}
    load_slam(slam, CAMERA, replace(there[1], parts={'slam': arrays}), 'x')
    assert all(k.ground is NOTHING for k in slam.map.keyframes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('seed', 'is_known'), [(0, True), (2, False)], ids=['there', 'same floor, other walls']
)
@pytest.mark.parametrize(
    ('name', 'floor'), [('there', FLOOR), ('there_on_tiles', REPEATED)], ids=['', 'repeated']
)
def test_a_session_that_starts_the_other_way_is_recognised_by_the_floor(
    request, name, floor, seed, is_known
):
    slam, results = equipped_slam(CAMERA, SETTINGS, MOUNT), []
    load_slam(slam, CAMERA, request.getfixturevalue(name)[1], 'there.map')
    room = StereoRoom(seed, floor=floor)
    for k, pose in enumerate(TO_IT):
        results += slam.process(room.frame(k, pose))
    assert (slam.session.state is SessionState.MAPPING) == is_known
    found = results[-1].T_map_odom @ results[-1].T_odom_base
    off_m = np.linalg.norm((invert(invert(IN_CORRIDOR[0]) @ TO_IT[-1]) @ found)[:3, 3])
    assert (off_m < 0.02) == is_known


@pytest.mark.slow
def test_a_keyframe_that_looks_like_another_place_than_its_floor_does_counts_for_neither(
    there, monkeypatch
):
    nothing = np.zeros(0, np.intp), np.zeros(0, np.int32), np.zeros(0, np.int32)

    def looks_like_the_start(matcher, keyframe, *_):
        if matcher._known is matcher._map:
            return None
        return Match(keyframe.index, 0, keyframe.T_camera_world, *nothing)

    monkeypatch.setattr(PlaceMatcher, 'look', looks_like_the_start)
    monkeypatch.setattr(KnownPlaces, 'around', lambda *_: 20.0)
    monkeypatch.setattr(PlaceMatcher, '_free', lambda *_: 0.0)
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    load_slam(slam, CAMERA, there[1], 'there.map')
    room = StereoRoom(0, floor=FLOOR)
    for k, pose in enumerate(TO_IT):
        slam.process(room.frame(k, pose))
    assert slam.session.state is SessionState.OUTSIDE
