"""Patches of an image: where they lie in another one, to a fraction of a pixel, and how well they
determine that.

Corners and descriptors find *which* point a feature is; where it is to a tenth of a pixel or
better, the grey levels around it determine. A patch on the floor does not only shift between two
views, it is sheared and stretched too; so the fit has an affine part, and a gain and an offset
for brightness (Lucas and Kanade 1981; Baker and Matthews, Lucas-Kanade 20 Years On, 2004, for
the parametrised form). A patch determines how far it shifted as well as its slopes allow against
the noise of the camera (the Cramer-Rao bound; Foerstner and Guelch 1987): an edge only across
itself, a plain face not at all. Patches that overlap hold the same pixels and err together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from segfloor_ros.camera.images import disparity_at
from segfloor_ros.geometry import Array
from segfloor_ros.slam.results import MAJORITY
from segfloor_ros.slam.rig import Observations
from segfloor_ros.slam.tracking.images import SIDE_PX, Images
from segfloor_ros.timing import timed

HALF_PATCH_PX = SIDE_PX // 2
STEPS = 4
"""Gauss-Newton steps; a start within reach converges in three."""

AFFINE_SIGMA = 0.3
"""Prior standard deviation of the affine part, px per px; the floor under a low camera reaches
0.5.
"""

GREY_NOISE = 2.0
"""Standard deviation of a grey level that the camera alone explains; a lower residual is luck, and
an image that varies by less shows nothing."""

ALIGNED_PX, MAX_SHIFT_STEP_PX = 2.0, 1.0
"""From so far away a patch is brought to where it lies, by no more than this in one step."""

MIN_SIGMA_PIXEL, MIN_SIGMA_DISPARITY = 0.15, 0.1
"""No patch is measured better: lenses, rectification and the shape of things are not perfect."""

MIN_CORRELATION = 0.7
"""Of the patches of one point in both images."""

Patches = NDArray[np.float32]

ALIASED = 0.3
"""Share of the slopes across an edge that its sampling in steps of pixels shows along it."""

CELLS, PER_CELL = 80, 3
"""Parts into which an image is divided, and points of each that count: neighbours err together."""

LEAST_SHIFT = 1e-4
"""Information in 1/px² of the shift of a pixel along an edge, or on a plain face."""


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
    of a rectified pair, where only u is unknown. Inverse compositional Gauss-Newton: slopes and
    normal equations come from the template, once. A fit is sound when it stays near its start, has
    settled, and explains the patch better than a plain grey level would.
    """
    if len(template) == 0:
        return Alignment(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.bool_))
    fit = _Fit(template, image, 1 if along_row else 2)
    A = zoom[:, None, None] * np.eye(2)
    offset = np.zeros((len(template), 2))
    prior = np.where(np.arange(3 * fit.axes) % 3 == 0, 0.0, AFFINE_SIGMA**-2)
    max_step = np.where(prior > 0, AFFINE_SIGMA, MAX_SHIFT_STEP_PX)
    step = np.zeros((len(template), 2, 3))
    deviation = np.zeros((len(template), fit.axes, 3))
    for iteration in range(STEPS):
        noise, rhs = fit.misfit(np.dstack([A, start_uv_px + offset]).astype(np.float32))
        level = np.maximum(noise, GREY_NOISE**2) * fit.weight.max()
        if iteration == 0:
            prior_level = level[:, None]
            inverse = np.linalg.inv(fit.H + prior_level[..., None] * np.diag(prior + 1e-9))
        deviation[:, :, 1:] = (A / zoom[:, None, None] - np.eye(2))[:, : fit.axes]
        rhs += prior_level * prior * deviation.reshape(rhs.shape)
        found = np.clip((inverse @ rhs[..., None])[..., 0], -max_step, max_step)
        step[:, : fit.axes] = found.reshape(len(found), fit.axes, 3)
        A = A @ _inverse_2x2(np.eye(2) + step[:, :, 1:])
        offset -= (A @ step[:, :, :1])[..., 0]
    variance = np.einsum('naa->na', inverse)[:, ::3] * level[:, None]
    sigma = np.zeros((len(template), 2))
    sigma[:, : fit.axes] = zoom[:, None] * np.sqrt(np.maximum(variance, 0.0))
    sound = (
        (np.abs(offset) < ALIGNED_PX).all(axis=1)
        & (np.abs(step[:, :, 0]) < MIN_SIGMA_DISPARITY).all(axis=1)
        & (noise < MAJORITY * fit.contrast)
    )
    return Alignment(start_uv_px + offset, sigma, sound)


class _Fit:
    """Sums of grey levels over patches (N, SIDE_PX, SIDE_PX), of which the image (H, W) and its
    brightness alone are new in each step: no array holds the derivatives of each pixel by each
    unknown. An unknown is the shift of a pixel along an axis, constant, or by its x or y.

    weight: (P,) Gaussian, of sum 1. contrast: (N,) variance of each patch. H: (N, 3 axes, 3 axes)
    normal matrices, freed of what a change of brightness could explain.
    """

    def __init__(self, template: Patches, image: NDArray[np.float32], axes: int) -> None:
        self.axes, self._image, count = axes, image, len(template)
        steps = np.arange(-HALF_PATCH_PX, HALF_PATCH_PX + 1, dtype=np.float32)
        y, x = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing='ij'))
        window = np.exp(-0.5 * (x**2 + y**2) / (0.6 * HALF_PATCH_PX) ** 2)
        self.weight = window / window.sum()
        self._xy1, basis = np.stack([x, y, np.ones_like(x)]), np.stack([np.ones_like(x), x, y])
        self._basis = np.ascontiguousarray((self.weight * basis).T)
        self._mean = (template.reshape(count, -1) @ self.weight)[:, None]
        slope_v, slope_u = np.gradient(template, axis=(1, 2))
        parts = [template - self._mean[..., None], slope_u, slope_v][: 1 + axes]
        self._parts = np.stack(parts, axis=1).reshape(count, 1 + axes, -1)
        self._products = self._parts[:, :1] * self._parts
        of_target = self._sums(self._products)
        self.contrast, self._of_target = of_target[:, 0, 0], of_target[:, 1:].reshape(count, -1)
        slopes = self._parts[:, 1:]
        self._of_slopes = self._sums(slopes).reshape(count, -1)
        squares = (self.weight * basis[:, None] * basis).reshape(9, -1).T
        pairs = (slopes[:, :, None] * slopes[:, None]).reshape(-1, len(self.weight)) @ squares
        H = pairs.reshape(count, axes, axes, 3, 3).swapaxes(2, 3).reshape(count, 3 * axes, -1)
        self.H = H - self._of_slopes[:, :, None] * self._of_slopes[:, None]

    def misfit(self, warp: Patches) -> tuple[Array, Array]:
        """Return the mean squared difference (N,) of the patches from the image where a warp (N, 2,
        3) = (shear, place) has them, at the gain and offset that fit best, and its slope (N, 3
        axes) by the unknowns, halved.
        """
        seen = _remap(self._image, warp[:, 0] @ self._xy1, warp[:, 1] @ self._xy1)
        seen -= self._mean
        sums = self._sums(np.multiply(seen[:, None], self._parts, out=self._products))
        mean = np.asarray(seen @ self.weight, np.float64)
        variance = np.maximum(np.square(seen, out=seen) @ self.weight - mean**2, 1e-3)
        shared = sums[:, 0, 0]
        gain = shared / variance
        slope = sums[:, 1:].reshape(len(gain), -1) - mean[:, None] * self._of_slopes
        return self.contrast - gain * shared, gain[:, None] * slope - self._of_target

    def _sums(self, values: Patches) -> Array:
        """Return weighted sums (N, A, 3) of values (N, A, P): plain, by x and by y."""
        sums = values.reshape(-1, len(self.weight)) @ self._basis
        return sums.reshape(len(values), -1, 3).astype(np.float64)


def _inverse_2x2(A: Array) -> Array:
    inverse = np.empty_like(A)
    inverse[:, 0, 0], inverse[:, 1, 1] = A[:, 1, 1], A[:, 0, 0]
    inverse[:, 0, 1], inverse[:, 1, 0] = -A[:, 0, 1], -A[:, 1, 0]
    determinant = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    return inverse / determinant[:, None, None]


def correlation_along_row(
    template: Patches, image: NDArray[np.float32], uv_px: Array, reach_px: int
) -> Array:
    """Return the zero-mean normalised cross-correlation (N, 2 reach + 1) of patches (N,
    SIDE_PX, SIDE_PX) with an image (H, W) at whole-pixel steps from -reach to reach along the
    row around positions (N, 2).
    """
    strip = sample_patches(image, uv_px, HALF_PATCH_PX + reach_px, HALF_PATCH_PX)
    flat = template.reshape(len(template), SIDE_PX**2)
    centred = flat - flat.mean(axis=1, keepdims=True)
    energy = np.maximum((centred**2).sum(axis=1), 1e-3)
    scores = np.empty((len(template), 2 * reach_px + 1))
    for shift in range(2 * reach_px + 1):
        window = strip[:, :, shift : shift + SIDE_PX].reshape(len(template), SIDE_PX**2)
        product = np.einsum('np,np->n', centred, window)
        variance = np.einsum('np,np->n', window, window) - window.sum(axis=1) ** 2 / SIDE_PX**2
        scores[:, shift] = product / np.sqrt(np.maximum(variance, 1e-3) * energy)
    return scores


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
    if len(uv_px) == 0:
        return np.zeros(shape, np.float32)
    uv = uv_px.astype(np.float32)
    u = np.broadcast_to(uv[:, 0, None, None] + du, shape).reshape(len(uv), -1)
    v = np.broadcast_to(uv[:, 1, None, None] + dv[:, None], shape).reshape(len(uv), -1)
    return _remap(image, u, v).reshape(shape)


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


@timed
def measure_disparity(
    images: Images,
    observations: Observations,
    rows: NDArray[np.intp],
    guess_px: Array,
    reach_px: int = 0,
) -> None:
    """Set, in place, the disparities of observations `rows` (N,) near a guess (N,); NaN where
    there is none within the reach. A depth camera needs no guess.
    """
    uv_px = observations.uvd_px[rows, :2]
    if images.depth_scale:
        disparity, sigma = disparity_at(images.right, images.depth_scale, uv_px)
    else:
        disparity, sigma = refine_disparity(images.left, images.right, uv_px, guess_px, reach_px)
    observations.uvd_px[rows, 2] = disparity
    observations.sigma_px[rows, 2] = np.clip(sigma, MIN_SIGMA_DISPARITY, None)


def refine_disparity(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    uv_px: Array,
    guess_px: Array,
    reach_px: int,
) -> tuple[Array, Array]:
    """Find the disparity of each feature within `reach_px` of a guess.

    left, right: rectified grey images (H, W) float32. uv_px: (N, 2) in the left image. guess_px:
    (N,). First the best whole-pixel shift by normalised correlation, then the affine alignment of
    the patch along the row. Returns disparity (N,) and its standard deviation (N,) in pixels, NaN
    where there is no clear peak inside the reach.
    """
    disparity: Array = np.full(len(uv_px), np.nan)
    sigma: Array = np.full(len(uv_px), np.nan)
    if len(uv_px) == 0:
        return disparity, sigma
    template = sample_patches(left, uv_px)
    uv_right = uv_px.astype(np.float64)
    uv_right[:, 0] -= guess_px
    rows = np.arange(len(uv_px))
    if reach_px > 0:
        score = correlation_along_row(template, right, uv_right, reach_px)
        peak = score.argmax(axis=1)
        inside = (peak > 0) & (peak < 2 * reach_px)
        rows = np.flatnonzero(inside & (score[rows, peak] >= MIN_CORRELATION))
        uv_right[rows, 0] += peak[rows] - reach_px
    found = align_patches(template[rows], right, uv_right[rows], np.ones(len(rows)), along_row=True)
    rows, found_u = rows[found.sound], found.uv_px[found.sound, 0]
    disparity[rows] = uv_px[rows, 0] - found_u
    sigma[rows] = found.sigma_px[found.sound, 0]
    return disparity, sigma


def count_firm(image: NDArray[Any], uv_px: Array) -> int:
    """Return how many pixels (N, 2) of a grey image (H, W) are on corners or in textures, whose
    patches determine their shift in both directions; of many in one part of the image some.
    """
    known, _ = _known_shift(image, uv_px)
    firm = uv_px[(known > 0).all(axis=1)]
    cell = (firm // np.sqrt(image.size / CELLS)).astype(np.intp)
    _, counts = np.unique(cell, axis=0, return_counts=True)
    return int(np.minimum(counts, PER_CELL).sum())


def with_patch_noise(image: NDArray[Any], observations: Observations) -> Observations:
    """Return observations (N) whose pixels have at least the noise that the patches of a grey image
    (H, W) around them allow: on an edge, that along it.
    """
    shift = _shift_information(image, observations.uvd_px[:, :2])
    variance = np.linalg.inv(shift + LEAST_SHIFT * np.eye(2))
    sigma = observations.sigma_px.copy()
    sigma[:, :2] = np.maximum(sigma[:, :2], np.sqrt(np.einsum('nii->ni', variance)))
    return replace(observations, sigma_px=sigma)


def _shift_information(image: NDArray[Any], uv_px: Array) -> Array:
    """Return the information (N, 2, 2) in 1/px² that patches around pixels (N, 2) give of their
    shift.
    """
    known, axes = _known_shift(image, uv_px)
    return np.asarray((axes * known[:, None]) @ np.swapaxes(axes, 1, 2), np.float64)


def _known_shift(image: NDArray[Any], uv_px: Array) -> tuple[Array, Array]:
    """Return what patches around pixels (N, 2) know of their shift along two axes, in 1/px² (N, 2),
    freed of what noise alone would show and shared by those that overlap, and the axes (N, 2, 2),
    one a column.
    """
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    height, width = image.shape
    columns, rows = np.rint(uv_px).astype(np.intp).T
    steps = np.arange(-HALF_PATCH_PX - 1, HALF_PATCH_PX + 2)
    patches = smooth[
        np.clip(rows[:, None, None] + steps[:, None], 0, height - 1),
        np.clip(columns[:, None, None] + steps, 0, width - 1),
    ].astype(np.float32)
    by_u = (patches[:, 1:-1, 2:] - patches[:, 1:-1, :-2]) / 2
    by_v = (patches[:, 2:, 1:-1] - patches[:, :-2, 1:-1]) / 2
    slopes = np.stack([by_u, by_v], axis=1).reshape(len(uv_px), 2, SIDE_PX**2)
    energy, axes = np.linalg.eigh(slopes @ np.swapaxes(slopes, 1, 2))
    # The mean square of a slope of white noise of unit variance, smoothed by one pixel.
    of_noise = GREY_NOISE**2 * SIDE_PX**2 / (8 * np.pi)
    apparent = 2 * of_noise + ALIASED * energy[:, 1:]
    known = np.maximum(energy - apparent, 0.0) / GREY_NOISE**2
    known /= 1 + MIN_SIGMA_PIXEL**2 * known
    if len(uv_px):
        tree = cKDTree(uv_px)
        crowd = tree.query_ball_point(uv_px, HALF_PATCH_PX, return_length=True)
        known /= np.asarray(crowd)[:, None]
    return known, axes
