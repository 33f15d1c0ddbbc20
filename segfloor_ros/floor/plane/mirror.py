"""Floors that mirror what stands on them.

Nothing is seen below a floor, except what a polished one mirrors. What is seen below such a plane
is, reflected in it, found again above it: at the depth it should have, and looking alike. Any
other plane through the scene shows nothing of the kind.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.floor.plane.plane_fit import (
    Samples,
    on_and_below,
    plane_of,
    preference,
    propose,
)
from segfloor_ros.geometry import Array

MIRRORED_SHARE = 0.5
"""Of what is seen below a mirror so much is found again above it."""
_PROPOSALS = 600
_QUICK = 40
_QUICK_SHARE = 0.2
"""A plane that is not yet refined is a degree or so off and mirrors less."""
_BEST = 3
_RECENT_FRAMES = 4
_STRIDE = 8
_MIN_ON = 0.04
_MIN_BELOW = 0.1
_MIN_TESTED = 40
_TEXTURED = 0.5
_ALIKE = 0.6
"""Normalized correlation of a patch with its mirror image."""
_PATCH = np.stack(np.meshgrid(np.arange(-6.0, 7.0), np.arange(-3.0, 4.0)), -1).reshape(-1, 2)
_QUICK_PATCH = _PATCH[::4]
"""By these pixels the first guesses are compared."""
_OUTLINE = np.array([[0, 0], [-6, -3], [6, -3], [-6, 3], [6, 3]], np.float64)
"""Middle and corners of a patch: where these are, all of it is."""
_SMOOTH_PX = 1.0
_MARGIN_PX = 2.0


@dataclass(frozen=True)
class MirrorView:
    """One frame: its smoothed left image and disparities (H, W), the samples taken of them and
    the pose (4, 4) of the camera in the world.
    """

    camera: StereoCamera
    grey: NDArray[np.float32]
    disparity_px: NDArray[np.float32]
    samples: Samples
    T_world_left: Array

    @classmethod
    def of(
        cls,
        camera: StereoCamera,
        left: NDArray[np.uint8],
        disparity_px: NDArray[np.float32],
        samples: Samples,
        T_world_left: Array,
    ) -> MirrorView:
        """Return the view of a left image and its disparities (H, W)."""
        grey = cv2.GaussianBlur(left.astype(np.float32), (0, 0), _SMOOTH_PX)
        return cls(camera, grey, disparity_px, samples, T_world_left)


def mirror_candidates(
    views: list[MirrorView], rng: np.random.Generator, known: Array, travel: Array
) -> Array:
    """Return pitch, roll and height (M, 3) of the few planes that most likely are mirrors.

    A mirror's own texture is faint beside that of what it shows, so all matches count alike.
    """
    recent = [_in_lower_half(view) for view in views[-_RECENT_FRAMES:]]
    if len(recent[-1].weight) < 50:
        return np.zeros((0, 3))
    guesses = propose(recent[-1], _PROPOSALS, rng, known)
    if len(guesses) == 0:
        return guesses
    sums = np.zeros((3, len(guesses)))
    for samples in recent:
        few = samples.every(_STRIDE)
        on, below, visible = on_and_below(few, plane_of(guesses))
        sums += [few.weight @ on, few.weight @ below, few.weight @ visible]
    on_sum, below_sum, total = sums
    possible = (on_sum > _MIN_ON * total) & (below_sum > _MIN_BELOW * total)
    guesses = guesses[possible]
    order = np.argsort(-on_sum[possible] * preference(guesses, travel), kind='stable')
    guesses = guesses[order[:_QUICK]]
    share = np.array([mirrored_share(views[-2:], guess, 60, _QUICK_PATCH) for guess in guesses])
    best = np.argsort(-share, kind='stable')[:_BEST]
    return guesses[best[share[best] > _QUICK_SHARE]]


def mirrored_share(
    views: list[MirrorView], angles_height: Array, count: int = 200, patch_px: Array = _PATCH
) -> float:
    """Return which share of what is seen below the plane (pitch, roll, height) is seen above it,
    mirrored. 0 where too little of it can be told; count: so many samples of each view are tested,
    by these pixels (P, 2) around them.
    """
    results = [_tested_and_found(view, angles_height, count, patch_px) for view in views]
    tested, found = np.sum(results, axis=0)
    return float(found / tested) if tested >= _MIN_TESTED else 0.0


def _in_lower_half(view: MirrorView) -> Samples:
    """Return the samples of the image's lower half, where floor is, all of one weight."""
    samples = view.samples
    lower = samples.rays @ view.T_world_left[:3, 1] > 0
    return replace(
        samples,
        rays=samples.rays[lower],
        disparity_px=samples.disparity_px[lower],
        weight=np.ones(int(lower.sum())),
    )


def _tested_and_found(
    view: MirrorView, angles_height: Array, count: int, patch_px: Array
) -> tuple[int, int]:
    camera, samples = view.camera, view.samples
    plane = plane_of(angles_height)
    below = on_and_below(samples, plane[None])[1]
    usable = (samples.weight > _TEXTURED) & (samples.disparity_px > 0)
    chosen = np.flatnonzero(below[:, 0] & usable)
    if len(chosen) == 0:
        return 0, 0
    chosen = chosen[:: max(1, len(chosen) // count)]
    outline, _ = _mirrored(view, chosen, _OUTLINE, angles_height)
    ahead = outline[..., 2].min(axis=1) > 0.05
    at = np.where(ahead[:, None, None], outline, 1.0)
    at_px = camera.project(at.reshape(-1, 3))[:, :2].reshape((*at.shape[:2], 2))
    size = np.array([camera.width, camera.height]) - 1 - _MARGIN_PX
    inside = ahead & ((at_px > _MARGIN_PX) & (at_px < size)).all(axis=(1, 2))
    expected = camera.disparity_times_depth / at[inside, 0, 2]
    columns, rows = np.rint(at_px[inside, 0]).astype(int).T
    seen = view.disparity_px[rows, columns]
    play = 1.5 + 0.05 * expected
    tested = (seen >= 1) & (seen < expected + play)
    fits = tested & (seen > expected - play)
    if fits.sum() <= _QUICK_SHARE * tested.sum():
        return int(tested.sum()), 0
    mirrored, from_px = _mirrored(view, chosen[inside][fits], patch_px, angles_height)
    to_px = camera.project(mirrored.reshape(-1, 3))[:, :2].reshape(from_px.shape)
    found = _alike(view.grey, from_px, to_px) > _ALIKE
    return int(tested.sum()), int(found.sum())


def _mirrored(
    view: MirrorView, chosen: NDArray[np.intp], offsets_px: Array, angles_height: Array
) -> tuple[Array, Array]:
    """Return the mirror images (N, P, 3), in the camera's frame, of what is seen around the chosen
    samples (N,), as patches that face the camera, and their pixels (N, P, 2).
    """
    camera, samples = view.camera, view.samples
    R_world_left, position = view.T_world_left[:3, :3], view.T_world_left[:3, 3]
    pixels = camera.project(samples.rays[chosen] @ R_world_left)[:, None, :2] + offsets_px
    depth_m = samples.disparity_m / samples.disparity_px[chosen]
    depths = np.repeat(depth_m, len(offsets_px))
    height = float(angles_height[2])
    normal = plane_of(angles_height) * height
    points = camera.back_project(pixels.reshape(-1, 2), depths)
    points = points @ R_world_left.T + position
    points -= 2 * (points @ normal + height)[:, None] * normal
    return ((points - position) @ R_world_left).reshape(*pixels.shape[:2], 3), pixels


def _alike(grey: NDArray[np.float32], first: Array, second: Array) -> Array:
    """Return the normalized correlation (N,) of the image at two sets of pixels (N, P, 2)."""
    if len(first) == 0:
        return np.zeros(0)
    values = []
    for pixels in (first, second):
        u, v = (np.ascontiguousarray(pixels[..., i], np.float32) for i in (0, 1))
        patch = cv2.remap(grey, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        patch = patch - patch.mean(axis=1, keepdims=True)
        values.append(patch / (np.linalg.norm(patch, axis=1, keepdims=True) + 1e-3))
    return np.asarray((values[0] * values[1]).sum(axis=1), np.float64)
