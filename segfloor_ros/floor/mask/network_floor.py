"""How far what a network calls floor can be believed: as often as geometry agreed so far."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.floor.observation import FLOOR, NO_EVIDENCE

TRUSTED = 0.9
"""Probability that what a network calls floor is floor, from which on it counts where nothing is
measured."""


class NetworkFloor:
    """Compares what a network calls floor with what is measured, keyframe by keyframe."""

    def __init__(self) -> None:
        self._agreed = 0.0
        self._keyframes = 0

    @property
    def probability(self) -> float:
        """That what the network calls floor is floor, by the rule of succession (Laplace): one
        half before anything is known.
        """
        return (self._agreed + 1) / (self._keyframes + 2)

    @property
    def is_trusted(self) -> bool:
        """Whether it counts."""
        return self.probability > TRUSTED

    @property
    def remark(self) -> str:
        """What is wrong with the network, in words, once that is certain."""
        if self.is_trusted or self._keyframes * (1 - TRUSTED) < 1:
            return ''
        share = self._agreed / self._keyframes
        return f'of what the network calls floor {100 * share:.0f} % is: it is not used as floor'

    def note(self, said: NDArray[np.uint8], measured: NDArray[np.uint8]) -> None:
        """Compare what is said (R, W) of a keyframe with its mask (R, W) without the network."""
        decided = measured[(said == FLOOR) & (measured != NO_EVIDENCE)]
        if len(decided):
            self._agreed += float((decided == FLOOR).mean())
            self._keyframes += 1
