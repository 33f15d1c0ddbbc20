"""Masks of what moves, as a segmentation network wrote them, for the frames of a recording."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.errors import InputError


class MaskFolder:
    """Masks `%06d.png` by frame index, of the left image as recorded, 255 = moving. A frame
    without a file has nothing that moves.
    """

    def __init__(self, folder: Path, camera: StereoCamera) -> None:
        if not folder.is_dir():
            raise InputError(f'{folder}: no such folder; give --masks a folder of %06d.png')
        if next(folder.glob('[0-9]*.png'), None) is None:
            raise InputError(f'{folder}: holds no masks; they are named by frame, e.g. 000012.png')
        self._folder = folder
        self._shape = (camera.height, camera.width)

    def read(self, index: int) -> NDArray[np.uint8] | None:
        """Return the mask (H, W) uint8 of a frame, or None where there is none.

        Raises InputError for a file that is no such mask.
        """
        path = self._folder / f'{index:06d}.png'
        if not path.exists():
            return None
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if mask is None:
            raise InputError(f'{path}: is no image; masks are PNG files, 255 = moving')
        if mask.shape != self._shape:
            found, expected = (f'{shape[1]}x{shape[0]}' for shape in (mask.shape, self._shape))
            raise InputError(f'{path}: is {found}, but the images are {expected}')
        return np.asarray(mask, np.uint8)
