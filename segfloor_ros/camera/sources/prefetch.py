"""Reading ahead on a background thread."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

T = TypeVar('T')

AHEAD = 3
"""Items prepared before they are asked for."""


def prefetched(items: Generator[T, None, None] | Iterator[T]) -> Iterator[T]:
    """Yield `items` in order, prepared on one background thread.

    Errors are raised where their item would have come. The thread ends with the last item, with
    an error, and when the consumer stops early.
    """
    end = object()
    worker = ThreadPoolExecutor(1, 'images')
    pending: deque[Future[object]] = deque()
    try:
        while True:
            while len(pending) < AHEAD:
                pending.append(worker.submit(next, items, end))
            item = pending.popleft().result()
            if item is end:
                return
            yield item  # type: ignore[misc]
    finally:
        worker.shutdown(cancel_futures=True)
        if isinstance(items, Generator):
            items.close()
