"""Sub-pixel alignment of image patches.
 Corners and descriptors find *which* point a feature is; where it is to a tenth of a pixel or
better, the grey levels around it tell. A patch on the floor does not only shift between two
views, it is sheared and stretched too; so the fit has an affine part, and a gain and an offset
for brightness (Lucas and Kanade 1981; Baker and Matthews, Lucas-Kanade 20 Years On, 2004, for
the parametrised form).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array

HALF_PATCH_PX = 5
SIDE_PX = 2 * HALF_PATCH_PX + 1
STEPS = 4
AFFINE_SIGMA = 0.3
"""Prior standard deviation of the affine part, px per px; the floor under a low camera reaches
0.5.
"""

GREY_NOISE = 2.0
"""Standard deviation of a grey level that the camera alone explains; a lower residual is luck."""

MAX_SHIFT_PX = 2.0
MAX_LAST_STEP_PX = 0.1

Patches = NDArray[np.float32]


@dataclass(frozen=True)
class Alignment:
    """Where patches were found: uv_px (N, 2), sigma_px (N, 2), and whether the fit is sound
    (N,) bool.
    """

    uv_px: Array
    sigma_px: Array
    sound: NDArray[np.bool_]


def align_patches(
    template: Patches,
    image: NDArray[np.float32],
    start_uv_px: Array,
    zoom: Array,
    along_row: bool = False,
) -> Alignment:
    """Find where patches lie in an image, starting from a position that is right to a pixel or two.
     template: (N, SIDE_PX, SIDE_PX) grey levels. image: (H, W) float32. start_uv_px: (N, 2). zoom:
    (N,) how much larger the patch appears in the image than in the template. along_row: the match
    of a rectified pair, only u is unknown. A fit is sound when it stays near its start, has
    settled, and explains the patch better than a plain grey level.
    """
    x, y, window = _raster()
    pixels = template.reshape(len(template), -1)
    rows = 1 if along_row else 2
    shift = np.zeros(
        (len(template), rows, 3), np.float32
    )  # per row: offset, slope in x, slope in y
    shift[:, 0, 1] = zoom
    if not along_row:
        shift[:, 1, 2] = zoom
    undistorted = shift.copy()
    prior = np.zeros(3 * rows + 2, np.float32)
    prior[[k for k in range(3 * rows) if k % 3]] = AFFINE_SIGMA**-2
    start = start_uv_px.astype(np.float32)
    sound = np.ones(len(template), bool)
    basis = np.stack([np.ones_like(x), x, y])
    for _ in range(STEPS):
        warped = shift @ basis
        u = start[:, :1] + warped[:, 0]
        v = start[:, 1:] + (warped[:, 1] if rows == 2 else zoom[:, None].astype(np.float32) * y)
        value, slopes = _sample(image, u, v, rows)
        gain, offset = _brightness(value, pixels, window)
        residual = pixels - gain[:, None] * value - offset[:, None]
        noise = np.maximum((residual**2) @ (window / window.sum()), GREY_NOISE**2)
        J = np.empty((len(template), 3 * rows + 2, pixels.shape[1]), np.float32)
        for row, slope in enumerate(slopes):
            J[:, 3 * row : 3 * row + 3] = (gain[:, None] * slope)[:, None, :] * basis
        J[:, -2], J[:, -1] = value, 1.0
        weighted = J * (window / noise[:, None])[:, None, :]
        normal = weighted @ np.swapaxes(J, 1, 2)
        rhs = (weighted @ residual[..., None])[..., 0]
        rhs[:, : 3 * rows] -= prior[: 3 * rows] * (shift - undistorted).reshape(len(template), -1)
        covariance = np.linalg.inv(normal.astype(np.float64) + np.diag(prior + 1e-6))
        step = np.einsum('nab,nb->na', covariance, rhs)[:, : 3 * rows].reshape(shift.shape)
        shift += np.clip(step, -1.0, 1.0).astype(np.float32)
    offsets = shift[:, :, 0].astype(np.float64)
    variance = np.einsum('naa->na', covariance)[:, : 3 * rows : 3]
    explained = noise < 0.5 * _variance(pixels, window)
    sound = (
        (np.abs(offsets) < MAX_SHIFT_PX).all(axis=1)
        & (np.abs(step[:, :, 0]) < MAX_LAST_STEP_PX).all(axis=1)
        & explained
        & (variance > 0).all(axis=1)
    )
    uv = start_uv_px.astype(np.float64).copy()
    uv[:, :rows] += offsets
    sigma = np.zeros((len(template), 2))
    sigma[:, :rows] = np.sqrt(np.maximum(variance, 0.0))
    return Alignment(uv, sigma, sound)


def correlation_along_row(
    template: Patches, image: NDArray[np.float32], uv_px: Array, reach_px: int
) -> Array:
    """Return the zero-mean normalised cross-correlation (N, 2 reach + 1) of patches (N,
    SIDE_PX, SIDE_PX) with an image (H, W) at whole-pixel steps from -reach to reach along the
    row around positions (N, 2).
    """
    strip = sample_patches(image, uv_px, HALF_PATCH_PX + reach_px, HALF_PATCH_PX)
    template = template - template.mean(axis=(1, 2), keepdims=True)
    windows = np.lib.stride_tricks.sliding_window_view(strip, SIDE_PX, axis=2)
    total = windows.sum(axis=(1, 3))
    square = np.einsum('nhsw,nhsw->ns', windows, windows)
    product = np.einsum('nhw,nhsw->ns', template, windows)
    variance = np.maximum(square - total**2 / SIDE_PX**2, 1e-3)
    energy = np.maximum((template**2).sum(axis=(1, 2)), 1e-3)
    return product / np.sqrt(variance * energy[:, None])


def sample_patches(
    image: NDArray[np.float32],
    uv_px: Array,
    half_width: int = HALF_PATCH_PX,
    half_height: int = HALF_PATCH_PX,
) -> Patches:
    """Return the patches (N, 2 half_height + 1, 2 half_width + 1) around sub-pixel positions
    (N, 2).
    """
    du = np.arange(-half_width, half_width + 1, dtype=np.float32)
    dv = np.arange(-half_height, half_height + 1, dtype=np.float32)
    shape = (len(uv_px), len(dv), len(du))
    uv = uv_px.astype(np.float32)
    u = np.broadcast_to(uv[:, 0, None, None] + du, shape).reshape(len(uv), -1)
    v = np.broadcast_to(uv[:, 1, None, None] + dv[:, None], shape).reshape(len(uv), -1)
    return _remap(image, u, v).reshape(shape)


def _raster() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return x, y (P,) of a patch's pixels from its centre, and a Gaussian window (P,)."""
    steps = np.arange(-HALF_PATCH_PX, HALF_PATCH_PX + 1, dtype=np.float32)
    y, x = np.meshgrid(steps, steps, indexing='ij')
    window = np.exp(-0.5 * (x**2 + y**2) / (0.6 * HALF_PATCH_PX) ** 2)
    return x.ravel(), y.ravel(), window.ravel()


def _brightness(value: Patches, target: Patches, window: Patches) -> tuple[Patches, Patches]:
    """Return gain and offset (N,) that bring patches (N, P) nearest to their targets."""
    weight = window / window.sum()
    centred = value - (value @ weight)[:, None]
    gain = (centred * target) @ weight / np.maximum((centred**2) @ weight, 1e-3)
    return gain, target @ weight - gain * (value @ weight)


def _variance(patches: Patches, window: Patches) -> Patches:
    weight = window / window.sum()
    return (patches - (patches @ weight)[:, None]) ** 2 @ weight


def _sample(
    image: NDArray[np.float32], u: Patches, v: Patches, axes: int
) -> tuple[Patches, list[Patches]]:
    """Return grey values at (N, P) positions and their slopes along u and, with two axes,
    along v.
    """
    half = np.float32(0.5)
    slopes = [_remap(image, u + half, v) - _remap(image, u - half, v)]
    if axes == 2:
        slopes.append(_remap(image, u, v + half) - _remap(image, u, v - half))
    return _remap(image, u, v), slopes


def _remap(image: NDArray[np.float32], u: Patches, v: Patches) -> Patches:
    """Interpolate bilinearly at (N, P) positions; beyond the border its pixels repeat."""
    values = np.empty(u.shape, np.float32)
    limit = 30000  # cv2.remap takes fewer than 2^15 rows
    for start in range(0, len(u), limit):
        rows = slice(start, start + limit)
        values[rows] = cv2.remap(
            image,
            np.ascontiguousarray(u[rows]),
            np.ascontiguousarray(v[rows]),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
    return values
