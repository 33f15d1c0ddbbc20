"""What a suite found: each recording with its measures and verdicts."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from segfloor_ros.errors import InputError
from segfloor_ros.files.results import write_file
from segfloor_ros.files.whole import read_json
from segfloor_ros.suite.description import Entry
from segfloor_ros.suite.job import Outcome
from segfloor_ros.suite.measures import Verdict, bounds_of_baseline, known_measures

FORMAT = 1
Baseline = Mapping[str, Mapping[str, float]]
"""Measures by recording."""


@dataclass(frozen=True)
class Checked(Outcome):
    """What came of a recording, and what its measures say to its bounds."""

    verdicts: tuple[Verdict, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether there is a map and every bound is kept."""
        return not self.problem and all(verdict.holds for verdict in self.verdicts)

    @property
    def state(self) -> str:
        """How it went, in words."""
        return 'ok' if self.holds else 'no map' if self.problem else 'fails'

    @property
    def complaints(self) -> list[str]:
        """A line for each thing that is wrong."""
        if self.problem:
            return [f'{self.name}: {self.problem}']
        return [f'{self.name}: {verdict}' for verdict in self.verdicts if not verdict.holds]


@dataclass(frozen=True)
class SuiteResult:
    """All recordings of a suite, in its order."""

    name: str
    recordings: list[Checked]

    @property
    def holds(self) -> bool:
        """Whether everything is as it should be."""
        return all(checked.holds for checked in self.recordings)


def check(entry: Entry, outcome: Outcome, baseline: Baseline | None) -> Checked:
    """Hold an outcome against the bounds of the suite and, where given, of a baseline."""
    bounds = list(entry.bounds)
    if baseline is not None:
        bounds += bounds_of_baseline(baseline.get(entry.name, {}), entry.slacks)
    # The archive is in the suite's folder by now.
    known = {**vars(outcome), 'archive': b''}
    verdicts = tuple(Verdict(bound, outcome.measured.get(bound.measure)) for bound in bounds)
    return Checked(**known, verdicts=verdicts)


def write_baseline(result: SuiteResult, path: Path) -> None:
    """Write the measures of all recordings that have a map."""
    measures = {c.name: dict(c.measured) for c in result.recordings if not c.problem}
    document = {'version': FORMAT, 'recordings': measures}
    write_file(path, (json.dumps(document, indent=2) + '\n').encode())


def is_baseline(path: Path) -> bool:
    """Whether a file is one of `write_baseline`."""
    try:
        read_baseline(path)
    except InputError:
        return False
    return True


def read_baseline(path: Path) -> Baseline:
    """Read what `write_baseline` wrote. Raises InputError."""
    try:
        recordings = read_json(path, 'a baseline')['recordings']
        return {name: known_measures(measures) for name, measures in recordings.items()}
    except (ValueError, KeyError, AttributeError):
        raise InputError(f'{path}: not a baseline; write one with --write-baseline') from None
