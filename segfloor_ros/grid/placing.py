"""A keyframe's evidence laid on the raster at the keyframe's pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from segfloor_ros.geometry import Array
from segfloor_ros.grid.fan import Fan, find_jumps, unit_vectors
from segfloor_ros.grid.keyframe_evidence import KeyframeEvidence

Pose2d = tuple[float, float, float]
"""x and y in metres, yaw in radians."""
BEHIND_M = 0.1
"""Nothing is free so close behind a face: walls are no thinner."""


@dataclass(frozen=True)
class PlacedEvidence:
    """Evidence in cells, x along columns and y along rows, seen from the corner of cell `low`.

    low, high: (row, column) of the first cell and of one beyond the last that the evidence
    touches. previous: (2,), where the base came from. rays: (2, R), ends of single rays. faces:
    (2, C + P), starts of the lines along contacts, then obstacle points; outward: (2, C + P), unit
    vectors from the base to them. ends: (2, C), where these lines end; thickness: (C,), how deep
    is what stands behind them. sure_range: how far obstacles are placed within a
    cell.
    """

    low: tuple[int, int]
    high: tuple[int, int]
    fan: Fan
    previous: Array
    rays: Array
    ends: Array
    faces: Array
    outward: Array
    thickness: Array
    sure_range: float


def place(
    evidence: KeyframeEvidence,
    pose: Pose2d,
    previous: Pose2d | None,
    resolution_m: float,
    margin_m: float,
) -> PlacedEvidence:
    """Lay evidence on the raster with the base at `pose`, and `margin_m` around its way there."""
    yaw, scale = pose[2], 1 / resolution_m
    way = np.array([pose[:2], (previous or pose)[:2]]).T * scale
    lengths = evidence.fan_m.astype(np.float64) * scale
    first_rad = evidence.first_rad + yaw
    directions = unit_vectors(first_rad + evidence.step_rad * np.arange(len(lengths)))
    cos, sin = np.cos(yaw) * scale, np.sin(yaw) * scale
    positions = np.array([[cos, -sin], [sin, cos]]) @ evidence.positions_m.astype(np.float64)
    rays, faces = evidence.num_rays, evidence.num_rays + evidence.num_contacts
    x, y = positions[:, faces:]
    outward = positions[:, faces:] / np.maximum(np.sqrt(x * x + y * y), 1.0)
    positions += way[:, :1]
    thickness = np.maximum(evidence.thickness_m.astype(np.float64) * scale, 1.0)
    margin = margin_m * scale + 2
    body = int(np.ceil(thickness.max(initial=BEHIND_M * scale))) + 1
    ends = directions * lengths + way[:, :1]
    touched = np.concatenate([ends, positions, way - margin, way + margin], axis=1)
    low = np.floor(touched.min(axis=1, keepdims=True)).astype(np.intp) - body
    high = np.floor(touched.max(axis=1, keepdims=True)).astype(np.intp) + body + 1
    positions -= low
    way -= low
    return PlacedEvidence(
        low=(int(low[1, 0]), int(low[0, 0])),
        high=(int(high[1, 0]), int(high[0, 0])),
        fan=Fan(way[:, 0], first_rad, evidence.step_rad, directions, lengths, find_jumps(lengths)),
        previous=way[:, 1],
        rays=positions[:, :rays],
        ends=positions[:, rays:faces],
        faces=positions[:, faces:],
        outward=outward,
        thickness=thickness,
        sure_range=evidence.sure_range_m * scale,
    )
