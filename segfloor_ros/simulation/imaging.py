"""From ideal pictures to what a camera delivers: lens, alignment, light, exposure and noise."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.errors import InputError
from segfloor_ros.geometry import Array
from segfloor_ros.simulation.rig import RawCamera, raw_cameras, rectified_camera
from segfloor_ros.simulation.scene import Scene

Picture = NDArray[np.float32]

UNDISTORT_ITERATIONS = 60
MAX_HALF_PX = 2000


@dataclass(frozen=True)
class ImagingPlan:
    """How pictures are taken: the size of the ideal picture, large enough for the lens, and for
    either camera where each of its pixels lies in it (H, W, 2), None where it is the picture.
    """

    width: int
    height: int
    focal_px: float
    raw: tuple[RawCamera, RawCamera]
    lookup: tuple[Picture, Picture] | None


def plan_imaging(scene: Scene) -> ImagingPlan:
    """Return the plan for a scene's camera."""
    camera, raw = rectified_camera(scene.camera), raw_cameras(scene.camera, scene.seed)
    if scene.camera.rectified:
        return ImagingPlan(camera.width, camera.height, camera.fx, raw, None)
    rays = [_rays(side, camera.width, camera.height) * camera.fx for side in raw]
    half = np.ceil(np.max([np.abs(side).max(axis=(0, 1)) for side in rays], axis=0)).astype(int) + 2
    if (half > MAX_HALF_PX).any():
        raise InputError('the distortion folds the image over; the lens cannot be simulated')
    left, right = ((side + half - 0.5).astype(np.float32) for side in rays)
    return ImagingPlan(2 * int(half[0]), 2 * int(half[1]), camera.fx, raw, (left, right))


def _rays(side: RawCamera, width: int, height: int) -> Array:
    """Return x/z and y/z (H, W, 2), in the rectified frame, of every pixel of a raw camera."""
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    x, y = (u - side.K[0, 2]) / side.K[0, 0], (v - side.K[1, 2]) / side.K[1, 1]
    rays = np.stack([*undistort(x, y, side.D), np.ones_like(x)], axis=-1) @ side.R.T
    return rays[..., :2] / rays[..., 2:]


def undistort(x: Array, y: Array, distortion: Array) -> tuple[Array, Array]:
    """Return ideal for distorted normalised coordinates, by fixed-point iteration of the plumb_bob
    model (Brown 1966; k1 k2 p1 p2 k3 as in OpenCV).
    """
    k1, k2, p1, p2, k3 = distortion
    ideal_x, ideal_y = x, y
    for _ in range(UNDISTORT_ITERATIONS):
        r2 = ideal_x**2 + ideal_y**2
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        shift_x = 2 * p1 * ideal_x * ideal_y + p2 * (r2 + 2 * ideal_x**2)
        shift_y = p1 * (r2 + 2 * ideal_y**2) + 2 * p2 * ideal_x * ideal_y
        ideal_x, ideal_y = (x - shift_x) / radial, (y - shift_y) / radial
    return ideal_x, ideal_y


def ideal_image(ideal: Picture, plan: ImagingPlan, side: int) -> Picture:
    """Return the image (H, W) of camera `side`, without noise, of an ideal picture."""
    picture = ideal
    if picture.shape != (plan.height, plan.width):
        picture = cv2.resize(picture, (plan.width, plan.height), interpolation=cv2.INTER_AREA)
    if plan.lookup is not None:
        picture = cv2.remap(picture, plan.lookup[side], None, cv2.INTER_CUBIC)
    return picture


def develop(
    ideal: Picture, plan: ImagingPlan, scene: Scene, side: int, frame: int, time_s: float
) -> NDArray[np.uint8]:
    """Return the image (H, W) uint8 that camera `side` (0 left, 1 right) delivers of an ideal
    picture. The noise depends on the scene's seed, the frame and the side alone.
    """
    picture = ideal_image(ideal, plan, side)
    gain = brightness(scene, time_s) * (scene.camera.right_gain if side == 1 else 1.0)
    rng = np.random.default_rng([scene.seed, 4, frame, side])
    noise = rng.standard_normal(picture.shape, np.float32) * np.float32(scene.camera.noise_sigma)
    return np.clip(np.round(picture * np.float32(gain) + noise), 0, 255).astype(np.uint8)


def brightness(scene: Scene, time_s: float) -> float:
    """Return the brightness of what the lenses let through at a time."""
    if any(start <= time_s < end for start, end in scene.camera.covered):
        return 0.0
    levels = np.array(scene.lighting.levels)
    return float(np.interp(time_s, levels[:, 0], levels[:, 1])) if len(levels) else 1.0
