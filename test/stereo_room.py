"""A textured room rendered by ray casting, as stereo input with known geometry for tests.

The room is an axis-aligned box in `world` (ROS axes, floor at z = 0); every face carries its
own smooth random texture.
"""

from functools import cache
from typing import Any

import cv2
import numpy as np
from drawing import drawn

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import Mount, StereoFrame
from segfloor_ros.core.geometry import make_transform

ROOM_MIN = np.array([-3.0, -2.5, 0.0])
ROOM_MAX = np.array([6.0, 2.5, 2.4])
TEXELS_PER_M = 100
CAMERA = StereoCamera(320, 240, 160.0, 160.0, 159.5, 119.5, 0.12)
MOUNT = Mount(0.4, 0.15)


class StereoRoom:
    """Renders stereo pairs of the room for camera poses in world coordinates."""

    def __init__(
        self,
        seed: int = 0,
        contrast: float = 60.0,
        noise: float = 1.0,
        floor: np.ndarray | None = None,
    ) -> None:
        self.textures, state = _textures(seed, contrast)
        if floor is not None:
            self.textures = [*self.textures[:4], floor.astype(np.float32), self.textures[5]]
        self._rng = np.random.default_rng()
        self._rng.bit_generator.state = state
        self._noise = noise

    def reset_noise(self, seed: int = 0) -> None:
        """Begin the noise anew, so that a test does not depend on those before it."""
        self._rng = np.random.default_rng(seed)

    def view(self, T_world_camera: np.ndarray, camera: StereoCamera = CAMERA) -> np.ndarray:
        """Return the grey image (H, W) uint8 seen from an optical frame."""
        directions = (T_world_camera[:3, :3] @ _rays(camera)).astype(np.float32)
        origin = T_world_camera[:3, 3].astype(np.float32)
        upper = directions > 0
        bound = [np.where(upper[k], ROOM_MAX[k], ROOM_MIN[k]) for k in range(3)]
        with np.errstate(divide='ignore'):
            to_face = (np.array(bound, np.float32) - origin[:, None]) / directions
        # Of three rows this is several times faster than argmin.
        distance = np.minimum(np.minimum(to_face[0], to_face[1]), to_face[2])
        faces = [np.uint8(2 * k) + upper[k] for k in range(3)]
        hit = [to_face[k] == distance for k in range(2)]
        seen = np.where(hit[0], faces[0], np.where(hit[1], faces[1], faces[2]))
        image = np.zeros(len(seen), np.float32)
        for face in range(6):
            at = np.flatnonzero(seen == face)
            across = [k for k in range(3) if k != face // 2]
            s, t = (
                (origin[k] - ROOM_MIN[k] + directions[k, at] * distance[at]) * TEXELS_PER_M
                for k in across
            )
            image[at] = drawn(self.textures[face], s, t, cv2.BORDER_REFLECT)
        image += self._rng.normal(scale=self._noise, size=image.shape)
        image = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        return image.reshape(camera.height, camera.width)

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


@cache
def _textures(seed: int, contrast: float) -> tuple[list[np.ndarray], dict[str, Any]]:
    """Return the textures of the faces, and how the generator goes on."""
    rng, size = np.random.default_rng(seed), int(TEXELS_PER_M * 10)
    textures = []
    for _ in range(6):
        fine, coarse = (
            cv2.GaussianBlur(rng.normal(size=(size, size)), (0, 0), sigma) for sigma in (2.0, 8.0)
        )
        mixed = fine / fine.std() + coarse / coarse.std()
        textures.append(np.clip(128 + contrast * mixed / 2, 0, 255).astype(np.float32))
    return textures, rng.bit_generator.state


@cache
def _rays(camera: StereoCamera) -> np.ndarray:
    """Return the rays (3, N) of all pixels."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)]
    return np.stack(rays).reshape(3, -1)


def planar_pose(x: float, y: float, yaw: float) -> np.ndarray:
    """Return T_world_base (4, 4) of a base on the floor."""
    c, s = np.cos(yaw), np.sin(yaw)
    return make_transform(
        np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([x, y, 0.0])
    )


def depth_of_room(T_world_camera: np.ndarray) -> np.ndarray:
    """The depth (H, W) in mm of the walls, floor and ceiling of the room."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack(
        [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1
    )
    directions, origin = rays @ T_world_camera[:3, :3].T, T_world_camera[:3, 3]
    with np.errstate(divide='ignore'):
        to_face = np.where(directions > 0, ROOM_MAX - origin, ROOM_MIN - origin) / directions
    return np.rint(1000 * to_face.min(axis=-1)).astype(np.uint16)
