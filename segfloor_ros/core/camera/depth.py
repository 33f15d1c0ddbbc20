"""Depth images as disparities: a depth camera is taken for a stereo pair whose right image is not
there, but whose disparities are.

Where a stereo frame has a right image, that of a depth camera has the disparity (H, W) float32 in
pixels over a virtual baseline, not a number where nothing was measured. Active stereo and
structured light measure disparities, too: their noise is about constant in this form.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.pixels import Disparity
from segfloor_ros.core.errors import InputError

VIRTUAL_BASELINE_M = 0.075
"""Between projector and camera of the first depth cameras; any value would do."""


def depth_calibration(left: EyeCalibration) -> StereoCalibration:
    """Return the calibration of a depth camera whose depths are aligned with the raw left image: it
    is freed of its distortion, but not turned.
    """
    P = np.hstack([left.K, np.zeros((3, 1))])
    shift = np.array([[-left.K[0, 0] * VIRTUAL_BASELINE_M], [0.0], [0.0]])
    straight = dataclasses.replace(left, R=np.eye(3), P=P)
    virtual = dataclasses.replace(straight, P=np.hstack([left.K, shift])).rectified()
    return StereoCalibration(straight, virtual)


def disparity_of_depth(
    depth: NDArray[np.generic], camera: StereoCamera, metres_per_unit: float | None = None
) -> Disparity:
    """Return the disparity (H, W) of a depth image (H, W): uint16, in mm unless said otherwise, or
    float32 in metres. What is 0, negative or not finite has none. Raises InputError.
    """
    if depth.dtype == np.uint16:
        metres = depth.astype(np.float32) * np.float32(metres_per_unit or 1e-3)
    elif depth.dtype == np.float32:
        metres = depth.astype(np.float32) * np.float32(metres_per_unit or 1.0)
    else:
        raise InputError(f'depth images have 16 bits (mm) or are float (m), not {depth.dtype}')
    with np.errstate(divide='ignore', invalid='ignore'):
        disparity = np.float32(camera.disparity_times_depth) / metres
    return np.where(np.isfinite(metres) & (metres > 0), disparity, np.float32(np.nan))
