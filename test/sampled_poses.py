"""Covariances compared with samples: along all axes, and in what the axes have in common."""

import numpy as np

from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.twists import se3_exp, se3_logs

SAMPLES = 6000

SIGMAS_OF_SAMPLES = 4.0
"""The widest and the narrowest axis of Gaussian samples are off by no more, but for 1 in 1000."""

SECOND_ORDER = 0.03
"""A covariance is carried to first order; samples bend by so much at most."""

SIGMA = np.array([0.003, 0.0008, 0.0015, 0.0006, 0.0024, 0.0011])
"""No two axes of a pose are alike, in metres and radians."""


def uneven_covariance(rng: np.random.Generator, scale: float = 1.0) -> Array:
    """Return a covariance (6, 6) whose axes differ and have errors in common."""
    mixed = scale * SIGMA[:, None] * (np.eye(6) + 0.25 * rng.normal(size=(6, 6)))
    return mixed @ mixed.T


def drawn_errors(rng: np.random.Generator, covariance: Array, count: int = SAMPLES) -> Array:
    """Return twists (N, 6) of a covariance (6, 6)."""
    return rng.normal(size=(count, 6)) @ np.linalg.cholesky(covariance).T


def drawn_poses(
    rng: np.random.Generator, T: Array, covariance: Array, count: int = SAMPLES
) -> Array:
    """Return transforms (N, 4, 4) around T (4, 4): exp(twist) T, twists of a covariance (6, 6)."""
    return se3_exp(drawn_errors(rng, covariance, count)) @ T


def twists_from(T: Array, samples: Array) -> Array:
    """Return the twists (N, 6) by which samples (N, 4, 4) differ from T (4, 4)."""
    return se3_logs(samples @ invert(T))


def assert_spread(errors: Array, covariance: Array) -> None:
    """Check that errors (N, D) have zero mean and a covariance (D, D).

    In the axes of the covariance the samples must be spread alike in all directions. With N samples
    the standard deviations along the widest and the narrowest direction are 1 ± (sqrt(D) + t) /
    sqrt(N), with probability 1 - 2 exp(-t² / 2) (Vershynin, High-Dimensional Probability, 2018,
    theorem 4.6.1 and corollary 7.3.3).
    """
    count, axes = errors.shape
    white = np.linalg.solve(np.linalg.cholesky(covariance), errors.T)
    spread = np.sqrt(np.linalg.eigvalsh(white @ white.T / count))
    bound = (np.sqrt(axes) + SIGMAS_OF_SAMPLES) / np.sqrt(count) + SECOND_ORDER
    assert np.abs(spread - 1).max() < bound, f'spread {spread}, expected 1 +- {bound:.3f}'
