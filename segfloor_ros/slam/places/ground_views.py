"""The floor before the robot as seen from above: the same from every direction.

A corridor driven back shows other sides of things, but the same floor. The image is projected onto
the floor (inverse perspective mapping: Mallot et al., Biol. Cybern. 1991), with corners described
where it is sharp; two views of the same floor differ by a motion in the plane, found by RANSAC.
Floor that looks the same in many places, such as tiles, gives several motions: then none is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.geometry import Array, invert, make_transform
from segfloor_ros.slam.results import ENOUGH, MAJORITY
from segfloor_ros.slam.rig import Rig

CELL, REACH = 0.025, 4.5
"""Side of a pixel of the view, and how far ahead of the camera it reaches, in units of the camera's
height: farther away a pixel of the image covers several of the view, along the ray."""

CORNERS = 300
SAME_CELLS = 4.0
"""Corners of two views closer than this, in pixels of the view, are one."""

DRAWS = 300
"""Pairs of corners that are tried; of 60 in 100 right ones one draw in three is."""


@dataclass(frozen=True)
class GroundView:
    """Corners of the floor: xy_m (N, 2) on it in the base frame, descriptor (N, 32) uint8."""

    xy_m: NDArray[np.float32]
    descriptor: NDArray[np.uint8]


NOTHING = GroundView(np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8))


class GroundViews:
    """Takes views of the floor with the camera of a rig."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._mount: Mount | None = None
        self._orb = cv2.ORB.create(CORNERS, nlevels=1, fastThreshold=5)
        self._contrast = cv2.createCLAHE(3.0, (4, 4))

    def take(self, left: NDArray[np.uint8]) -> GroundView:
        """Return what a rectified left image (H, W) shows of the floor; nothing while it is not
        known how the camera is mounted.
        """
        if self._rig.mount is None:
            return NOTHING
        if self._mount != self._rig.mount:
            self._mount = self._rig.mount
            self._corner_xy_m, self._maps, self._inside = _projection(self._rig.camera, self._mount)
        view = self._contrast.apply(cv2.remap(left, *self._maps, cv2.INTER_LINEAR))
        corners, descriptor = self._orb.detectAndCompute(view, self._inside)
        if not corners:
            return NOTHING
        column, row = cv2.KeyPoint_convert(corners).T
        cell_m = CELL * self._mount.height_m
        xy_m = self._corner_xy_m + cell_m * np.stack([row, column], axis=1)
        return GroundView(xy_m.astype(np.float32), np.asarray(descriptor, np.uint8))


def _projection(
    camera: StereoCamera, mount: Mount
) -> tuple[Array, tuple[NDArray[np.float32], NDArray[np.float32]], NDArray[np.uint8]]:
    """Return where on the floor pixel (0, 0) of the view lies, the pixels (u, v) of the image that
    its pixels show, x along rows and y along columns, and where there are such.
    """
    h = mount.height_m
    steps = np.arange(0.0, REACH, CELL)
    x, y = np.meshgrid(
        mount.forward_m + h * steps, mount.left_m + h * (steps - REACH / 2), indexing='ij'
    )
    floor = np.stack([x, y, np.zeros_like(x), np.ones_like(x)], axis=-1)
    points = floor @ invert(mount.T_base_left)[:3].T
    uvw = points @ camera.K.T
    ahead = points[..., 2] > CELL * h
    depth_m = np.where(ahead, points[..., 2], np.inf)
    u, v = ((uvw[..., k] / depth_m).astype(np.float32) for k in (0, 1))
    inside = ahead & (u > 1) & (u < camera.width - 2) & (v > 1) & (v < camera.height - 2)
    inside = cv2.erode(inside.astype(np.uint8), np.ones((9, 9), np.uint8))
    return np.array([x[0, 0], y[0, 0]]), (u, v), inside


def seen_ahead_m(mount: Mount) -> float:
    """Return how far ahead of the base the middle of its view of the floor lies."""
    return mount.forward_m + REACH / 2 * mount.height_m


def motion_between(view: GroundView, other: GroundView, height_m: float) -> Array | None:
    """Return T_base_other (4, 4), where the base stood at another view of the same floor; None
    where too little is the same, or another motion fits as well.
    """
    if min(len(view.xy_m), len(other.xy_m)) < ENOUGH:
        return None
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(
        other.descriptor, view.descriptor
    )
    rows = np.array([(m.queryIdx, m.trainIdx) for m in matches], np.intp).reshape(-1, 2)
    if len(rows) < ENOUGH:
        return None
    # Complex numbers are motions in the plane: q = turn * p + shift.
    p, q = (xy @ (1.0, 1j) for xy in (other.xy_m[rows[:, 0]], view.xy_m[rows[:, 1]]))
    tolerance_m = SAME_CELLS * CELL * height_m
    draws = np.random.default_rng(0).integers(len(p), size=(DRAWS, 2))
    of_p, of_q = np.diff(p[draws])[:, 0], np.diff(q[draws])[:, 0]
    alike = (np.abs(np.abs(of_p) - np.abs(of_q)) < tolerance_m) & (np.abs(of_p) > 2 * tolerance_m)
    draws, turn = draws[alike], of_q[alike] / of_p[alike]
    turn /= np.abs(turn)
    shift = q[draws[:, 0]] - turn * p[draws[:, 0]]
    fits = np.abs(turn[:, None] * p + shift[:, None] - q) < tolerance_m
    count = fits.sum(axis=1)
    best = int(count.argmax()) if len(count) else 0
    if len(count) == 0 or count[best] < ENOUGH:
        return None
    middle = p[fits[best]].mean()
    elsewhere = np.abs((turn - turn[best]) * middle + shift - shift[best]) > 2 * tolerance_m
    if (count[elsewhere] > MAJORITY * count[best]).any():
        return None
    p, q = p[fits[best]], q[fits[best]]
    turn_by = ((q - q.mean()) * (p - p.mean()).conj()).sum()
    turn_by /= np.abs(turn_by)
    shift_by = q.mean() - turn_by * p.mean()
    c, s = turn_by.real, turn_by.imag
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return make_transform(R, np.array([shift_by.real, shift_by.imag, 0.0]))
