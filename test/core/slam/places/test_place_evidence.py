"""What views say for a place, and when that is enough."""

import math

import pytest

from segfloor_ros.core.slam.places.evidence import (
    HOPELESS,
    OF_VIEW,
    PlaceEvidence,
    is_enough,
    of_counts,
    of_errors,
    unlike_others,
)

SURE = PlaceEvidence(look=1000.0)
IN_A_MAP_OF_100 = -math.log(100)
"""Any of a hundred keyframes may be the place."""


@pytest.mark.parametrize(
    ('views', 'new', 'travel', 'expected'),
    [
        (3, [1.0, 1.0, 1.0], 0.0, True),
        (2, [1.0, 1.0], 0.0, False),
        (4, [1.0, 0.2, 0.2, 0.2], 0.0, False),
        (3, [1.0, 1.0, 1.0], IN_A_MAP_OF_100, False),
        (4, [1.0, 1.0, 1.0, 1.0], IN_A_MAP_OF_100, True),
        (100, [1.0] * 100, HOPELESS - 0.1, False),
    ],
    ids=['three', 'two', 'hardly new', 'anywhere', 'four anywhere', 'where no drift leads'],
)
def test_views_are_enough_by_their_sum_and_where_the_robot_can_be(views, new, travel, expected):
    view = PlaceEvidence(look=1000.0, travel=travel)
    assert is_enough([view] * views, new) is expected


def test_what_a_view_shows_says_no_more_than_that_some_places_look_alike():
    assert unlike_others(1000.0) == pytest.approx(OF_VIEW, abs=0.01)
    assert unlike_others(-1000.0) == pytest.approx(-OF_VIEW, abs=0.01)
    assert SURE.seen == pytest.approx(OF_VIEW, abs=0.01)
    assert PlaceEvidence(look=9.0, free=-3.0).seen < PlaceEvidence(look=9.0, free=3.0).seen


@pytest.mark.parametrize(
    ('evidence', 'reason'),
    [
        (SURE, ''),
        (PlaceEvidence(), 'looks like chance'),
        (PlaceEvidence(look=9.0, free=-40.0, sides=-3.0), 'free space through obstacles'),
        (PlaceEvidence(look=9.0, free=-1.0, sides=-30.0), 'not seen from the other side'),
        (PlaceEvidence(look=9.0, level=-20.0, travel=-9.0), 'another floor'),
        (PlaceEvidence(look=9.0, travel=-20.0), 'more than drift'),
        (PlaceEvidence(look=9.0, rivals=-9.0), 'as much for another place'),
    ],
)
def test_the_term_that_speaks_most_against_a_place_is_the_reason(evidence, reason):
    assert evidence.objection == reason


def test_counts_that_are_the_same_say_nothing_and_more_of_them_say_more():
    assert of_counts(20, 20) == 0
    assert of_counts(0, 0) == 0
    assert 0 < of_counts(20, 10) < of_counts(40, 20) == -of_counts(20, 40)


def test_errors_of_three_sigma_cost_four_and_a_half_nats_each():
    assert of_errors((0.3, 0.1), (0.06, 0.02)) == pytest.approx(-9.0)
