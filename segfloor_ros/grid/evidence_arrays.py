"""The evidence of keyframes as arrays, for a file, and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from segfloor_ros.grid.keyframe_evidence import KeyframeEvidence
from segfloor_ros.map_file import Arrays, joined, split

NUMBERS = {
    'first_rad': float,
    'step_rad': float,
    'sure_range_m': float,
    'num_rays': int,
    'num_contacts': int,
}
LENGTHS = {'fan_m': 'fan_count', 'thickness_m': 'thickness_count', 'positions_m': 'position_count'}
"""The arrays of a keyframe, and what holds their lengths."""


def evidence_to_arrays(evidence: list[KeyframeEvidence]) -> Arrays:
    """Return the evidence of keyframes (K) as arrays."""
    numbers = [[float(getattr(e, name)) for name in NUMBERS] for e in evidence]
    arrays: Arrays = {'numbers': np.array(numbers, np.float64).reshape(-1, len(NUMBERS))}
    for name, lengths in LENGTHS.items():
        empty = np.zeros((0, 2) if name == 'positions_m' else 0, np.float16)
        arrays[name], arrays[lengths] = joined([getattr(e, name).T for e in evidence], empty)
    return arrays


def evidence_from_arrays(arrays: Arrays) -> list[KeyframeEvidence]:
    """Return what `evidence_to_arrays` took. Raises KeyError or ValueError for other arrays."""
    parts = [split(arrays[name], arrays[lengths]) for name, lengths in LENGTHS.items()]
    evidence = []
    for row, *of_one in zip(arrays['numbers'].tolist(), *parts, strict=True):
        values: dict[str, Any] = {n: NUMBERS[n](v) for n, v in zip(NUMBERS, row, strict=True)}
        for name, array in zip(LENGTHS, of_one, strict=True):
            values[name] = np.ascontiguousarray(array.T)
        evidence.append(KeyframeEvidence(**values))
    return evidence
