"""Motions between keyframes that wheels measured, as part of a bundle adjustment.

With e = log(T_now T_before^-1 Z^-1) for the measured Z, twists of both poses change it, to first
order, by d_now - Ad(T_now T_before^-1) d_before (Barfoot 2017, section 8.3.2). The cost is Huber's:
wheels that slip lie by much more than they are taken to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from segfloor_ros.geometry import Array, adjoint, invert, se3_log
from segfloor_ros.slam.body_motion import RelativeMotion
from segfloor_ros.slam.normal_equations import System

CHI2_95 = 12.59
"""The 95 % quantile of the chi-squared distribution with six degrees of freedom."""

FLOOR_SIGMA = np.array([1e-3] * 3 + [5e-4] * 3)
"""No motion is measured better: the base shakes on its way."""


@dataclass(frozen=True)
class Link:
    """The motion of the camera from keyframe `before` to keyframe `now`, by their place in the
    problem.
    """

    before: int
    now: int
    motion: RelativeMotion

    def error(self, T_camera_world: Array) -> Array:
        """Return the twist (6,) by which poses (K, 4, 4) miss the measured motion."""
        moved = T_camera_world[self.now] @ invert(T_camera_world[self.before])
        return se3_log(moved @ invert(self.motion.T_now_before))

    @property
    def information(self) -> Array:
        """The inverse covariance (6, 6) of the error."""
        return np.linalg.inv(self.motion.covariance + np.diag(FLOOR_SIGMA**2))

    def chi2(self, T_camera_world: Array) -> float:
        """Return the squared, normalised error."""
        error = self.error(T_camera_world)
        return float(error @ self.information @ error)

    def cost(self, T_camera_world: Array) -> float:
        """Return the Huber cost of the error."""
        chi2 = self.chi2(T_camera_world)
        return chi2 if chi2 <= CHI2_95 else 2 * float(np.sqrt(CHI2_95 * chi2)) - CHI2_95


def with_links(system: System, T_camera_world: Array, links: Sequence[Link]) -> System:
    """Return normal equations in which measured motions tie keyframes, where those that move come
    first.
    """
    if not links:
        return system
    U, rhs, between = system.U.copy(), system.camera_rhs.copy(), []
    for link in links:
        error, information = link.error(T_camera_world), link.information
        chi2 = float(error @ information @ error)
        weighted = information * min(1.0, float(np.sqrt(CHI2_95 / max(chi2, 1e-12))))
        A = -adjoint(T_camera_world[link.now] @ invert(T_camera_world[link.before]))
        for k, J in ((link.now, np.eye(6)), (link.before, A)):
            if k < len(U):
                U[k] += J.T @ weighted @ J
                rhs[k] -= J.T @ weighted @ error
        if max(link.now, link.before) < len(U):
            between.append((link.before, link.now, A.T @ weighted))
    return replace(system, U=U, camera_rhs=rhs, between=tuple(between))
