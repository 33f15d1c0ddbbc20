"""Pairing of two streams by stamp, on sequences written by hand (milliseconds)."""

import logging

import pytest
from camera_recordings import MS

from segfloor_ros.apps.recordings.source import StampPairing
from segfloor_ros.core.errors import InputError


def pairing(tolerance_ms: float = 10.0, limit: int = 64) -> StampPairing[int]:
    return StampPairing(tolerance_ms / 1000, ('/left', '/right'), limit)


def pairs_of(matcher: StampPairing[int], arrivals: str) -> list[tuple[int, int]]:
    """Add images like 'L100 R101' (side and stamp in ms) and return the pairs of stamps."""
    pairs = []
    for arrival in arrivals.split():
        stamp_ms = int(arrival[1:])
        side = 'LR'.index(arrival[0])
        pairs += list(matcher.add(side, stamp_ms * MS, stamp_ms))
    pairs += list(matcher.finish())
    return [(left.item, right.item) for left, right in pairs]


def test_images_within_the_tolerance_are_pairs() -> None:
    matcher = pairing()
    assert pairs_of(matcher, 'L0 R5 L100 R95 L200 R210') == [(0, 5), (100, 95), (200, 210)]
    assert matcher.unpaired == [0, 0]


def test_images_beyond_the_tolerance_are_none() -> None:
    matcher = pairing()
    assert pairs_of(matcher, 'L0 R0 L100 R111 L200 R200') == [(0, 0), (200, 200)]
    assert matcher.unpaired == [1, 1]


def test_one_side_may_come_much_later() -> None:
    assert pairs_of(pairing(), 'L0 L100 L200 R0 R100 R200') == [(0, 0), (100, 100), (200, 200)]


def test_the_nearest_partner_is_taken() -> None:
    # 8 and 12 are both within 10 ms of 10 and 18; each takes its nearest.
    matcher = pairing()
    assert pairs_of(matcher, 'L0 L10 L20 R8 R18') == [(10, 8), (20, 18)]
    assert matcher.unpaired == [1, 0]


def test_missing_images_cost_only_their_own_pair() -> None:
    matcher = pairing()
    assert pairs_of(matcher, 'L0 R0 R100 L200 R200 L300 L400 R400') == [
        (0, 0),
        (200, 200),
        (400, 400),
    ]
    assert matcher.unpaired == [1, 1]


def test_an_image_one_place_late_is_put_in_order() -> None:
    expected = [(0, 0), (100, 100), (200, 200), (300, 300)]
    assert pairs_of(pairing(), 'L0 R0 L200 R200 L100 R100 L300 R300') == expected


@pytest.mark.parametrize('arrivals', ['L0 L100 L200 L50', 'L500 L400 L300', 'L0 L100 L200 L0'])
def test_stamps_that_go_backwards_are_refused(arrivals: str) -> None:
    with pytest.raises(InputError, match=r'/left: the stamp goes backwards, from .* cut the rec'):
        pairs_of(pairing(), arrivals)


def test_images_that_come_twice_are_dropped(caplog: pytest.LogCaptureFixture) -> None:
    matcher = pairing()
    assert pairs_of(matcher, 'L0 R0 L0 R100 L100 L100') == [(0, 0), (100, 100)]
    assert matcher.duplicates == [2, 0]
    with caplog.at_level(logging.WARNING):
        matcher.report()
    assert '2 and 0 images came twice' in caplog.text


def test_waiting_images_are_bounded(caplog: pytest.LogCaptureFixture) -> None:
    matcher = pairing(limit=3)
    assert pairs_of(matcher, 'L0 L100 L200 L300 L400 R300 R400') == [(300, 300), (400, 400)]
    assert matcher.unpaired == [3, 0]
    with caplog.at_level(logging.WARNING):
        matcher.report()
    assert '3 and 0 images have no partner' in caplog.text


def test_without_a_single_pair_the_distance_is_told() -> None:
    matcher = pairing()
    assert pairs_of(matcher, 'L0 R30 L100 R125') == []
    with pytest.raises(InputError, match=r'within 0.01 s; the nearest are 0.025.* raise stereo_c'):
        matcher.report()


@pytest.mark.parametrize(
    'wrong', ['L0 R0', 'L5000 R5000', 'L99999000 R99999000', 'L3000', 'L0 R9000']
)
def test_a_stamp_of_another_time_costs_its_image_alone(wrong, caplog) -> None:
    matcher = pairing()
    around = 'L10000 R10000 L10100 R10100', 'L10200 R10200 L10300 R10300 L10400 R10400'
    found = pairs_of(matcher, f'{around[0]} {wrong} {around[1]}')
    assert found == [(ms, ms) for ms in range(10000, 10500, 100)]
    assert matcher.elsewhere == [wrong.count('L'), wrong.count('R')]
    matcher.report()
    assert 'have a stamp of another time' in ' '.join(caplog.text.split())


def test_after_a_pause_no_image_is_lost() -> None:
    arrivals = [f'L{ms} R{ms}' for ms in (0, 100, 200, 60000, 60100, 60200, 60300)]
    assert [left for left, _ in pairs_of(pairing(), ' '.join(arrivals))] == [
        *(0, 100, 200, 60000, 60100, 60200, 60300)
    ]


def test_a_clock_that_goes_backwards_is_said_when_several_images_agree() -> None:
    matcher = pairing()
    pairs_of(matcher, 'L10000 R10000 L10100 R10100 L10200 R10200')
    list(matcher.add(0, 0, 0))
    list(matcher.add(0, 100 * MS, 100))
    with pytest.raises(InputError, match='goes backwards'):
        list(matcher.add(0, 200 * MS, 200))
