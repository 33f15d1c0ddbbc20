"""A drive through the rendered room with something in it that moves, for tests."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.core.geometry import invert, transform_points

BOARD_HALF_WIDTH_M = 0.3
BOARD_TOP_M = 1.6


class MovingDrive:
    """Drives straight ahead at 3 cm a frame while a textured board, upright and facing the camera,
    is at `place(frame)` = (x, y) in the world, or nowhere (None).
    """

    def __init__(self, place, seed=0):
        self._room = StereoRoom(seed)
        self._place = place
        texture = np.random.default_rng(seed + 1).normal(size=(96, 36))
        texture = cv2.GaussianBlur(texture, (0, 0), 1.0)
        self._texture = np.clip(128 + 45 * texture / texture.std(), 0, 255).astype(np.uint8)

    def pose(self, index: int) -> np.ndarray:
        return planar_pose(0.03 * index, 0.0, 0.0)

    @cache  # noqa: B019  a drive lives as long as its tests
    def frame(self, index: int) -> StereoFrame:
        frame = self._room.frame(index, self.pose(index))
        if self._place(index) is None:
            return frame
        left, right = frame.left.copy(), frame.right.copy()
        for image, columns in ((left, (0, 1)), (right, (2, 1))):
            self._draw(image, self._corners_px(index)[:, columns])
        return replace(frame, left=left, right=right)

    def mask(self, index: int) -> np.ndarray:
        """The true mask of the board, 255."""
        mask = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
        if self._place(index) is not None:
            cv2.fillConvexPoly(mask, np.rint(self._corners_px(index)[:, :2]).astype(int), 255)
        return mask

    def _corners_px(self, index: int) -> np.ndarray:
        x, y = self._place(index)
        side = [1, -1, -1, 1]
        corners = [
            (x, y + s * BOARD_HALF_WIDTH_M, z)
            for s, z in zip(side, [BOARD_TOP_M, BOARD_TOP_M, 0.0, 0.0], strict=True)
        ]
        T_left_world = invert(self.pose(index) @ MOUNT.T_base_left)
        return CAMERA.project(transform_points(T_left_world, np.array(corners)))

    def _draw(self, image: np.ndarray, corners_px: np.ndarray) -> None:
        height, width = self._texture.shape
        flat = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
        H = cv2.getPerspectiveTransform(flat, corners_px.astype(np.float32))
        size = (CAMERA.width, CAMERA.height)
        drawn = cv2.warpPerspective(self._texture, H, size, flags=cv2.INTER_LINEAR)
        inside = cv2.warpPerspective(np.full_like(self._texture, 255), H, size)
        image[inside > 127] = drawn[inside > 127]
