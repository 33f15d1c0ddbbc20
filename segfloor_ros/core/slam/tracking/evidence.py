"""How much measurements say for a pose, against chance.

A point that should be in view is found with some probability, and then errs by the noise; or what
is found is something else, which is rare where little is searched, and lies anywhere in that area.
The logarithm of the likelihood ratio of the two, summed over all points and averaged over the poses
that the camera may have (Laplace's approximation: MacKay, Information Theory, Inference, and
Learning Algorithms, 2003, chapters 22 and 28), is the evidence for a pose. Where nothing is right,
its exponential is 1 on average, whatever pose is tried; so it exceeds 1 / p with a probability of
at most p (Markov's inequality).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.geometry import Array
from segfloor_ros.core.slam.rig import Observations

ENOUGH_EVIDENCE = math.log(1e6)
"""Chance gives as much once in a million frames."""

ROUNDS = 4
"""Of the estimate of noise and share of the right matches; it settles by a factor of three each."""

KNOWN_AS = 20.0
"""Measurements that what is known of the noise before counts as."""

LARGEST_FACTOR = 4.0
"""Of the noise: what errs by more is something else."""

TAIL = 3.0
"""Degrees of freedom of a motion that is expected: large surprises happen (Student's t)."""


@dataclass(frozen=True)
class Mixture:
    """Right and wrong matches. factor: of the noise. share: of right ones. probability: (N,) that
    each is right. log_ratio: the sum of the logarithms of likelihood over that of chance.
    """

    factor: float
    share: float
    probability: Array
    log_ratio: float

    @staticmethod
    def fit(
        chi2: Array,
        dimensions: Array,
        log_chance: Array,
        factor: float,
        missed: int = 0,
        largest: float = LARGEST_FACTOR,
    ) -> Mixture:
        """Return the likeliest mixture (expectation maximisation: Dempster et al. 1977).

        chi2: (N,) squared residuals over what the noise is announced to be. dimensions: (N,) of
        each. log_chance: (N,) logarithm of what is searched over what the noise fills. factor: of
        the noise, to begin with, and the largest one. missed: how many more were looked for, and
        gave no match.
        """
        share, known, factor = 0.5, KNOWN_AS, min(factor, largest)
        for _ in range(ROUNDS):
            log_right = log_chance - dimensions * math.log(factor) - chi2 / (2 * factor**2)
            right = share * np.exp(np.minimum(log_right, 700.0))
            probability = right / (1.0 - share + right)
            share = float((probability.sum() + 0.5) / (len(chi2) + missed + 1.0))
            total = float(probability @ np.where(probability > 0, chi2, 0.0))
            variance = (known + total) / (known + float(probability @ dimensions))
            factor = math.sqrt(min(max(variance, 1.0), largest**2))
        log_right = log_chance - dimensions * math.log(factor) - chi2 / (2 * factor**2)
        right = share * np.exp(np.minimum(log_right, 700.0))
        log_ratio = float(np.log(1.0 - share + right).sum() + missed * math.log(1.0 - share))
        return Mixture(factor, share, right / (1.0 - share + right), log_ratio)


def log_chance_of(observations: Observations, area_px2: Array | float, range_px: float) -> Array:
    """Return the logarithm (N,) of the area, and range of disparities, in which a wrong match may
    lie, over the density of the noise at its peak.
    """
    measured = np.isfinite(observations.uvd_px)
    spread = np.where(measured, observations.sigma_px * math.sqrt(2 * math.pi), 1.0)
    of_range = np.where(measured[:, 2], math.log(range_px), 0.0)
    log_chance: Array = np.log(area_px2) + of_range - np.log(spread).sum(axis=1)
    return log_chance


def gained(information: Array, prior_covariance: Array) -> float:
    """Return what information (6, 6) narrows a prior (6, 6) down by, in nats: what a pose that fits
    is favoured by for being one of many.
    """
    _, log_det = np.linalg.slogdet(np.eye(len(information)) + prior_covariance @ information)
    return 0.5 * float(log_det)


def surprise(error: Array, covariance: Array) -> float:
    """Return by how many nats an error (6,) is less likely than none (Student's t)."""
    squared = float(error @ np.linalg.solve(covariance, error))
    return 0.5 * (TAIL + len(error)) * math.log1p(squared / TAIL)


def is_proof(evidence: NDArray[np.floating] | float) -> bool:
    """Whether the evidence for a pose is enough."""
    return bool(evidence >= ENOUGH_EVIDENCE)
