"""Drawing textures at any number of positions, for tests that cast rays."""

import cv2
import numpy as np

WIDTH_PX = 1024
"""OpenCV draws pictures of up to 32,767 columns: positions are folded into rows of this length."""


def drawn(texture: np.ndarray, x: np.ndarray, y: np.ndarray, border: int) -> np.ndarray:
    """Return a texture (S, S) float32 at positions (N,) in pixels, interpolated, (N,).

    border: how the texture goes on beyond its edges, as in OpenCV.
    """
    shape = (len(x) // WIDTH_PX + 1, WIDTH_PX)
    at = np.zeros((2, *shape), np.float32)
    at.reshape(2, -1)[:, : len(x)] = x, y
    return cv2.remap(texture, *at, cv2.INTER_LINEAR, borderMode=border).ravel()[: len(x)]
