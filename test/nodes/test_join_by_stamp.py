from segfloor_ros.core.geometry import MAX_DISORDER_NS
from segfloor_ros.nodes.shared.joining import Dropped, StampJoiner


def test_a_set_is_complete_with_its_last_part_in_any_order() -> None:
    joiner = StampJoiner(('a', 'b', 'c'))
    assert joiner.add('c', 5, 'c5') is None
    assert joiner.add('a', 6, 'a6') is None
    assert joiner.add('a', 5, 'a5') is None
    assert joiner.add('b', 5, 'b5') == {'a': 'a5', 'b': 'b5', 'c': 'c5'}
    assert joiner.take_dropped() == []


def test_a_set_that_was_overtaken_is_dropped_and_says_what_it_lacked() -> None:
    joiner = StampJoiner(('image', 'mask'))
    joiner.add('image', 1, None)
    joiner.add('image', 2, None)
    assert joiner.add('mask', 2, None) is not None
    assert joiner.take_dropped() == [Dropped(1, ('mask',))]
    assert joiner.take_dropped() == []


def test_at_most_the_capacity_waits() -> None:
    joiner = StampJoiner(('a', 'b'), capacity=3)
    for stamp_ns in range(5):
        joiner.add('a', stamp_ns, stamp_ns)
    assert joiner.take_dropped() == [Dropped(0, ('b',)), Dropped(1, ('b',))]
    assert joiner.add('b', 2, None) == {'a': 2, 'b': None}


def test_a_repeated_message_does_not_make_a_second_set() -> None:
    joiner = StampJoiner(('a', 'b'))
    joiner.add('a', 1, 'first')
    assert joiner.add('b', 1, 'first') is not None
    assert joiner.add('a', 1, 'again') is None
    assert joiner.add('b', 1, 'again') is None


def test_stamps_that_jump_back_are_joined_like_any_other() -> None:
    joiner = StampJoiner(('a', 'b'))
    for stamp_ns in (1000, 10):
        joiner.add('a', stamp_ns, stamp_ns)
        assert joiner.add('b', stamp_ns, stamp_ns) == {'a': stamp_ns, 'b': stamp_ns}


def test_within_the_tolerance_the_nearest_partner_is_taken() -> None:
    joiner = StampJoiner(('left', 'right'), tolerance_ns=10)
    joiner.add('left', 100, 'l100')
    joiner.add('left', 115, 'l115')
    assert joiner.add('right', 109, 'r109') == {'left': 'l115', 'right': 'r109'}
    assert joiner.take_dropped() == [Dropped(100, ('right',))]
    joiner.add('left', 200, 'l200')
    assert joiner.add('right', 211, 'r211') is None


def test_an_optional_part_is_waited_for_while_it_may_come() -> None:
    may_come = [True]
    joiner = StampJoiner(('a', 'b'), optional={'path': lambda: may_come[0]})
    joiner.add('a', 1, 'a1')
    assert joiner.add('b', 1, 'b1') is None
    assert joiner.add('path', 1, 'p1') == {'a': 'a1', 'b': 'b1', 'path': 'p1'}
    may_come[0] = False
    joiner.add('a', 2, 'a2')
    assert joiner.add('b', 2, 'b2') == {'a': 'a2', 'b': 'b2'}
    joiner.add('a', 3, 'a3')
    joiner.add('a', 4, 'a4')
    assert joiner.add('b', 4, 'b4') is not None
    assert joiner.take_dropped() == [Dropped(3, ('b',))]


def test_after_a_jump_back_known_stamps_are_taken_again() -> None:
    joiner = StampJoiner(('a', 'b'))
    for stamp_ns in (0, MAX_DISORDER_NS, 2 * MAX_DISORDER_NS, 0):
        joiner.add('a', stamp_ns, stamp_ns)
        assert joiner.add('b', stamp_ns, stamp_ns) == {'a': stamp_ns, 'b': stamp_ns}
    joiner.add('a', MAX_DISORDER_NS, 'new pass')
    assert joiner.add('b', MAX_DISORDER_NS, 'new pass') is not None
