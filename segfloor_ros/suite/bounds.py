"""Bounds on measures, and what a set of measured values says to them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from segfloor_ros.suite.measures import HIGHER, LOWER, MEASURES

ROUNDING = 1e-9


@dataclass(frozen=True)
class Bound:
    """A measure's least and greatest value allowed; origin: what asks for it, empty for the suite
    itself.
    """

    measure: str
    least: float = -math.inf
    greatest: float = math.inf
    origin: str = ''

    @property
    def wanted(self) -> str:
        """What is wanted, in words."""
        parts = []
        if self.least > -math.inf:
            parts.append(f'at least {number(self.least)}')
        if self.greatest < math.inf:
            parts.append(f'at most {number(self.greatest)}')
        unit = MEASURES[self.measure].unit
        return ' and '.join(parts) + (f' {unit}' if unit else '') + self.origin


@dataclass(frozen=True)
class Verdict:
    """A bound and what was measured; None: it could not be measured."""

    bound: Bound
    measured: float | None

    @property
    def holds(self) -> bool:
        """Whether the bound is kept."""
        if self.measured is None:
            return False
        return self.bound.least - ROUNDING <= self.measured <= self.bound.greatest + ROUNDING

    def __str__(self) -> str:
        measure = MEASURES[self.bound.measure]
        if self.measured is None:
            found = 'was not measured: no truth for it'
        else:
            found = f'{number(self.measured)}{f" {measure.unit}" if measure.unit else ""}'
        return f'{self.bound.measure}: {found}, wanted {self.bound.wanted}'


@dataclass(frozen=True)
class Slack:
    """By how much a measure may be worse than the baseline; relative: as a share of it."""

    value: float
    relative: bool = False


def judge(bounds: list[Bound], measured: Mapping[str, float]) -> list[Verdict]:
    """Hold measured values against bounds."""
    return [Verdict(bound, measured.get(bound.measure)) for bound in bounds]


def bounds_of_baseline(baseline: Mapping[str, float], slacks: Mapping[str, Slack]) -> list[Bound]:
    """Return what must hold for values to be no worse than a baseline by more than a slack: the
    suite's, else the measure's own.
    """
    bounds = []
    for name, measure in MEASURES.items():
        slack = slacks.get(name)
        if slack is None and measure.slack is not None:
            slack = Slack(measure.slack, measure.relative)
        if slack is None or name not in baseline:
            continue
        base = baseline[name]
        margin = abs(base) * slack.value if slack.relative else slack.value
        origin = f' (baseline {number(base)})'
        if measure.better == HIGHER:
            bounds.append(Bound(name, least=base - margin, origin=origin))
        elif measure.better == LOWER:
            bounds.append(Bound(name, greatest=base + margin, origin=origin))
        else:
            bounds.append(Bound(name, base - margin, base + margin, origin))
    return bounds


def number(value: float) -> str:
    """Return a value with four significant digits, and whole ones as they are."""
    return f'{value:.0f}' if value == round(value) else f'{value:.4g}'
