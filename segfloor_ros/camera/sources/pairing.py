"""What belongs together by its stamps: the parts of a set as they come, and the left and right
images of a recording in their order.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Generic, TypeVar

from segfloor_ros.errors import InputError
from segfloor_ros.geometry import MAX_DISORDER_NS

logger = logging.getLogger(__name__)

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


def check_forward(where: str, last_ns: Sequence[int], stamp_ns: int) -> None:
    """Raise InputError when `stamp_ns` is earlier than the last one, if there was one."""
    if last_ns and stamp_ns < last_ns[-1]:
        raise InputError(
            f'{where}: the stamp goes backwards, from {last_ns[-1] / 1e9:.9f} s to '
            f'{stamp_ns / 1e9:.9f} s; cut the recording there and use one part'
        )


class StampPairing(Generic[T]):
    """Pairs the images of a recording, and yields the pairs in the order of their stamps.

    Images are added in the order of their arrival, side 0 the left, side 1 the right. A pair that
    comes one place late is put where it belongs; an image that comes later still means that the
    clock went backwards, an InputError. At most `limit` images wait. names: of both sides, for
    messages.

    pairs, and by side: unpaired, images without a partner; duplicates, images with a stamp that
    was there before.
    """

    def __init__(self, tolerance_s: float, names: tuple[str, str], limit: int = 64) -> None:
        self.pairs = 0
        self.unpaired = [0, 0]
        self.duplicates = [0, 0]
        self._tolerance_s = tolerance_s
        self._names = names
        self._joiner = StampJoiner(names, limit, round(tolerance_s * 1e9))
        self._latest: list[list[int]] = [[], []]
        self._alone: list[list[int]] = [[], []]
        self._held: list[tuple[Stamped[T], Stamped[T]]] = []

    def add(self, side: int, stamp_ns: int, item: T) -> Iterator[tuple[Stamped[T], Stamped[T]]]:
        """Take in an image and yield the pairs that are complete now, but the last one."""
        latest, name = self._latest[side], self._names[side]
        if stamp_ns in latest:
            self.duplicates[side] += 1
            return
        if len(latest) == 2:
            check_forward(name, latest[:1], stamp_ns)
        self._latest[side] = sorted([*latest, stamp_ns])[-2:]
        pair = self._joiner.add(name, stamp_ns, Stamped(stamp_ns, item))
        self._count_dropped()
        if pair is not None:
            self.pairs += 1
            self._held.append((pair[self._names[0]], pair[self._names[1]]))
            self._held.sort(key=lambda both: both[0].stamp_ns)
            if len(self._held) > 1:
                yield self._held.pop(0)

    def finish(self) -> Iterator[tuple[Stamped[T], Stamped[T]]]:
        """Yield the last pair; nothing is added after this."""
        yield from self._held
        self._joiner.give_up()
        self._count_dropped()

    def report(self) -> None:
        """Warn of images that were left out. Raises InputError when there was no pair at all."""
        names = f'{self._names[0]} and {self._names[1]}'
        if not self.pairs:
            alone = sorted((ns, side) for side in (0, 1) for ns in self._alone[side])
            apart = (b - a for (a, one), (b, other) in pairwise(alone) if one != other)
            gap_ns = min(apart, default=None)
            nearest = '' if gap_ns is None else f'; the nearest are {gap_ns / 1e9:.6f} s apart'
            raise InputError(
                f'{names}: no two images within {self._tolerance_s:g} s{nearest}; are both '
                'cameras on one clock? else raise stereo_camera.pairing_tolerance_s'
            )
        if any(self.unpaired):
            logger.warning('%s: %d and %d images have no partner', names, *self.unpaired)
        if any(self.duplicates):
            logger.warning('%s: %d and %d images came twice', names, *self.duplicates)

    def _count_dropped(self) -> None:
        for dropped in self._joiner.take_dropped():
            side = 1 - self._names.index(dropped.missing[0])
            self.unpaired[side] += 1
            self._alone[side].append(dropped.stamp_ns)
