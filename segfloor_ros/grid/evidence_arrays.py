"""The evidence of keyframes as arrays, for a file, and back."""

from __future__ import annotations

import numpy as np

from segfloor_ros.grid.keyframe_evidence import KeyframeEvidence
from segfloor_ros.map_file import Arrays, joined, split

NUMBERS = ('first_rad', 'step_rad', 'sure_range_m', 'num_rays', 'num_contacts')


def evidence_to_arrays(evidence: list[KeyframeEvidence]) -> Arrays:
    """Return the evidence of keyframes (K) as arrays."""
    none = np.zeros(0, np.float16)
    fan, fan_count = joined([e.fan_m for e in evidence], none)
    thickness, thickness_count = joined([e.thickness_m for e in evidence], none)
    positions, position_count = joined(
        [e.positions_m.T for e in evidence], np.zeros((0, 2), np.float16)
    )
    numbers = [[float(getattr(e, name)) for name in NUMBERS] for e in evidence]
    return {
        'numbers': np.array(numbers, np.float64).reshape(-1, len(NUMBERS)),
        'fan_m': fan,
        'fan_count': fan_count,
        'thickness_m': thickness,
        'thickness_count': thickness_count,
        'positions_m': positions,
        'position_count': position_count,
    }


def evidence_from_arrays(arrays: Arrays) -> list[KeyframeEvidence]:
    """Return what `evidence_to_arrays` took. Raises KeyError or ValueError for other arrays."""
    parts = zip(
        arrays['numbers'].tolist(),
        split(arrays['fan_m'], arrays['fan_count']),
        split(arrays['positions_m'], arrays['position_count']),
        split(arrays['thickness_m'], arrays['thickness_count']),
        strict=True,
    )
    return [
        KeyframeEvidence(
            first_rad=first_rad,
            step_rad=step_rad,
            fan_m=fan_m,
            positions_m=np.ascontiguousarray(positions_m.T),
            num_rays=int(num_rays),
            num_contacts=int(num_contacts),
            thickness_m=thickness_m,
            sure_range_m=sure_range_m,
        )
        for (first_rad, step_rad, sure_range_m, num_rays, num_contacts), fan_m, positions_m, (
            thickness_m
        ) in parts
    ]
