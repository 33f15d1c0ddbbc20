"""What wheels and an accelerometer measure of keyframes, as part of a bundle adjustment.

With e = log(T_now T_before^-1 Z^-1) for a measured motion Z, twists of both poses change it, to
first order, by d_now - Ad(T_now T_before^-1) d_before (Barfoot 2017, section 8.3.2). With e = u x z
for up in the camera as its pose has it, u, and as it was measured, z, a turn d of the pose changes
it by (d x u) x z. The cost is Huber's: wheels that slip lie by much more than they are taken to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array, adjoint, invert, se3_log
from segfloor_ros.measurements import Up
from segfloor_ros.slam.map.records import KeyframeRecord
from segfloor_ros.slam.map.residuals import CHI2_95, huber_cost, huber_weights
from segfloor_ros.slam.mapping.normal_equations import System
from segfloor_ros.slam.sensors.body_motion import RelativeMotion

FLOOR_SIGMA = np.array([1e-3] * 3 + [1e-4] * 3)
"""No motion is measured better: the base shakes on its way."""


class Factor(Protocol):
    """Something measured of one or two keyframes, by their place in the problem."""

    @property
    def information(self) -> Array:
        """The inverse covariance (D, D) of the error."""

    def error(self, T_camera_world: Array) -> Array:
        """Return the error (D,) of poses (K, 4, 4)."""

    def jacobians(self, T_camera_world: Array) -> list[tuple[int, Array]]:
        """Return the keyframes, and the derivative (D, 6) of the error by the twist of each."""


@dataclass(frozen=True)
class Link:
    """The motion of the camera from keyframe `before` to keyframe `now`."""

    before: int
    now: int
    motion: RelativeMotion

    @property
    def information(self) -> Array:
        """The inverse covariance (6, 6) of the error."""
        return np.linalg.inv(self.motion.covariance + np.diag(FLOOR_SIGMA**2))

    def error(self, T_camera_world: Array) -> Array:
        """Return the twist (6,) by which poses (K, 4, 4) miss the measured motion."""
        moved = T_camera_world[self.now] @ invert(T_camera_world[self.before])
        return se3_log(moved @ invert(self.motion.T_now_before))

    def jacobians(self, T_camera_world: Array) -> list[tuple[int, Array]]:
        """Return the keyframes, and the derivative (6, 6) of the error by the twist of each."""
        moved = T_camera_world[self.now] @ invert(T_camera_world[self.before])
        return [(self.before, -adjoint(moved)), (self.now, np.eye(6))]


@dataclass(frozen=True)
class Level:
    """Up in the camera of a keyframe as it was measured, and up_world (3,), as it is in the
    world.
    """

    keyframe: int
    measured: Up
    up_world: Array

    @property
    def information(self) -> Array:
        """The inverse covariance (3, 3) of the error."""
        return np.eye(3) / self.measured.sigma_rad**2

    def error(self, T_camera_world: Array) -> Array:
        """Return the tilt (3,) in radians, about the axes of the camera."""
        up = T_camera_world[self.keyframe, :3, :3] @ self.up_world
        return np.cross(up, self.measured.direction)

    def jacobians(self, T_camera_world: Array) -> list[tuple[int, Array]]:
        """Return the keyframe, and the derivative (3, 6) of the error by its twist."""
        up = T_camera_world[self.keyframe, :3, :3] @ self.up_world
        measured = self.measured.direction
        by_turn = np.outer(up, measured) - float(up @ measured) * np.eye(3)
        return [(self.keyframe, np.hstack([np.zeros((3, 3)), by_turn]))]


def factors_of(
    keyframes: Sequence[KeyframeRecord], slot: NDArray[np.intp], up_world: Up | None
) -> tuple[Factor, ...]:
    """Return what is measured of the keyframes of a problem; slot: (K,) their place in it, -1 for
    others.
    """
    found: list[Factor] = []
    for k in np.flatnonzero(slot >= 0).tolist():
        motion, measured = keyframes[k].motion, keyframes[k].up
        if k > 0 and motion is not None and slot[k - 1] >= 0:
            found.append(Link(int(slot[k - 1]), int(slot[k]), motion))
        if measured is not None and up_world is not None:
            found.append(Level(int(slot[k]), measured, up_world.direction))
    return tuple(found)


def chi2(factor: Factor, T_camera_world: Array) -> float:
    """Return the squared, normalised error."""
    error = factor.error(T_camera_world)
    return float(error @ factor.information @ error)


def cost(factor: Factor, T_camera_world: Array) -> float:
    """Return the Huber cost of the error."""
    return huber_cost(np.array([chi2(factor, T_camera_world)]), np.array([CHI2_95[6]]))


def with_factors(system: System, T_camera_world: Array, factors: Sequence[Factor]) -> System:
    """Return normal equations with what is measured of keyframes, where those that move come
    first.
    """
    if not factors:
        return system
    U, rhs, between = system.U.copy(), system.camera_rhs.copy(), []
    for factor in factors:
        error = factor.error(T_camera_world)
        squared = np.array(chi2(factor, T_camera_world))
        weighted = factor.information * float(huber_weights(squared, np.array(CHI2_95[6])))
        terms = [(k, J) for k, J in factor.jacobians(T_camera_world) if k < len(U)]
        for k, J in terms:
            U[k] += J.T @ weighted @ J
            rhs[k] -= J.T @ weighted @ error
        if len(terms) == 2:
            (j, J_j), (k, J_k) = terms
            between.append((j, k, J_j.T @ weighted @ J_k))
    return replace(system, U=U, camera_rhs=rhs, between=tuple(between))
