"""Levenberg-Marquardt: nonlinear least squares, also with robust costs.

A state on trial brings its cost, and solves its own normal equations: dense, sparse, or by the
Schur complement (Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000, sections 3, 4 and
6.1). Robust costs enter as weights of the residuals (iteratively reweighted least squares: Holland
and Welsch, 1977).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
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


def improve(state: S, steps: int, tolerance: float, damping: float = 1e-4) -> Iterator[S]:
    """Yield the state of the least cost found so far, after each half of a step: the linearisation
    and the solution (Madsen, Nielsen and Tingleff, Methods for Non-Linear Least Squares Problems,
    2004, section 3.2). It ends when the cost falls by less than a share of it, the tolerance.
    """
    solve = None
    for _ in range(steps):
        if solve is None:
            solve = state.linearised()
            yield state
        trial, factor = solve(damping)
        decrease, enough = state.cost - trial.cost, tolerance * state.cost + SMALLEST
        if decrease >= 0:
            state, solve, damping = trial, None, damping * factor
        else:  # also where it is no number
            damping *= GROW
        yield state
        if 0 <= decrease < enough:
            return


def minimise(state: S, steps: int, tolerance: float, damping: float = 1e-4) -> S:
    """Return the state of the least cost that `improve` finds."""
    for better in improve(state, steps, tolerance, damping):
        state = better
    return state
