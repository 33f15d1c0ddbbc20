"""A base that stays on one level plane, as prior knowledge of bundle adjustments and pose graphs.

Errors are the base's height above the plane and the components of the plane's normal across the
base; a body twist (rho, phi) changes them by R_3 rho, and by n x phi.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from segfloor_ros.geometry import Array, adjoint, invert
from segfloor_ros.slam.mapping.normal_equations import System

SIGMA_M = 0.01
SIGMA_RAD = 0.005
"""A base on wheels rises and tilts by about so much on a level floor."""

SIGMA = np.array([SIGMA_M, SIGMA_RAD, SIGMA_RAD])


@dataclass(frozen=True)
class LevelGround:
    """T_base_left: (4, 4) of the camera on the base; the plane is that of the base at the first
    camera pose.
    """

    T_base_left: Array

    def errors(self, T_camera_world: Array) -> tuple[Array, Array]:
        """Return the errors (K, 3) of cameras (K, 4, 4) in units of their sigma, and what twists of
        the cameras change them by, (K, 3, 6).
        """
        T_left_base = invert(self.T_base_left)
        T_map_base = self.T_base_left @ invert(T_camera_world) @ T_left_base
        normal = T_map_base[:, 2, :3]
        error = np.column_stack([T_map_base[:, 2, 3], normal[:, :2]])
        x, y, z = normal.T
        J = np.zeros((len(error), 3, 6))
        J[:, 0, :3] = normal
        J[:, 1, 4], J[:, 1, 5] = -z, y
        J[:, 2, 3], J[:, 2, 5] = z, -x
        # A twist of the camera is the opposite one of its pose in the world.
        return error / SIGMA, -(J @ adjoint(self.T_base_left)) / SIGMA[:, None]

    def cost(self, T_camera_world: Array) -> float:
        """Return the sum of the squared errors."""
        return float((self.errors(T_camera_world)[0] ** 2).sum())

    def added_to(self, system: System, T_camera_world: Array) -> System:
        """Return normal equations of cameras (K, 4, 4), those that move first, with the errors."""
        error, J = self.errors(T_camera_world[: len(system.U)])
        return replace(
            system,
            U=system.U + np.swapaxes(J, 1, 2) @ J,
            camera_rhs=system.camera_rhs - np.einsum('kab,ka->kb', J, error),
        )
