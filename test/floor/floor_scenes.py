"""Small scenes of flat patches, ray-cast into stereo pairs with the true floor of every pixel."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from segfloor_ros.camera.model import Mount, StereoCamera

CAMERA = StereoCamera(640, 480, 320.0, 320.0, 320.0, 240.0, 0.12)
MOUNT = Mount(0.30, np.radians(7.0))
SUPERSAMPLING = 2


@dataclass(frozen=True)
class Patch:
    """A parallelogram in the base frame: corner + s * first + t * second, s and t in [0, 1]."""

    corner: tuple[float, float, float]
    first: tuple[float, float, float]
    second: tuple[float, float, float]
    is_floor: bool
    grey: float = 120.0
    contrast: float = 18.0
    seed: int = 0

    def below(self) -> Patch:
        """Return its mirror image in the ground."""
        turned = [(x, y, -z) for x, y, z in (self.corner, self.first, self.second)]
        return replace(self, corner=turned[0], first=turned[1], second=turned[2])


@dataclass(frozen=True)
class Scene:
    patches: list[Patch]
    camera: StereoCamera = CAMERA
    mount: Mount = MOUNT
    noise_grey: float = 1.5
    seed: int = 0
    texture_m: float = field(default=0.64)
    reflectance: float = 0.0

    def render(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return left, right (H, W) uint8, the true floor (H, W) bool and the depth of the left
        image (H, W) in metres, infinite where nothing is.
        """
        rng = np.random.default_rng(self.seed)
        images = []
        for offset in (0.0, self.camera.baseline_m):
            grey, floor, depth = self._cast(offset)
            grey = cv2.resize(
                grey, (self.camera.width, self.camera.height), None, 0, 0, cv2.INTER_AREA
            )
            grey += rng.normal(0, self.noise_grey, grey.shape)
            images.append((np.clip(np.rint(grey), 0, 255).astype(np.uint8), floor, depth))
        return images[0][0], images[1][0], images[0][1], images[0][2]

    def _cast(self, offset_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        camera, n = self.camera, SUPERSAMPLING
        u, v = np.meshgrid(
            (np.arange(camera.width * n) + 0.5) / n - 0.5,
            (np.arange(camera.height * n) + 0.5) / n - 0.5,
        )
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)])
        T = self.mount.T_base_left
        origin = T[:3, 3] + T[:3, 0] * offset_m
        rays = np.einsum('ij,jhw->ihw', T[:3, :3], rays)
        grey = np.full(u.shape, 60.0, np.float32)
        floor = np.zeros(u.shape, bool)
        nearest = np.full(u.shape, np.inf)
        for patch in self.patches:
            first, second = np.array(patch.first), np.array(patch.second)
            normal = np.cross(first, second)
            with np.errstate(divide='ignore', invalid='ignore'):
                depth = (
                    normal
                    @ (np.array(patch.corner) - origin)
                    / np.einsum('i,ihw->hw', normal, rays)
                )
                hit = origin[:, None, None] + rays * depth - np.array(patch.corner)[:, None, None]
                s = np.einsum('i,ihw->hw', first, hit) / (first @ first)
                t = np.einsum('i,ihw->hw', second, hit) / (second @ second)
                inside = (
                    (depth > 0.05) & (depth < nearest) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
                )
            texture = self._texture(patch, s * np.linalg.norm(first), t * np.linalg.norm(second))
            grey[inside] = (patch.grey + patch.contrast * texture)[inside]
            floor[inside] = patch.is_floor
            nearest[inside] = depth[inside]
        if self.reflectance:
            standing = [patch.below() for patch in self.patches if not patch.is_floor]
            below = replace(self, patches=standing, reflectance=0.0)._cast(offset_m)[0]
            grey[floor] += self.reflectance * (below - grey)[floor]
        return grey, floor[n // 2 :: n, n // 2 :: n], nearest[n // 2 :: n, n // 2 :: n]

    def _texture(self, patch: Patch, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Return noise of several scales, of about unit deviation, that repeats far apart."""
        size = 256
        rng = np.random.default_rng(patch.seed + 1)
        tile = np.zeros((size, size), np.float32)
        for sigma in (1.0, 2.0, 4.0, 8.0):
            layer = cv2.GaussianBlur(
                np.tile(rng.normal(size=(size, size)).astype(np.float32), (3, 3)), (0, 0), sigma
            )[size : 2 * size, size : 2 * size]
            tile += layer / layer.std()
        tile /= tile.std()
        scale = size / self.texture_m / 2
        x = np.nan_to_num(np.remainder(x_m * scale, size), posinf=0, neginf=0).astype(np.float32)
        y = np.nan_to_num(np.remainder(y_m * scale, size), posinf=0, neginf=0).astype(np.float32)
        return cv2.remap(tile, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


def floor_patch(near_m=-1.0, far_m=8.0, half_width_m=4.0, height_m=0.0, **kwargs) -> Patch:
    return Patch(
        (near_m, -half_width_m, height_m),
        (far_m - near_m, 0, 0),
        (0, 2 * half_width_m, 0),
        True,
        **kwargs,
    )


def wall(x_m=4.0, half_width_m=4.0, height_m=2.5, **kwargs) -> Patch:
    return Patch(
        (x_m, -half_width_m, 0), (0, 2 * half_width_m, 0), (0, 0, height_m), False, **kwargs
    )


def box(x_m, y_m, size_m, height_m, is_floor=False, **kwargs) -> list[Patch]:
    """Front, top and both sides of a box whose front face is centred at (x, y)."""
    left, right, back = y_m + size_m / 2, y_m - size_m / 2, x_m + size_m
    return [
        Patch((x_m, right, 0), (0, size_m, 0), (0, 0, height_m), is_floor, seed=11, **kwargs),
        Patch((x_m, right, height_m), (size_m, 0, 0), (0, size_m, 0), is_floor, seed=12, **kwargs),
        Patch((x_m, right, 0), (back - x_m, 0, 0), (0, 0, height_m), is_floor, seed=13, **kwargs),
        Patch((x_m, left, 0), (back - x_m, 0, 0), (0, 0, height_m), is_floor, seed=14, **kwargs),
    ]


def ramp(start_m, slope_rad, length_m=3.0, half_width_m=4.0, **kwargs) -> Patch:
    along = (length_m * np.cos(slope_rad), 0, length_m * np.sin(slope_rad))
    return Patch(
        (start_m, -half_width_m, 0), along, (0, 2 * half_width_m, 0), True, seed=5, **kwargs
    )
