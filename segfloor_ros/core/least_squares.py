"""Levenberg-Marquardt: nonlinear least squares, also with robust costs.

A state on trial brings its cost, and solves its own normal equations: dense, sparse, or by the
Schur complement (Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000, sections 3, 4 and
6.1). Robust costs enter as weights of the residuals (iteratively reweighted least squares: Holland
and Welsch, 1977).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

S = TypeVar('S', bound='State')

SMALLEST = 1e-12
"""Decrease of a cost that is rounding alone; variance or pivot: what is not observed must not look
exact, nor end in a division by zero."""

SHRINK, GROW = 0.2, 10.0
"""Factors of the damping after a step that lowers the cost, unless the problem knows a better one,
and after a step that does not.
"""


class State(Protocol):
    """A solution on trial."""

    @property
    def cost(self) -> float:
        """The cost: a sum of squares, or of robust costs, without unit."""

    def linearised(self: S) -> Callable[[float], tuple[S, float]]:
        """Return what makes, of a damping, the next state and the factor of the damping from there
        on. Damping is a share of the diagonal of the normal equations (Marquardt, 1963).
        """


def minimise(
    state: S,
    steps: int,
    tolerance: float,
    damping: float = 1e-4,
    is_wanted: Callable[[], bool] = lambda: True,
) -> S:
    """Return the state of the least cost found within some steps (Madsen, Nielsen and Tingleff,
    Methods for Non-Linear Least Squares Problems, 2004, section 3.2). It ends when the cost falls
    by less than a share of it, the tolerance, or when the result is no longer wanted.
    """
    solve = None
    for _ in range(steps):
        if not is_wanted():
            break
        solve = solve or state.linearised()
        trial, factor = solve(damping)
        decrease = state.cost - trial.cost
        if not decrease >= 0:  # nor where it is no number
            damping *= GROW
            continue
        if decrease < tolerance * state.cost + SMALLEST:
            return trial
        state, solve, damping = trial, None, damping * factor
    return state
