"""A textured room rendered by ray casting, as stereo input with known geometry for tests.

The room is an axis-aligned box in `world` (ROS axes, floor at z = 0); every face carries its
own smooth random texture.
"""

from __future__ import annotations

import cv2
import numpy as np

from segfloor_ros.camera.model import Mount, StereoCamera, StereoFrame
from segfloor_ros.geometry import make_transform

ROOM_MIN = np.array([-3.0, -2.5, 0.0])
ROOM_MAX = np.array([6.0, 2.5, 2.4])
TEXELS_PER_M = 100
CAMERA = StereoCamera(320, 240, 160.0, 160.0, 159.5, 119.5, 0.12)
MOUNT = Mount(0.4, 0.15)


class StereoRoom:
    """Renders stereo pairs of the room for camera poses in world coordinates."""

    def __init__(self, seed: int = 0, contrast: float = 60.0, noise: float = 1.0) -> None:
        self._rng = np.random.default_rng(seed)
        self._noise = noise
        size = int(TEXELS_PER_M * 10)
        self._textures = [self._texture(size, contrast) for _ in range(6)]

    def _texture(self, size: int, contrast: float) -> np.ndarray:
        fine = cv2.GaussianBlur(self._rng.normal(size=(size, size)), (0, 0), 2.0)
        coarse = cv2.GaussianBlur(self._rng.normal(size=(size, size)), (0, 0), 8.0)
        mixed = fine / fine.std() + coarse / coarse.std()
        return np.clip(128 + contrast * mixed / 2, 0, 255).astype(np.float32)

    def view(self, T_world_camera: np.ndarray, camera: StereoCamera = CAMERA) -> np.ndarray:
        """Return the grey image (H, W) uint8 seen from an optical frame."""
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = np.stack(
            [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1
        )
        directions = rays @ T_world_camera[:3, :3].T
        origin = T_world_camera[:3, 3]
        with np.errstate(divide='ignore'):
            to_face = np.where(directions > 0, ROOM_MAX - origin, ROOM_MIN - origin) / directions
        axis = to_face.argmin(axis=-1)
        hits = origin + directions * to_face.min(axis=-1)[..., None]
        image = np.zeros(u.shape, np.float32)
        for face in range(6):
            on_face = (axis == face // 2) & (
                (np.take_along_axis(directions, axis[..., None], -1)[..., 0] > 0) == face % 2
            )
            across = [k for k in range(3) if k != face // 2]
            s, t = ((hits[..., k] - ROOM_MIN[k]) * TEXELS_PER_M for k in across)
            drawn = cv2.remap(
                self._textures[face],
                s.astype(np.float32),
                t.astype(np.float32),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REFLECT,
            )
            image[on_face] = drawn[on_face]
        image += self._rng.normal(scale=self._noise, size=image.shape)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def frame(
        self,
        index: int,
        T_world_base: np.ndarray,
        rate_hz: float = 10.0,
        camera: StereoCamera = CAMERA,
    ) -> StereoFrame:
        """Return the stereo pair seen from the base at T_world_base (4, 4), mounted as `MOUNT`."""
        T_world_left = T_world_base @ MOUNT.T_base_left
        right = make_transform(np.eye(3), np.array([camera.baseline_m, 0.0, 0.0]))
        stamp_ns = round(index * 1e9 / rate_hz)
        return StereoFrame(
            index,
            stamp_ns,
            self.view(T_world_left, camera),
            self.view(T_world_left @ right, camera),
        )


def planar_pose(x: float, y: float, yaw: float) -> np.ndarray:
    """Return T_world_base (4, 4) of a base on the floor."""
    c, s = np.cos(yaw), np.sin(yaw)
    return make_transform(
        np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([x, y, 0.0])
    )
