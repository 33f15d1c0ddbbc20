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

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.pixels import SUBPIXEL, disparity_at
from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.slam.rig import MAX_DISPARITY_SHARE, SAME_PX, Observations
from segfloor_ros.core.slam.tracking.images import BLUR_PX, SIDE_PX, SMALL_WIDTH_PX, Images
from segfloor_ros.core.timing import timed

HALF_PATCH_PX = SIDE_PX // 2
STEPS, SETTLED_PX = 4, 0.02
"""Gauss-Newton steps, and the length of one after which the next would change nothing."""

AFFINE_SIGMA = 0.3
"""Prior deviation of the affine part, px per px; the floor under a low camera reaches 0.5."""

GREY_NOISE = 2.0
"""Standard deviation of a grey level that the camera alone explains; a lower residual is luck, and
an image that varies by less shows nothing."""

ALIGNED_PX = 2.0
"""From so far away a patch is brought to where it lies, by no more than half of it in one step."""

MIN_SIGMA_PIXEL, MIN_SIGMA_DISPARITY = 0.15, 0.1
"""No patch is measured better: lenses, rectification and the shape of things are not perfect."""

MIN_TEXTURE = 5
"""Of a block that is matched roughly, in units of OpenCV."""

MAX_STEP = np.array([ALIGNED_PX / 2, AFFINE_SIGMA, AFFINE_SIGMA])[:, None]

Patches = NDArray[np.float32]

ALIASED = 0.1
"""Share of the slopes across an edge that its sampling in steps of pixels shows along it."""

LEAST_ENERGY = 3e-5
"""Mean square of a slope, in grey levels squared: of an edge, along it; of a plain face."""


def _sums_of_a_patch() -> tuple[Patches, Patches, Patches, Patches]:
    """Return of the pixels (P,) of a patch: where they are, (3, P), their weights, of sum 1, and
    these times 1, x and y, (P, 3), and times the products of two of them, (P, 9).
    """
    steps_px = np.arange(-HALF_PATCH_PX, HALF_PATCH_PX + 1, dtype=np.float32)
    y, x = (grid.ravel() for grid in np.meshgrid(steps_px, steps_px, indexing='ij'))
    xy1 = np.stack([x, y, np.ones_like(x)])
    gaussian = np.exp(-0.5 * (x**2 + y**2) / (0.6 * HALF_PATCH_PX) ** 2)
    window = gaussian / gaussian.sum()
    basis = np.ascontiguousarray(window[:, None] * xy1[[2, 0, 1]].T)
    return xy1, window, basis, (basis[:, :, None] * xy1[[2, 0, 1]].T[:, None]).reshape(-1, 9)


XY1, WINDOW, BASIS, SQUARES = _sums_of_a_patch()


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
    normal equations come from the template, once; a patch that has settled takes no further steps.
    A fit is sound when it stays near its start, has settled, and explains the patch better than a
    plain grey level would.
    """
    count, axes = len(template), 1 if along_row else 2
    if count == 0:
        return Alignment(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.bool_))
    fit = _Fit.of(template, axes)
    contrast, of_level = fit.contrast, float(WINDOW.max())
    known = known_shift(fit.H[::3, ::3])
    warp: Array = np.zeros((2, 3, count))
    warp[0, 0] = warp[1, 1] = zoom
    warp[:, 2] = start_uv_px.T
    noise, last = np.zeros(count), np.zeros((axes, count))
    moving = np.arange(count)
    for iteration in range(STEPS):
        W = warp[:, :, moving]
        noise[moving], rhs = fit.misfit(image, W)
        if iteration == 0:
            prior = np.maximum(noise, GREY_NOISE**2) * of_level
            H = fit.H
            for unknown in range(3 * axes):
                H[unknown, unknown] += prior * (AFFINE_SIGMA**-2 if unknown % 3 else 1e-9)
            inverse = _inverse(H)
        shear = W[:axes, :2] / zoom[moving]
        for axis in range(axes):
            shear[axis, axis] -= 1.0
        rhs[:, 1:] += (AFFINE_SIGMA**-2 * prior[moving]) * shear
        step = np.einsum('abn,bn->an', inverse[:, :, moving], rhs.reshape(3 * axes, -1))
        step = np.clip(step.reshape(rhs.shape), -MAX_STEP, MAX_STEP)
        warp[:, :, moving] = _stepped(W, step)
        last[:, moving] = step[:, 0]
        still = np.abs(step[:, 0]).max(axis=0) > SETTLED_PX
        if not still.any():
            break
        fit, moving = fit.take(still), moving[still]
    level = np.maximum(noise, GREY_NOISE**2) * of_level
    sigma: Array = np.zeros((2, count))
    variance = np.maximum(np.einsum('aan->an', inverse)[::3], known) * level
    sigma[:axes] = zoom * np.sqrt(np.maximum(variance, 0.0))
    offset = warp[:, 2] - start_uv_px.T
    # Smoothed noise alone is explained by a half now and then.
    sound = (np.abs(offset) < ALIGNED_PX).all(axis=0) & (noise < contrast / 4)
    sound &= (np.abs(last) < MIN_SIGMA_DISPARITY).all(axis=0)
    return Alignment(start_uv_px + offset.T, sigma.T, sound)


def known_shift(energy: Array) -> Array:
    """Return the variances (axes, N) of the shift of patches of unit noise, by the mean products
    (axes, axes, N) of their slopes, freed of what noise and the sampling of an edge show of slopes
    that are none.
    """
    noise = GREY_NOISE**2 / (8 * math.pi * BLUR_PX**4)
    if len(energy) == 1:
        return np.asarray(1 / np.maximum(energy[0] - noise, LEAST_ENERGY))
    (a, b), (_, c) = energy
    middle, half = (a + c) / 2, np.sqrt(((a - c) / 2) ** 2 + b**2)
    apparent = noise + ALIASED * (middle + half)
    a, c = a - apparent, c - apparent
    # A negative eigenvalue becomes none: of a straight edge, the one along it.
    middle = middle - apparent
    largest = np.maximum(middle + half, LEAST_ENERGY)
    smallest = np.maximum(middle - half, LEAST_ENERGY)
    share = np.clip((a - (middle - half)) / np.maximum(2 * half, 1e-12), 0.0, 1.0)
    across, along = 1 / largest, 1 / smallest
    return np.stack([share * across + (1 - share) * along, (1 - share) * across + share * along])


@dataclass(frozen=True)
class _Fit:
    """Sums of grey levels over patches, of which the image and its brightness alone are new in each
    step: no array holds the derivatives of each pixel by each unknown. An unknown is the shift of a
    pixel along an axis, constant, or by its x or y.

    mean: (N,) of the patches. parts: (1 + axes, N, P) how their pixels differ from it, and how they
    change along each axis. contrast: (N,) variance of each patch. of_slopes, of_target: (axes, 3,
    N) sums of the latter, and of their products with the first. H: (3 axes, 3 axes, N) normal
    matrices, freed of what a change of brightness could explain.
    """

    mean: Patches
    parts: Patches
    contrast: Array
    of_slopes: Array
    of_target: Array
    H: Array

    @staticmethod
    def of(template: Patches, axes: int) -> _Fit:
        """Return them for patches (N, SIDE_PX, SIDE_PX) of which some axes are unknown."""
        count = len(template)
        parts = np.empty((1 + axes, count, SIDE_PX**2), np.float32)
        flat = template.reshape(count, -1)
        mean = flat @ WINDOW
        np.subtract(flat, mean[:, None], out=parts[0])
        for axis in range(axes):
            _slope(template, axis, parts[1 + axis].reshape(template.shape))
        of_slopes = _sums(parts[1:], BASIS)
        of_target = _sums(parts[0] * parts, BASIS)
        pairs = [(j, k) for j in range(axes) for k in range(j, axes)]
        H: Array = np.empty((axes, 3, axes, 3, count))
        products = np.stack([parts[1 + j] * parts[1 + k] for j, k in pairs])
        for (j, k), sums in zip(pairs, _sums(products, SQUARES), strict=True):
            H[j, :, k] = H[k, :, j] = sums.reshape(3, 3, count)
        H -= of_slopes[:, :, None, None] * of_slopes
        H = H.reshape(3 * axes, 3 * axes, count)
        return _Fit(mean, parts, of_target[0, 0], of_slopes, of_target[1:], H)

    def take(self, rows: NDArray[np.bool_]) -> _Fit:
        """Return the chosen patches, for further steps."""
        return replace(
            self,
            mean=self.mean[rows],
            parts=self.parts[:, rows],
            contrast=self.contrast[rows],
            of_slopes=self.of_slopes[..., rows],
            of_target=self.of_target[..., rows],
        )

    def misfit(self, image: NDArray[np.float32], warp: Array) -> tuple[Array, Array]:
        """Return the mean squared difference (N,) of the patches from an image (H, W) where a warp
        (2, 3, N) = (shear, place) has them, at the gain and offset that fit best, and its slope
        (axes, 3, N) by the unknowns, halved.
        """
        u, v = (axis.T.astype(np.float32) @ XY1 for axis in warp)
        seen = _remap(image, u, v)
        seen -= self.mean[:, None]
        sums = _sums(seen * self.parts, BASIS)
        mean = (seen @ WINDOW).astype(np.float64)
        variance = np.maximum(np.square(seen, out=seen) @ WINDOW - mean**2, 1e-3)
        shared = sums[0, 0]
        gain = shared / variance
        slope = gain * (sums[1:] - mean * self.of_slopes) - self.of_target
        return self.contrast - gain * shared, slope


def _sums(values: Patches, basis: Patches) -> Array:
    """Return the sums (A, B, N) of values (A, N, P) times each of a basis (P, B)."""
    sums = values.reshape(-1, len(basis)) @ basis
    return sums.reshape(*values.shape[:2], -1).swapaxes(1, 2).astype(np.float64)


def _slope(patches: Patches, axis: int, out: Patches) -> None:
    """Write how patches (N, rows, columns) change along their columns, or with axis 1 their rows,
    to `out`, as `np.gradient` does.
    """
    step = 1 if axis == 0 else patches.shape[2]
    flat, into = patches.ravel(), out.reshape(-1)
    np.subtract(flat[2 * step :], flat[: -2 * step], out=into[step:-step])
    into[step:-step] *= np.float32(0.5)
    values, ends = (np.moveaxis(array, 2 - axis, 0) for array in (patches, out))
    np.subtract(values[1], values[0], out=ends[0])
    np.subtract(values[-1], values[-2], out=ends[-1])


def _stepped(warp: Array, step: Array) -> Array:
    """Return warps (2, 3, N) = (A, place) with a step (axes, 3, N) = (shift, shear) taken back."""
    (a, b, _), (c, d, _) = warp
    (du, p, q), (dv, r, s) = step if len(step) == 2 else (step[0], np.zeros_like(step[0]))
    p, s = 1.0 + p, 1.0 + s
    scale = 1.0 / (p * s - q * r)
    stepped = np.empty_like(warp)
    for row, (x, y, place) in zip(stepped, ((a, b, warp[0, 2]), (c, d, warp[1, 2])), strict=True):
        row[0], row[1] = (x * s - y * r) * scale, (y * p - x * q) * scale
        row[2] = place - row[0] * du - row[1] * dv
    return stepped


def _inverse(H: Array) -> Array:
    """Return the inverses (K, K, N) of positive symmetric matrices (K, K, N), of blocks of three by
    the Schur complement.
    """
    first = _inverse_of_three(H[:3, :3])
    if len(H) == 3:
        return first
    across = np.einsum('abn,bcn->acn', first, H[:3, 3:])
    inverse: Array = np.empty_like(H)
    rest = H[3:, 3:] - np.einsum('ban,bcn->acn', H[:3, 3:], across)
    inverse[3:, 3:] = _inverse_of_three(rest)
    inverse[:3, 3:] = -np.einsum('abn,bcn->acn', across, inverse[3:, 3:])
    inverse[3:, :3] = inverse[:3, 3:].swapaxes(0, 1)
    inverse[:3, :3] = first - np.einsum('abn,cbn->acn', inverse[:3, 3:], across)
    return inverse


def _inverse_of_three(A: Array) -> Array:
    """Return the inverses (3, 3, N) of symmetric matrices (3, 3, N), by their cofactors."""
    (a, b, c), (_, d, e), (_, _, f) = A
    inverse: Array = np.empty_like(A)
    inverse[0] = d * f - e * e, c * e - b * f, b * e - c * d
    inverse[1, 1:] = a * f - c * c, b * c - a * e
    inverse[2, 2] = a * d - b * b
    determinant = a * inverse[0, 0] + b * inverse[0, 1] + c * inverse[0, 2]
    inverse[1, 0], inverse[2, :2] = inverse[0, 1], inverse[[0, 1], 2]
    inverse /= determinant
    return inverse


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


def measure_disparities(
    frame: StereoFrame, images: Images, observations: Observations, rows: NDArray[np.intp]
) -> None:
    """Set, in place, the disparities of observations `rows` (N,), wherever they are found."""
    guess: Array = np.zeros(len(rows))
    if not images.depth_scale:
        guess = guess_disparity(frame.left, frame.right, observations.uvd_px[rows, :2])
    found = np.isfinite(guess)
    measure_disparity(images, observations, rows[found], guess[found], SAME_PX)


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
        rows = np.flatnonzero((peak > 0) & (peak < 2 * reach_px))
        uv_right[rows, 0] += peak[rows] - reach_px
    found = align_patches(template[rows], right, uv_right[rows], np.ones(len(rows)), along_row=True)
    rows, found_u = rows[found.sound], found.uv_px[found.sound, 0]
    disparity[rows] = uv_px[rows, 0] - found_u
    sigma[rows] = found.sigma_px[found.sound, 0]
    return disparity, sigma


def guess_disparity(left: NDArray[np.uint8], right: NDArray[np.uint8], uv_px: Array) -> Array:
    """Return about the disparity (N,) px at pixels (N, 2) of the left image; NaN where none is
    found. left, right: rectified grey images (H, W).
    """
    factor = max(1, round(left.shape[1] / SMALL_WIDTH_PX))
    size = (left.shape[1] // factor, left.shape[0] // factor)
    count = -(-round(MAX_DISPARITY_SHARE * size[0]) // SUBPIXEL) * SUBPIXEL
    matcher = cv2.StereoBM_create(count, SIDE_PX)
    matcher.setTextureThreshold(MIN_TEXTURE)
    matcher.setUniquenessRatio(0)
    # Without a margin the matcher leaves the leftmost columns empty.
    small = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (left, right))
    wide = (cv2.copyMakeBorder(i, 0, 0, count, 0, cv2.BORDER_REPLICATE) for i in small)
    disparity = matcher.compute(*wide)[:, count:]
    column, row = ((uv_px.T + 0.5) / factor).astype(np.intp)
    at = disparity[np.clip(row, 0, size[1] - 1), np.clip(column, 0, size[0] - 1)]
    return np.where(at > 0, at * (factor / SUBPIXEL), np.nan)
