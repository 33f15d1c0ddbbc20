"""A stamp that is wrong is told from a clock that jumped."""

import pytest

from segfloor_ros.nodes.shared.stamp_order import AGREEING, InTime, StampOrder

S = 1_000_000_000
WRONG = [0, -5 * S, 99 * S, (2**31 - 2) * S, 103 * S]


def taken(order: StampOrder, stamps_s: list[float]) -> list[InTime]:
    return [order.take(round(stamp_s * S)) for stamp_s in stamps_s]


@pytest.mark.parametrize('wrong_ns', WRONG)
@pytest.mark.parametrize('times', [1, 2])
def test_a_wrong_stamp_or_two_change_nothing(wrong_ns, times) -> None:
    order = StampOrder()
    assert taken(order, [100.0, 100.1, 100.2]) == [InTime.NEXT] * 3
    for i in range(times):
        assert order.take(wrong_ns + i) is InTime.ELSEWHERE
    assert taken(order, [100.3, 100.4]) == [InTime.NEXT] * 2


@pytest.mark.parametrize('start_s', [0.0, 99.0, 160.0])
def test_several_in_a_row_that_agree_are_another_time(start_s) -> None:
    order = StampOrder(100 * S)
    found = taken(order, [start_s + 0.1 * i for i in range(AGREEING + 1)])
    assert found == [*[InTime.ELSEWHERE] * (AGREEING - 1), InTime.JUMPED, InTime.NEXT]


def test_wrong_stamps_that_do_not_agree_are_no_time() -> None:
    order = StampOrder(100 * S)
    assert taken(order, [50.0, 40.0, 30.0, 20.0]) == [InTime.ELSEWHERE] * 4


def test_a_slow_camera_is_in_time_once_it_is_known() -> None:
    found = taken(StampOrder(), [5.0 * i for i in range(8)])
    assert found == [
        *(InTime.NEXT, *[InTime.ELSEWHERE] * (AGREEING - 1), InTime.JUMPED),
        *[InTime.NEXT] * (7 - AGREEING),
    ]


def test_a_little_late_is_late_alone() -> None:
    assert taken(StampOrder(), [1.0, 1.0, 0.9, 1.1]) == [
        *(InTime.NEXT, InTime.LATE, InTime.LATE, InTime.NEXT)
    ]
