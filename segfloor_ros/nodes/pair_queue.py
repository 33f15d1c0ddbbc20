"""Stereo pairs that wait to be processed."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

Item = TypeVar('Item')

MAX_KEPT = 100
"""Pairs that are kept while calibration or mount are not known."""

CATCH_UP = 0.2
"""Of so many of the pairs kept one is skipped per pair processed, where there is no other way."""


class PairQueue(Generic[Item]):
    """Keeps the newest pairs: a late pose is of no use to a robot. What came before processing
    could begin is caught up on, not thrown away at once.
    """

    def __init__(self) -> None:
        self._waiting: deque[Item] = deque()
        self._allowed: float = MAX_KEPT

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, pair: Item) -> None:
        """Append a pair."""
        self._waiting.append(pair)

    @property
    def first(self) -> Item:
        """The oldest pair."""
        return self._waiting[0]

    def skip_overdue(self, is_ready: bool, least: int) -> list[Item]:
        """Take out the oldest pairs that are too many and return them. is_ready: processing has
        begun; then no more than `least` wait for long.
        """
        if is_ready:
            self._allowed = max(min(self._allowed - CATCH_UP, len(self._waiting)), least)
        skipped = []
        while len(self._waiting) > self._allowed:
            skipped.append(self._waiting.popleft())
        return skipped

    def take(self) -> Item:
        """Take out the oldest pair."""
        return self._waiting.popleft()

    def clear(self) -> None:
        """Drop all pairs."""
        self._waiting.clear()

    def reset(self) -> None:
        """Keep many pairs again, as at the start."""
        self._allowed = MAX_KEPT
