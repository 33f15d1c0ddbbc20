"""The search for the plane that most samples of several frames lie on."""

from __future__ import annotations

import math

import numpy as np

from segfloor_ros.floor.plane import (
    PlaneFit,
    Samples,
    on_and_below,
    plane_of,
    preference,
    propose,
    refine,
    scores,
    with_known,
)
from segfloor_ros.geometry import Array

_KEPT = 60
_SCORED_EVERY = 5
_SCORED = 200
"""A few samples of each frame tell which guess is best; all of them refine it."""
_LEVEL_SIGMA = np.array([np.inf, math.radians(2.0), np.inf])
"""Cameras are mounted level, more or less: with little floor in view, roll is least certain."""


class PlaneSearch:
    """Finds the plane anew with each frame; the best guesses of earlier frames compete with those
    of the new one. known: (3,), pitch, roll and height that are given, NaN where not.
    """

    def __init__(self, known: Array) -> None:
        self._known = known
        self._rng = np.random.default_rng(0)
        self._guesses = np.zeros((0, 3))

    def find(
        self, frames: list[Samples], travel: Array, proposals: int, contrary: list[Samples]
    ) -> PlaneFit | None:
        """Return the plane that the samples of the frames, the newest one last, lie on; None where
        none is plausible.

        travel: (T, 3), where the camera went. contrary: further samples, which can but speak
        against a plane, by lying below it.
        """
        fresh = propose(frames[-1], proposals, self._rng, self._known)
        guesses = np.concatenate([with_known(self._guesses, self._known), fresh])
        if len(guesses) == 0:
            return None
        total = np.sum([scores(_few(frame), guesses) for frame in frames], axis=0)
        for frame in map(_few, contrary):
            total -= frame.weight @ on_and_below(frame, plane_of(guesses))[1]
        total = np.maximum(total, 0) * preference(guesses, travel)
        order = np.argsort(-total, kind='stable')[:_KEPT]
        self._guesses = guesses[order]
        fit = self.refined(frames, self._guesses[0], travel)
        self._guesses = np.concatenate([fit.angles_height[None], self._guesses])
        return fit

    def refined(self, frames: list[Samples], start: Array, travel: Array) -> PlaneFit:
        """Return the plane near `start`, (3,), that fits all samples best."""
        # Frames that show the same err together: the prior counts once per frame, too.
        sigma = _LEVEL_SIGMA / math.sqrt(len(frames))
        level = np.zeros(3)
        return refine(frames, start, self._known, travel, prior_sigma=sigma, prior_mean=level)


def _few(samples: Samples) -> Samples:
    return samples.every(int(np.clip(len(samples.weight) // _SCORED, 1, _SCORED_EVERY)))
