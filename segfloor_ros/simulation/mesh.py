"""Triangle meshes of prisms, with texture coordinates in metres on every side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array
from segfloor_ros.simulation.solids import Prism


@dataclass(frozen=True)
class Mesh:
    """Triangles: vertices and normals (V, 3), texture coordinates (V, 2) with v downward in the
    picture, faces (F, 3) counter-clockwise seen from outside.
    """

    vertices: Array
    normals: Array
    uv: Array
    faces: NDArray[np.int64]


def merge(meshes: list[Mesh]) -> Mesh:
    """Return one mesh with the triangles of all."""
    counts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.vstack([mesh.vertices for mesh in meshes]),
        np.vstack([mesh.normals for mesh in meshes]),
        np.vstack([mesh.uv for mesh in meshes]),
        np.vstack([mesh.faces + first for mesh, first in zip(meshes, counts, strict=True)]),
    )


def sides(prism: Prism, side_m: float) -> Mesh:
    """Return the upright sides of a prism. side_m: what the texture covers."""
    corners = prism.footprint
    following = np.roll(corners, -1, axis=0)
    along = following - corners
    lengths = np.hypot(*along.T)
    count = len(corners)
    index = np.stack([np.arange(count), (np.arange(count) + 1) % count], axis=1)
    low, high = prism.bottom_m[index], prism.top_m[index]
    xy = np.stack([corners, following], axis=1)
    vertices = np.concatenate(
        [np.dstack([xy, low]), np.dstack([xy[:, ::-1], high[:, ::-1]])], axis=1
    ).reshape(-1, 3)
    normals = np.repeat(_side_normals(prism, along / lengths[:, None]), 2, axis=1)
    normals = normals[:, [0, 2, 3, 1]].reshape(-1, 3)
    uv = _side_uv(prism, along / lengths[:, None], lengths, vertices, side_m)
    first = np.arange(count)[:, None] * 4
    faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    return Mesh(vertices, normals, uv, faces)


def caps(prism: Prism, side_m: float, top: bool = True, bottom: bool = True) -> Mesh:
    """Return the top and the bottom of a prism."""
    parts = []
    if top:
        parts.append(_cap(prism, prism.top_m, 1.0, side_m))
    if bottom:
        parts.append(_cap(prism, prism.bottom_m, -1.0, side_m))
    return merge(parts)


def _side_normals(prism: Prism, direction: Array) -> Array:
    """Return the normals (K, 2, 3) at the start and the end of each side."""
    flat = np.stack([direction[:, 1], -direction[:, 0], np.zeros(len(direction))], axis=1)
    if not prism.smooth:
        return np.stack([flat, flat], axis=1)
    corner = flat + np.roll(flat, 1, axis=0)
    corner /= np.linalg.norm(corner, axis=1, keepdims=True)
    return np.stack([corner, np.roll(corner, -1, axis=0)], axis=1)


def _side_uv(
    prism: Prism, direction: Array, lengths: Array, vertices: Array, side_m: float
) -> Array:
    """Return texture coordinates of the sides' vertices. Flat sides take the position along them,
    so that a pattern runs on over adjoining solids; round ones the way around.
    """
    if prism.is_sheet:
        return np.tile([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]], (len(lengths), 1))
    start = np.cumsum(lengths) - lengths
    if not prism.smooth:
        start = (prism.footprint * direction).sum(axis=1)
    end = start + lengths
    u = np.stack([start, end, end, start], axis=1).ravel() / side_m
    return np.stack([u, -vertices[:, 2] / side_m], axis=1)


def _cap(prism: Prism, heights_m: Array, up: float, side_m: float) -> Mesh:
    vertices = np.column_stack([prism.footprint, heights_m])
    normal = np.cross(vertices[1] - vertices[0], vertices[2] - vertices[0])
    normal *= np.sign(normal[2]) * up / np.linalg.norm(normal)
    second = np.arange(1, len(vertices) - 1)
    fan = np.stack([np.zeros_like(second), second, second + 1], axis=1)
    uv = vertices[:, :2] * (1.0, -1.0) / side_m
    return Mesh(vertices, np.tile(normal, (len(vertices), 1)), uv, fan if up > 0 else fan[:, ::-1])
