"""Gauss-Newton by a schedule: robust fits whose cost changes from step to step.

A robust weight falls with the residual, and its scale with the steps (iteratively reweighted least
squares: Holland and Welsch, 1977): the costs of two steps cannot be compared, and no step is
refused. Where they can, `core.least_squares` takes only steps that lower the cost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import numpy as np

from segfloor_ros.core.geometry import Array

X = TypeVar('X')
Stage = TypeVar('Stage')

LEAST = 1e-9
"""Information that is none."""


def gauss_newton(
    x: X,
    linearise: Callable[[X, Stage], tuple[Array, Array, Any]],
    schedule: Iterable[Stage],
    apply: Callable[[X, Array], X],
    free: Any = slice(None),
) -> tuple[X, Array, Any]:
    """Return a solution after one step for each stage of a schedule, which is not empty, with the
    information (K, K) and the remark that `linearise` returned for the last step.

    linearise: returns of a solution the information J^T W J (K, K), the gradient J^T W r (K,) of
    residuals measured minus expected, both with what is known before, and any remark. apply:
    returns the solution after a step (K,). free: the unknowns that move, (K,) bool or a slice; one
    of which nothing is known stays, too (Triggs et al., Bundle Adjustment: A Modern Synthesis,
    2000, sections 3.3 and 4).
    """
    for stage in schedule:
        information, gradient, remark = linearise(x, stage)
        step, H = np.zeros(len(gradient)), information + LEAST * np.eye(len(gradient))
        step[free] = np.linalg.solve(H[free][:, free], gradient[free])
        x = apply(x, step)
    return x, information, remark
