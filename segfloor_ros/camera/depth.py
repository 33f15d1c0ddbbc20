"""Depth images as disparities: a depth camera is taken for a stereo pair whose right image is not
there, but whose disparities are.

Where a stereo frame has a right image, that of a depth camera has the disparity (H, W) float32 in
pixels over a virtual baseline, not a number where nothing was measured. Active stereo and
structured light measure disparities, too: their noise is about constant in this form.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.calibration.parameters import EyeCalibration, StereoCalibration
from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.errors import InputError
from segfloor_ros.geometry import Array

VIRTUAL_BASELINE_M = 0.075
"""Between projector and camera of the first depth cameras; any value would do."""

SIGMA_PER_M = 0.0025
"""Error of a depth, in metres per square metre (Khoshelham and Elberink, Accuracy and resolution of
Kinect depth data, Sensors 2012: 0.0014 to 0.0029)."""

SIGMA_M = 0.002
"""Error of any depth: steps of a millimetre, and a registration that is not perfect."""

SAME_SURFACE_SHARE = 0.05
"""Depths around a pixel that differ by more are those of two surfaces."""

Disparity = NDArray[np.float32]

SHRUNK_WIDTH_PX = 240


def is_disparity(image: NDArray[np.generic]) -> bool:
    """Whether what stands in place of a right image is a disparity."""
    return image.dtype == np.float32


def depth_calibration(left: EyeCalibration) -> StereoCalibration:
    """Return the calibration of a depth camera whose depths are aligned with the raw left image: it
    is freed of its distortion, but not turned.
    """
    P = np.hstack([left.K, np.zeros((3, 1))])
    shift = np.array([[-left.K[0, 0] * VIRTUAL_BASELINE_M], [0.0], [0.0]])
    straight = dataclasses.replace(left, R=np.eye(3), P=P)
    virtual = EyeCalibration.of_rectified(
        left.width, left.height, np.hstack([left.K, shift]), left.origin
    )
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


def disparity_at(disparity: Disparity, camera_depth: float, uv_px: Array) -> tuple[Array, Array]:
    """Return the disparity (N,) at pixels (N, 2), the median of the neighbours, and its standard
    deviation (N,); NaN at holes and where two surfaces meet. camera_depth: disparity times depth.
    """
    height, width = disparity.shape
    columns, rows = np.rint(uv_px).astype(np.intp).T
    steps = np.array([-1, 0, 1])
    around = disparity[
        np.clip(rows[:, None, None] + steps[:, None], 0, height - 1),
        np.clip(columns[:, None, None] + steps, 0, width - 1),
    ].reshape(len(uv_px), 9)
    found = np.full(len(uv_px), np.nan)
    whole = np.isfinite(around).sum(axis=1) >= 6
    near = around[whole].astype(np.float64)
    middle = np.nanmedian(near, axis=1) if len(near) else np.zeros(0)
    spread = np.nanmax(near, axis=1) - np.nanmin(near, axis=1) if len(near) else np.zeros(0)
    found[whole] = np.where(spread < SAME_SURFACE_SHARE * middle, middle, np.nan)
    return found, measured_sigma_px(camera_depth, found)


def measured_sigma_px(camera_depth: float, disparity_px: Array) -> Array:
    """Return the error (N,), one sigma, of the disparities (N,) of a depth camera. camera_depth:
    disparity times depth.
    """
    sigma: Array = np.hypot(camera_depth * SIGMA_PER_M, SIGMA_M * disparity_px**2 / camera_depth)
    return sigma


def shrunk(disparity: Disparity, size: tuple[int, int]) -> Disparity:
    """Return the disparity of an image shrunk to `size` (width, height), in its own pixels, 0 where
    there is none.
    """
    factor = size[0] / disparity.shape[1]
    small = cv2.resize(disparity, size, interpolation=cv2.INTER_NEAREST)
    return np.nan_to_num(small * np.float32(factor), nan=0.0).astype(np.float32)


def shrunk_disparity(disparity: Disparity, factor: int) -> Disparity:
    """Return the disparity at (H // factor, W // factor) in the pixels of the shrunk image."""
    height, width = disparity.shape[0] // factor, disparity.shape[1] // factor
    half = factor // 2
    part = disparity[half::factor, half::factor][:height, :width]
    return np.ascontiguousarray(part / np.float32(factor))


def seen_from_right(left: NDArray[np.uint8], disparity: Disparity) -> NDArray[np.uint8]:
    """Return the right image (H, W) as the virtual right camera would see it: what is nearer hides
    what is farther; what no depth is known of is as in the left image.
    """
    right = left.copy()
    rows, columns = np.nonzero(np.isfinite(disparity))
    shift = disparity[rows, columns]
    order = np.argsort(shift, kind='stable')
    rows, columns = rows[order], columns[order]
    target = np.rint(columns - shift[order]).astype(np.intp)
    inside = target >= 0
    right[rows[inside], target[inside]] = left[rows[inside], columns[inside]]
    return right


def shrink_factor(camera: StereoCamera) -> int:
    """Return by how much images of a camera are shrunk, at least 1."""
    return max(1, round(camera.width / SHRUNK_WIDTH_PX))


def shrunk_image(image: NDArray[Any], factor: int) -> NDArray[Any]:
    """Return an image (H, W) at (H // factor, W // factor), each pixel the mean of a square; of a
    disparity, float32, one of its pixels.
    """
    if is_disparity(image):
        return shrunk_disparity(image, factor)
    height, width = image.shape[0] // factor, image.shape[1] // factor
    whole = image[: height * factor, : width * factor]
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)


def shrunk_camera(camera: StereoCamera, factor: int) -> StereoCamera:
    """Return the camera of shrunk images. Pixel centres are at whole numbers, so the principal
    point moves by half a pixel less than the size.
    """
    return StereoCamera(
        camera.width // factor,
        camera.height // factor,
        camera.fx / factor,
        camera.fy / factor,
        (camera.cx + 0.5) / factor - 0.5,
        (camera.cy + 0.5) / factor - 0.5,
        camera.baseline_m,
    )
