"""The search for the plane that most samples of several frames lie on."""

from __future__ import annotations

import math

import numpy as np

from segfloor_ros.floor.plane.plane_fit import (
    SCALES_PX,
    PlaneFit,
    Samples,
    angles_height_of,
    on_and_below,
    plane_of,
    preference,
    propose,
    refine,
    scores,
    with_known,
)
from segfloor_ros.geometry import Array
from segfloor_ros.measurements import Up

_KEPT = 60
_SCORED, _REFINED = 6000, 60000
"""So many samples of all frames together tell which guess is best, and refine it: neighbours err
together.
"""
_FINE_STEPS = 4
"""So many steps of the refinement take them all; before, what scores will do."""
_LEVEL_SIGMA = np.array([np.inf, math.radians(2.0), np.inf])
"""Cameras are mounted level, more or less: with little floor in view, roll is least certain."""
_FLOOR_SLOPE = math.radians(1.5)
"""Floors on which robots start are level, more or less."""


class PlaneSearch:
    """Finds the plane anew with each frame; the best guesses of earlier frames compete with those
    of the new one. known: (3,), pitch, roll and height that are given, NaN where not.
    """

    def __init__(self, known: Array) -> None:
        self._known = known
        self._rng = np.random.default_rng(0)
        self._guesses = np.zeros((0, 3))
        self._up: Up | None = None

    def expect(self, up_world: Up | None) -> None:
        """Expect a floor that is level as an accelerometer feels it, in the world's axes."""
        self._up = up_world

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
        total = np.sum([scores(few, guesses) for few in _thinned(frames, _SCORED)], axis=0)
        for frame in _thinned(contrary, _SCORED):
            total -= frame.weight @ on_and_below(frame, plane_of(guesses))[1]
        total = np.maximum(total, 0) * self._preference(guesses, travel)
        order = np.argsort(-total, kind='stable')[:_KEPT]
        self._guesses = guesses[order]
        fit = self.refined(frames, self._guesses[0], travel)
        self._guesses = np.concatenate([fit.angles_height[None], self._guesses])
        return fit

    def refined(self, frames: list[Samples], start: Array, travel: Array) -> PlaneFit:
        """Return the plane near `start`, (3,), that fits all samples best."""
        mean, sigma = self._prior(len(frames))
        roughly, finely = SCALES_PX[:-_FINE_STEPS], SCALES_PX[-_FINE_STEPS:]
        rough = refine(
            _thinned(frames, _SCORED), start, self._known, travel, sigma, roughly, mean
        ).angles_height
        some = _thinned(frames, _REFINED)
        return refine(some, rough, self._known, travel, sigma, finely, mean)

    def _preference(self, guesses: Array, travel: Array) -> Array:
        if self._up is None:
            return preference(guesses, travel)
        mean, sigma = self._prior(1)
        return preference(guesses, travel, mean[:2], sigma[:2])

    def _prior(self, count: int) -> tuple[Array, Array]:
        """Return what pitch, roll and height (3,) are expected, and their standard deviations."""
        # Frames that show the same err together: the prior counts once per frame, too.
        if self._up is None:
            return np.zeros(3), _LEVEL_SIGMA / math.sqrt(count)
        pitch, roll, _ = angles_height_of(self._up.direction)
        sigma = math.hypot(self._up.sigma_rad, _FLOOR_SLOPE) / math.sqrt(count)
        return np.array([pitch, roll, 0.0]), np.array([sigma, sigma, np.inf])


def _thinned(frames: list[Samples], most: int) -> list[Samples]:
    """Return frames with so many samples at most."""
    step = math.ceil(sum(len(frame.weight) for frame in frames) / most)
    return [frame.every(max(1, step)) for frame in frames]
