"""What a loop must stand before it is believed, on maps made by hand."""

from dataclasses import replace

import numpy as np
import pytest
from hand_made_maps import CAMERA, SCENES, add, keyframe, row_of_views, seen

from segfloor_ros.core.contracts import NO_POINT, Mount
from segfloor_ros.core.geometry import make_transform
from segfloor_ros.core.slam.places.evidence import PlaceEvidence
from segfloor_ros.core.slam.places.loops import PlaceMatcher, is_no_drift, likely_drift
from segfloor_ros.core.slam.places.place_recognition import PlaceRecognition
from segfloor_ros.core.slam.rig import Observations, Rig
from segfloor_ros.core.slam.sparse_map import Match, SparseMap
from segfloor_ros.core.twists import se3_exp

MOUNT = Mount(0.4, 0.15)
POINTS = SCENES['wall']
ROWS = np.arange(len(POINTS))
NONE = np.zeros(0, np.int32)


def matcher(sparse_map):
    return PlaceMatcher(sparse_map, sparse_map, PlaceRecognition(sparse_map))


def objection(centre, drift, own=ROWS, farther=0.0):
    """Return what speaks against a camera at `centre`, that the map has at centre + drift, seeing
    keyframe 0's points again. own: which of its own points each feature shows; farther: how much
    further away than these the place's points are.
    """
    sparse_map = SparseMap(Rig(CAMERA, MOUNT))
    add(sparse_map, seen(POINTS, 0, [NO_POINT] * len(POINTS)), ROWS, POINTS)
    centre, drift = np.array(centre), np.array(drift)
    now = keyframe(1, [NO_POINT] * len(POINTS))
    uvd = CAMERA.project(POINTS - centre)
    uvd[:, 2] = 15.0
    now = replace(now, observations=Observations(uvd, np.full(uvd.shape, 0.5)))
    now.T_camera_world = make_transform(np.eye(3), -(centre + drift))
    add(sparse_map, now, ROWS, POINTS[own] + drift)
    pose = make_transform(np.eye(3), -centre)
    match = Match(1, 0, pose, ROWS, ROWS.astype(np.int32), ROWS.astype(np.int32))
    sparse_map.xyz_world[ROWS] *= 1.0 - farther
    if is_no_drift(now, match):
        return 'no drift'
    travel = likely_drift(now, match, 5.0)
    return matcher(sparse_map).evidence(now, match, travel).objection


def test_a_place_seen_again_after_a_drift_is_sound():
    assert objection((0.1, 0.0, 0.0), (0.2, 0.0, 0.1)) == ''


def test_what_is_no_drift_is_no_loop():
    assert objection((0.1, 0.0, 0.0), (0.01, 0.0, 0.0)) == 'no drift'


def test_more_drift_than_the_way_can_have_is_another_place():
    assert objection((0.1, 0.0, 0.0), (0.6, 0.0, 0.1)) == 'more than drift'


def test_a_camera_that_hangs_above_the_place_is_not_there():
    # Optical axes: y points down.
    assert objection((0.1, -0.25, 0.0), (0.0, 0.25, 0.0)) == 'another floor'


def test_own_points_must_lie_where_the_place_shows_what_they_match():
    found = objection((0.1, 0.0, 0.0), (0.2, 0.0, 0.0), np.roll(ROWS, 5))
    assert found == 'not seen from the other side'


def test_free_space_does_not_run_through_what_stands_there():
    # Every pixel fits, but the place's points stand half way to what the keyframe sees.
    found = objection((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), farther=0.5)
    assert found == 'free space through obstacles'


@pytest.mark.parametrize(
    ('views', 'drifts_m', 'expected'),
    [
        ([21, 23, 25], [0.2, 0.2, 0.2], True),
        ([21, 25], [0.2, 0.2], False),  # two keyframes alone
        ([21, 23, 25], [0.5, 0.2, 0.2], False),  # they show different drifts
        ([24, 24, 25], [0.2, 0.2, 0.2], False),  # the camera has hardly moved
    ],
)
def test_three_keyframes_on_the_move_must_show_the_same_drift(views, drifts_m, expected):
    sparse_map = row_of_views(26, list(range(10)), 0.1)
    sightings = matcher(sparse_map).sightings
    for index, drift_m in zip(views, drifts_m, strict=True):
        drift = se3_exp(np.array([drift_m, 0.0, 0.0, 0.0, 0.0, 0.0]))
        pose = sparse_map.keyframes[index].T_camera_world @ drift
        view = PlaceEvidence(look=20.0)
        proof = sightings.add((Match(index, 0, pose, NONE, NONE, NONE), view))
    assert bool(proof) is expected
