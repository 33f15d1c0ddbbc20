"""What belongs together by its stamp, joined as it comes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from segfloor_ros.core.geometry import MAX_DISORDER_NS

T = TypeVar('T')


@dataclass(frozen=True)
class Stamped(Generic[T]):
    """Something with a stamp."""

    stamp_ns: int
    item: T


@dataclass(frozen=True)
class Dropped:
    """A set that was given up: its stamp, and the parts that never came."""

    stamp_ns: int
    missing: tuple[str, ...]


class StampJoiner:
    """Collects one value per part and stamp, and hands out complete sets.

    Every topic delivers in order, so once a set is complete, the sets that were begun before it
    cannot be completed any more: they are dropped and what they lacked is kept for the report. At
    most `capacity` sets wait. A stamp that was handed out recently is not taken again, unless time
    has jumped back meanwhile. With a tolerance, stamps that differ by no more are one set.
    optional: parts that a set waits for only while the function says that they may come.
    """

    def __init__(
        self,
        parts: Sequence[str],
        capacity: int = 100,
        tolerance_ns: int = 0,
        optional: Mapping[str, Callable[[], bool]] | None = None,
    ) -> None:
        self.parts = tuple(parts)
        self._optional = dict(optional or {})
        self._latest: dict[str, int] = {}
        self._capacity = capacity
        self._tolerance_ns = tolerance_ns
        self._waiting: dict[int, dict[str, Stamped[Any]]] = {}
        self._done: dict[tuple[str, int], None] = {}
        self._dropped: list[Dropped] = []

    @property
    def all_parts(self) -> tuple[str, ...]:
        """All parts, the optional ones last."""
        return (*self.parts, *(part for part in self._optional if part not in self.parts))

    def add(self, part: str, stamp_ns: int, value: Any) -> dict[str, Any] | None:
        """Take in one part; returns the values by part when its set is complete with it."""
        self._note_time(part, stamp_ns)
        if (part, stamp_ns) in self._done:
            return None
        key = self._set_for(part, stamp_ns)
        parts = self._waiting.setdefault(key, {})
        parts[part] = Stamped(stamp_ns, value)
        if not self._missing(parts):
            return self._complete(key)
        if len(self._waiting) > self._capacity:
            self._drop(next(iter(self._waiting)))
        return None

    def take_dropped(self) -> list[Dropped]:
        """Return the sets given up since the last call."""
        dropped, self._dropped = self._dropped, []
        return dropped

    def give_up(self) -> None:
        """Drop what waits: nothing is added any more."""
        for key in list(self._waiting):
            self._drop(key)

    def clear(self) -> None:
        """Forget everything."""
        self._waiting.clear()
        self._done.clear()
        self._dropped.clear()
        self._latest.clear()

    def _note_time(self, part: str, stamp_ns: int) -> None:
        latest_ns = self._latest.get(part, stamp_ns)
        if stamp_ns < latest_ns - MAX_DISORDER_NS:
            self._done.clear()
            self._latest.clear()
        self._latest[part] = max(stamp_ns, self._latest.get(part, stamp_ns))

    def _missing(self, parts: Mapping[str, Any]) -> tuple[str, ...]:
        needed = (*self.parts, *(part for part, may_come in self._optional.items() if may_come()))
        return tuple(part for part in needed if part not in parts)

    def _set_for(self, part: str, stamp_ns: int) -> int:
        """Return the stamp of the set that a part belongs to, its own where none waits for it."""
        if self._tolerance_ns == 0:
            return stamp_ns
        near = (
            key
            for key, parts in self._waiting.items()
            if abs(key - stamp_ns) <= self._tolerance_ns and part not in parts
        )
        return min(near, key=lambda key: abs(key - stamp_ns), default=stamp_ns)

    def _complete(self, key: int) -> dict[str, Any]:
        while (first := next(iter(self._waiting))) != key:
            self._drop(first)
        parts = self._waiting.pop(key)
        self._done.update(((part, one.stamp_ns), None) for part, one in parts.items())
        while len(self._done) > self._capacity * len(self.all_parts):
            self._done.pop(next(iter(self._done)))
        return {part: one.item for part, one in parts.items()}

    def _drop(self, key: int) -> None:
        parts = self._waiting.pop(key)
        missing = self._missing(parts) or tuple(p for p in self._optional if p not in parts)
        self._dropped.append(Dropped(key, missing))
