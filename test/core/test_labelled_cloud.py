import dataclasses

import numpy as np
import pytest

from segfloor_ros.core.cloud import CloudLabelling, CloudLabellingSettings
from segfloor_ros.core.contracts import (
    NO_POINT,
    POINT_FLOOR,
    POINT_OBSTACLE,
    POINT_UNKNOWN,
    KeyframeFeatures,
    LabelledPoints,
    SparseCloud,
)
from segfloor_ros.core.geometry import make_transform

MASK = np.full((40, 60), 127, np.uint8)
MASK[20:] = 255
MASK[:10] = 0
HERE = np.eye(4)
ON_FLOOR, ON_OBSTACLE, NOWHERE = (30.0, 30.0), (30.0, 4.0), (30.0, 15.0)


def cloud(points: dict[int, tuple[float, float, float]]) -> SparseCloud:
    ids = sorted(points)
    xyz = np.array([points[i] for i in ids], np.float32).reshape(-1, 3)
    return SparseCloud(np.array(ids, np.int32), xyz)


def features(pixels: dict[int, tuple[float, float]]) -> KeyframeFeatures:
    uv = np.array(list(pixels.values()), np.float32).reshape(-1, 2)
    unused = np.full((len(pixels), 3), np.nan, np.float32)
    return KeyframeFeatures(uv, np.array(list(pixels), np.int32), unused)


def label_of(points: LabelledPoints) -> dict[int, int]:
    return dict(zip(points.point_id.tolist(), points.label.tolist(), strict=True))


def test_mask_and_height_give_the_label() -> None:
    labelling = CloudLabelling(CloudLabellingSettings())
    points = {1: (1.0, 0.0, 0.0), 5: (2.0, 0.0, 0.4), 9: (1.0, 1.0, 0.02)}
    seen = features({1: ON_FLOOR, 5: ON_OBSTACLE, NO_POINT: ON_FLOOR})
    labelled = labelling.update(cloud(points), seen, MASK, HERE)
    assert label_of(labelled) == {1: POINT_FLOOR, 5: POINT_OBSTACLE, 9: POINT_UNKNOWN}
    assert labelled.confidence[0] > 0.5
    assert labelled.confidence[1] > 0.5
    assert labelled.confidence[2] == 0
    assert labelled.label.dtype == np.uint8
    assert labelled.confidence.dtype == np.float32


AT_THE_STEP_M = CloudLabellingSettings().step_height_m
"""A height that speaks neither for floor nor for an obstacle."""


def test_every_look_counts_and_one_wrong_mask_changes_nothing() -> None:
    labelling = CloudLabelling(CloudLabellingSettings())
    points = cloud({1: (1.0, 0.0, AT_THE_STEP_M)})
    # One look, 0.6, is less than the 0.8 a label takes; two are enough.
    assert label_of(labelling.update(points, features({1: ON_FLOOR}), MASK, HERE)) == {
        1: POINT_UNKNOWN
    }
    labelled = labelling.update(points, features({1: ON_FLOOR}), MASK, HERE)
    assert label_of(labelled) == {1: POINT_FLOOR}
    assert labelled.confidence[0] == pytest.approx(np.tanh(0.6))
    # Contradicted, it keeps its label until the evidence for the other exceeds 0.8: 1.2 - 4 * 0.6.
    for expected in (POINT_FLOOR, POINT_FLOOR, POINT_FLOOR, POINT_OBSTACLE):
        labelled = labelling.update(points, features({1: ON_OBSTACLE}), MASK, HERE)
        assert label_of(labelled) == {1: expected}


def test_evidence_of_the_mask_is_bounded() -> None:
    labelling = CloudLabelling(CloudLabellingSettings())
    points = cloud({1: (1.0, 0.0, AT_THE_STEP_M)})
    for _ in range(50):
        labelling.update(points, features({1: ON_FLOOR}), MASK, HERE)
    # From the bound, 3, seven looks of 0.6 lead beyond the 0.8 that a label takes.
    for expected in [POINT_FLOOR] * 6 + [POINT_OBSTACLE]:
        labelled = labelling.update(points, features({1: ON_OBSTACLE}), MASK, HERE)
        assert label_of(labelled) == {1: expected}


def test_borders_of_the_mask_say_nothing() -> None:
    labelling = CloudLabelling(CloudLabellingSettings())
    mask = np.full((40, 60), 0, np.uint8)
    mask[20:] = 255
    points = cloud({1: (1.0, 0.0, AT_THE_STEP_M), 2: (1.0, 0.2, AT_THE_STEP_M)})
    for _ in range(5):
        labelled = labelling.update(
            points, features({1: (30.0, 20.0), 2: (30.0, 21.0)}), mask, np.eye(4)
        )
    assert label_of(labelled) == {1: POINT_UNKNOWN, 2: POINT_FLOOR}


def test_points_above_the_robot_and_far_below_the_floor_are_neither() -> None:
    labelling = CloudLabelling(CloudLabellingSettings(robot_height_m=0.8))
    points = cloud({1: (1.0, 0.0, 0.9), 2: (1.0, 0.0, 0.7), 3: (1.0, 0.0, -0.5)})
    seen = features({1: ON_OBSTACLE, 2: ON_OBSTACLE, 3: ON_FLOOR})
    assert label_of(labelling.update(points, seen, MASK, HERE)) == {
        1: POINT_UNKNOWN,
        2: POINT_OBSTACLE,
        3: POINT_UNKNOWN,
    }


def test_removed_points_disappear_moved_ones_move_ids_stay() -> None:
    labelling = CloudLabelling(CloudLabellingSettings())
    start = {2: (1.0, 0.0, 0.0), 4: (2.0, 0.0, 0.5), 7: (3.0, 0.0, 0.3)}
    seen = features({2: ON_FLOOR, 4: ON_OBSTACLE, 7: ON_OBSTACLE})
    labelling.update(cloud(start), seen, MASK, HERE)
    after = {1: (9.0, 0.0, 0.0), 4: (2.5, 0.1, 0.5), 7: (3.0, 0.0, 2.0)}
    labelled = labelling.update(cloud(after), features({}), MASK, HERE)
    # 7 was corrected to above the robot; 1 was never looked at; 2 is gone.
    assert label_of(labelled) == {1: POINT_UNKNOWN, 4: POINT_OBSTACLE, 7: POINT_UNKNOWN}
    np.testing.assert_allclose(labelled.xyz_map[1], [2.5, 0.1, 0.5])


def test_what_is_known_of_a_cloud_waits_until_its_points_are_there_again() -> None:
    """Another map took its place, and was merged with it."""
    labelling = CloudLabelling(CloudLabellingSettings())
    first = {2: (1.0, 0.0, 0.0), 4: (2.0, 0.0, 0.5)}
    second = {10: (5.0, 0.0, 0.5), 11: (6.0, 0.0, 0.5), 12: (5.0, 1.0, 0.0)}
    seen = features({2: ON_FLOOR, 4: ON_OBSTACLE})
    labelling.update(cloud(first), seen, MASK, HERE)
    seen = features({10: ON_OBSTACLE, 11: ON_OBSTACLE, 12: ON_FLOOR})
    labelled = labelling.update(cloud(second), seen, MASK, HERE)
    of_second = {10: POINT_OBSTACLE, 11: POINT_OBSTACLE, 12: POINT_FLOOR}
    assert label_of(labelled) == of_second
    both = labelling.update(cloud(first | second), features({}), MASK, HERE)
    assert label_of(both) == {2: POINT_FLOOR, 4: POINT_OBSTACLE} | of_second


def test_heights_are_those_above_the_floor_below_the_base() -> None:
    labelling = CloudLabelling(CloudLabellingSettings())
    points = cloud({1: (1.0, 0.0, 2.0), 2: (1.0, 0.0, 2.3)})
    seen = features({1: NOWHERE, 2: NOWHERE})
    upstairs = make_transform(np.eye(3), np.array([0.0, 0.0, 2.0]))
    labelled = labelling.update(points, seen, MASK, upstairs)
    assert label_of(labelled) == {1: POINT_FLOOR, 2: POINT_OBSTACLE}


def test_on_a_ramp_heights_are_those_above_the_ramp() -> None:
    """A base that goes up by 10 degrees: floor runs on in its plane, not level."""
    labelling = CloudLabelling(CloudLabellingSettings())
    up = np.radians(10.0)
    R = np.array([[np.cos(up), 0, -np.sin(up)], [0, 1, 0], [np.sin(up), 0, np.cos(up)]])
    ramp = make_transform(R, np.array([3.0, 1.0, 0.5]))
    in_base = {1: (1.2, 0.3, 0.0), 2: (1.2, -0.3, 0.4), 3: (-1.2, 0.0, 0.0)}
    points = cloud({i: tuple(R @ xyz + ramp[:3, 3]) for i, xyz in in_base.items()})
    labelled = labelling.update(points, features(dict.fromkeys(in_base, NOWHERE)), MASK, ramp)
    assert label_of(labelled) == {1: POINT_FLOOR, 2: POINT_OBSTACLE, 3: POINT_FLOOR}


def test_heights_of_far_points_count_less() -> None:
    far, near = CloudLabelling(CloudLabellingSettings()), CloudLabelling(CloudLabellingSettings())
    seen = features({1: NOWHERE})
    close = near.update(cloud({1: (1.0, 0.0, 0.07)}), seen, MASK, HERE)
    distant = far.update(cloud({1: (9.0, 0.0, 0.07)}), seen, MASK, HERE)
    assert label_of(close) == {1: POINT_OBSTACLE}
    assert label_of(distant) == {1: POINT_UNKNOWN}


def test_the_nearest_look_says_how_exact_a_height_is() -> None:
    labelling, seen = CloudLabelling(CloudLabellingSettings()), features({1: NOWHERE})
    point, far_base = cloud({1: (1.0, 0.0, 0.07)}), np.eye(4)
    far_base[0, 3] = -8.0
    for base, expected in (
        (far_base, POINT_UNKNOWN),
        (HERE, POINT_OBSTACLE),
        (far_base, POINT_OBSTACLE),
    ):
        assert label_of(labelling.update(point, seen, MASK, base)) == {1: expected}
    assert labelling.to_arrays()['distance_m'] == [1.0]


def test_empty_cloud() -> None:
    labelled = CloudLabelling(CloudLabellingSettings()).update(
        cloud({}), features({}), MASK, np.eye(4)
    )
    assert labelled.label.shape == (0,)
    assert labelled.xyz_map.shape == (0, 3)


def test_labels_do_not_depend_on_which_points_were_judged_anew() -> None:
    """Points come, move and go; changed settings make one of the two judge every point."""
    rng = np.random.default_rng(3)
    settings = CloudLabellingSettings()
    sparing, thorough = CloudLabelling(settings), CloudLabelling(settings)
    xyz = {i: tuple(rng.uniform((1, -1, -0.1), (5, 1, 1.2))) for i in range(200)}
    unmoved = 0
    for step in range(12):
        for i in rng.choice(list(xyz), 5, replace=False):
            del xyz[i]
        for i in rng.choice(list(xyz), 20, replace=False):
            xyz[i] = (*xyz[i][:2], xyz[i][2] + rng.normal(scale=0.05))
        xyz |= {200 + 10 * step + i: (2.0, 0.0, rng.uniform(0, 1)) for i in range(10)}
        pixels = {int(i): tuple(rng.uniform(0, (59, 39))) for i in rng.choice(list(xyz), 60, False)}
        one = sparing.update(cloud(xyz), features(pixels), MASK, HERE)
        thorough.settings = dataclasses.replace(settings, robot_height_m=5.0 + 0.1 * step)
        thorough.update(cloud(xyz), features({}), MASK, HERE)
        thorough.settings = settings
        other = thorough.update(cloud(xyz), features(pixels), MASK, HERE)
        np.testing.assert_array_equal(one.label, other.label)
        np.testing.assert_array_equal(one.confidence, other.confidence)
        unmoved += len(xyz) - len(pixels)
    assert set(one.label.tolist()) == {POINT_UNKNOWN, POINT_FLOOR, POINT_OBSTACLE}
    assert unmoved > 1000


def test_changed_settings_judge_points_that_are_out_of_sight() -> None:
    labelling = CloudLabelling(CloudLabellingSettings())
    seen = features({1: ON_OBSTACLE})
    points = cloud({1: (1.0, 0.0, 0.5)})
    assert label_of(labelling.update(points, seen, MASK, HERE)) == {1: POINT_OBSTACLE}
    labelling.settings = dataclasses.replace(labelling.settings, robot_height_m=0.4)
    assert label_of(labelling.update(points, features({}), MASK, HERE)) == {1: POINT_UNKNOWN}


@pytest.mark.parametrize('at', [(0.0, 0.0), (-1.512, 1.26), (0.0249, -0.0249)])
def test_a_costmap_gets_obstacles_with_several_corners_and_no_lone_point(at) -> None:
    places = [(0, 0, 0.1), (0.02, 0, 0.4), (0, 0.02, 0.5), (0.5, 0, 0.2), (0.52, 0, 0.2)]
    points = {i: (x + at[0], y + at[1], z) for i, (x, y, z) in enumerate(places)}
    labelling, seen = CloudLabelling(CloudLabellingSettings()), dict.fromkeys(points, ON_OBSTACLE)
    labelled = labelling.update(cloud(points), features(seen), MASK, HERE)
    assert set(label_of(labelled).values()) == {POINT_OBSTACLE}
    assert labelling.standing(labelled).tolist() == [0, 1, 2]


def test_a_costmap_gets_what_the_newest_keyframe_has_seen_others_may_have_gone() -> None:
    old, new = ({i: (x, 0.01 * i, 0.3) for i in range(k, k + 3)} for x, k in ((1.0, 0), (3.0, 5)))
    labelling = CloudLabelling(CloudLabellingSettings())
    assert labelling.standing(labelling.labelled(cloud({}))).tolist() == []
    counts = []
    for seen in (old, *6 * [new]):
        shown = features(dict.fromkeys(seen, ON_OBSTACLE))
        labelled = labelling.update(cloud(old | new), shown, MASK, HERE)
        counts.append(len(labelling.standing(labelled)))
    assert counts == 7 * [3]
    again = CloudLabelling(CloudLabellingSettings())
    again.from_arrays(labelling.to_arrays())
    assert len(again.standing(again.labelled(cloud(old | new)))) == 6
    labelled = again.update(cloud(old | new), features({0: ON_OBSTACLE}), MASK, HERE)
    assert len(again.standing(labelled)) == 0, 'what the saved map has is no company'


def test_what_few_keyframes_before_have_seen_is_company() -> None:
    labelling = CloudLabelling(CloudLabellingSettings())
    post = cloud({i: (1.0, 0.01 * i, 0.3) for i in range(3)})
    counts = []
    for seen in (0, 1, 2, 2, 2, 2, 2):
        labelled = labelling.update(post, features({seen: ON_OBSTACLE}), MASK, HERE)
        counts.append(len(labelling.standing(labelled)))
    assert counts == [0, 0, 1, 1, 1, 0, 0]
