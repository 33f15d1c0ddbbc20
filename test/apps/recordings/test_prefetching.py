"""Reading ahead: order, errors, and the end of the thread."""

import threading
from collections.abc import Iterator
from itertools import islice

import pytest

from segfloor_ros.apps.recordings.source import AHEAD, prefetched


def reader_threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith('images')]


def test_items_come_in_order_from_another_thread() -> None:
    def items() -> Iterator[tuple[int, str]]:
        for i in range(20):
            yield i, threading.current_thread().name

    received = list(prefetched(items()))
    assert [i for i, _ in received] == list(range(20))
    assert {name for _, name in received} == {'images_0'}
    assert reader_threads() == []


def test_an_error_comes_where_its_item_would_have_come() -> None:
    def items() -> Iterator[int]:
        yield 1
        yield 2
        raise ValueError('third')

    received = []
    with pytest.raises(ValueError, match='third'):
        received.extend(prefetched(items()))
    iterator = prefetched(items())
    assert list(islice(iterator, 2)) == [1, 2]
    with pytest.raises(ValueError, match='third'):
        next(iterator)
    assert reader_threads() == []


def test_the_thread_ends_when_the_consumer_stops() -> None:
    read, closed = [], []

    def items() -> Iterator[int]:
        try:
            for i in range(1000):
                read.append(i)
                yield i
        finally:
            closed.append(True)

    iterator = prefetched(items())
    assert next(iterator) == 0
    iterator.close()  # type: ignore[attr-defined]
    assert closed == [True]
    assert len(read) <= 1 + AHEAD
    assert reader_threads() == []
