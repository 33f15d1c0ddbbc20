"""Small scenes of flat patches, ray-cast into stereo pairs with the true floor of every pixel."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache

import cv2
import numpy as np
from drawing import drawn

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import Mount

CAMERA = StereoCamera(640, 480, 320.0, 320.0, 320.0, 240.0, 0.12)
SMALL_CAMERA = StereoCamera(320, 240, 160.0, 160.0, 160.0, 120.0, 0.12)
MOUNT = Mount(0.30, np.radians(7.0))
FLOORS = [{}, {'seed': 21, 'grey': 85.0, 'contrast': 11.0}]
"""A floor, and another pattern of weaker texture on darker ground: mechanisms are not to depend on
one of them.
"""
SUPERSAMPLING = 2
TILE_PX = 256


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
        n = SUPERSAMPLING
        T = self.mount.T_base_left
        origin = T[:3, 3] + T[:3, 0] * offset_m
        x, y = _rays(self.camera, n)
        shape = (len(y), x.shape[1])
        grey = np.full(shape, 60.0, np.float32)
        floor = np.zeros(shape, bool)
        nearest = np.full(shape, np.inf, np.float32)
        for patch in self.patches:
            first, second, corner = (
                np.array(side) for side in (patch.first, patch.second, patch.corner)
            )

            seen = self._pixels(patch, origin, x, y)
            x_seen, y_seen = x[:, seen[1]], y[seen[0]]

            def along_rays(
                direction: np.ndarray, x: np.ndarray = x_seen, y: np.ndarray = y_seen
            ) -> np.ndarray:
                """Return the products of a direction with the rays of the pixels."""
                a, b, c = (direction @ T[:3, :3]).astype(np.float32)
                return a * x + (b * y + c)

            normal = np.cross(first, second)
            with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
                depth = np.float32(normal @ (corner - origin)) / along_rays(normal)
                inside = (depth > 0.05) & (depth < nearest[seen])
                sides = []
                for side in (first / (first @ first), second / (second @ second)):
                    share = depth * along_rays(side) + np.float32(side @ (origin - corner))
                    inside &= (share >= 0) & (share <= 1)
                    sides.append(share)
            s, t = (share[inside] for share in sides)
            texture = self._texture(patch, s * np.linalg.norm(first), t * np.linalg.norm(second))
            grey[seen][inside] = patch.grey + patch.contrast * texture
            floor[seen][inside], nearest[seen][inside] = patch.is_floor, depth[inside]
        if self.reflectance:
            standing = [patch.below() for patch in self.patches if not patch.is_floor]
            below = replace(self, patches=standing, reflectance=0.0)._cast(offset_m)[0]
            grey[floor] += self.reflectance * (below - grey)[floor]
        middle = np.s_[n // 2 :: n, n // 2 :: n]
        return grey, floor[middle], nearest[middle].astype(np.float64)

    def _pixels(
        self, patch: Patch, origin: np.ndarray, x: np.ndarray, y: np.ndarray
    ) -> tuple[slice, slice]:
        """Return the rows and columns around a patch: all where it comes close to the camera."""
        sides = np.array([[0, 0], [0, 1], [1, 0], [1, 1]]) @ np.array([patch.first, patch.second])
        corners = (patch.corner + sides - origin) @ self.mount.T_base_left[:3, :3]
        if corners[:, 2].min() < 0.05:
            return slice(None), slice(None)
        u, v = (corners[:, :2] / corners[:, 2:]).T
        rows, columns = (
            slice(
                max(0, np.searchsorted(at, range_.min()) - 1), np.searchsorted(at, range_.max()) + 1
            )
            for at, range_ in ((y.ravel(), v), (x.ravel(), u))
        )
        return rows, columns

    def _texture(self, patch: Patch, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        scale = TILE_PX / self.texture_m / 2
        return drawn(_tile(patch.seed), x_m * scale, y_m * scale, cv2.BORDER_WRAP)


@cache
def _rays(camera: StereoCamera, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return x (1, W n) and y (H n, 1) of the rays (x, y, 1) through n by n points of a pixel."""
    x, y = (
        ((np.arange(size * n) + 0.5) / n - 0.5 - centre) / focal
        for size, centre, focal in (
            (camera.width, camera.cx, camera.fx),
            (camera.height, camera.cy, camera.fy),
        )
    )
    return x[None].astype(np.float32), y[:, None].astype(np.float32)


@cache
def _tile(seed: int) -> np.ndarray:
    """Return noise of several scales, of about unit deviation, that repeats far apart."""
    size = TILE_PX
    rng = np.random.default_rng(seed + 1)
    tile = np.zeros((size, size), np.float32)
    for sigma in (1.0, 2.0, 4.0, 8.0):
        layer = cv2.GaussianBlur(
            np.tile(rng.normal(size=(size, size)).astype(np.float32), (3, 3)), (0, 0), sigma
        )[size : 2 * size, size : 2 * size]
        tile += layer / layer.std()
    return tile / tile.std()


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
        (start_m, -half_width_m, 0), along, (0, 2 * half_width_m, 0), True, **{'seed': 5, **kwargs}
    )


def blank_floored(mount: Mount, *things: Patch) -> Scene:
    """Return a scene whose floor has no texture, with three walls that have, and things."""
    left = Patch((-1, 1.5, 0), (6, 0, 0), (0, 0, 2.5), False, contrast=45.0, seed=3)
    right = Patch((-1, -1.3, 0), (6, 0, 0), (0, 0, 2.5), False, contrast=45.0, seed=4)
    patches = [
        floor_patch(grey=175.0, contrast=0.0),
        left,
        right,
        wall(3.0, contrast=45.0),
        *things,
    ]
    return Scene(patches, mount=mount, noise_grey=1.0)
