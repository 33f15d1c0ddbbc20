"""The rectified stereo camera: a pair of pinholes, and the error that its disparities may share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.errors import CalibrationError
from segfloor_ros.core.geometry import Array

BASELINES_M = 0.002, 10.0
"""No robot's eyes are nearer to each other or farther apart; lengths in another unit are."""


@dataclass(frozen=True)
class StereoCamera:
    """A rectified stereo pair: two pinholes with equal intrinsics, the right one `baseline_m`
    along the left's x. Pixels are (u, v) = (column, row), the centre of the top-left pixel is
    (0, 0). Depth is Z = fx * baseline / d for the disparity d = u_left - u_right > 0. Raises
    CalibrationError for impossible values.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    baseline_m: float

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy, self.baseline_m)
        if not np.isfinite(values).all():
            raise CalibrationError(f'calibration has values that are not finite: {values}')
        if self.fx <= 0 or self.fy <= 0:
            raise CalibrationError(
                f'focal length fx = {self.fx:g}, fy = {self.fy:g} px: '
                'the camera is not calibrated (K[0] = 0)'
            )
        if self.baseline_m <= 0:
            raise CalibrationError(
                f'baseline is {self.baseline_m:g} m, it must be positive: '
                'are left and right swapped, or is P[3] of the right camera missing?'
            )
        if not BASELINES_M[0] <= self.baseline_m <= BASELINES_M[1]:
            raise CalibrationError(
                f'baseline is {self.baseline_m:g} m; are lengths in millimetres, or divided twice? '
                'They must be in metres: P[3] of the right camera is -fx times the baseline'
            )
        if self.width <= 0 or self.height <= 0:
            raise CalibrationError(f'image size {self.width}x{self.height} is impossible')

    @property
    def K(self) -> Array:
        """The (3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def disparity_times_depth(self) -> float:
        """fx * baseline in pixel metres: disparity = this / depth."""
        return self.fx * self.baseline_m

    def project(self, points: Array) -> Array:
        """Project points (N, 3) of the left optical frame to (N, 3) = (u, v, u_right) in pixels.

        Points must lie in front of the camera (z > 0).
        """
        inverse_z = 1.0 / points[:, 2]
        u = self.fx * points[:, 0] * inverse_z + self.cx
        v = self.fy * points[:, 1] * inverse_z + self.cy
        return np.stack([u, v, u - self.disparity_times_depth * inverse_z], axis=1)

    def back_project(self, uv_px: NDArray[np.floating], depth_m: NDArray[np.floating]) -> Array:
        """Return the points (N, 3) of the left optical frame at pixels (N, 2) and depths (N,) in
        metres.
        """
        uv = np.asarray(uv_px, np.float64)
        z = np.asarray(depth_m, np.float64)
        return np.stack(
            [(uv[:, 0] - self.cx) * z / self.fx, (uv[:, 1] - self.cy) * z / self.fy, z], axis=1
        )


def is_disparity(image: NDArray[np.generic]) -> bool:
    """Whether what stands in place of a right image is a disparity."""
    return image.dtype == np.float32


OFFSET_SIGMA_PX = 0.1
"""Error that all disparities share, expected of a rig: a tenth of a milliradian between its eyes at
a focal length of a thousand pixels."""

MAX_OFFSET_PX = 0.5
"""An error of all disparities that is larger is not an imperfect rectification but a wrong
calibration, px."""
