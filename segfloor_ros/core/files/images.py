"""Image files: decoded whole or not at all, without a line of the decoders on standard error.

How many pixels a decoder takes is set in the package's `__init__`, before OpenCV is loaded.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.pixels import JPEG_QUALITY, Grey, check_size
from segfloor_ros.core.errors import CorruptImageError, InputError
from segfloor_ros.core.files.whole import read_bytes
from segfloor_ros.core.standard_error import silent_libraries

PNG_SIGNATURE = b'\x89PNG\r\n\x1a\n'
JPEG_START, JPEG_END = b'\xff\xd8', b'\xff\xd9'

GREY = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
COLOUR = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION


def read_grey(path: Path) -> Grey:
    """Return the grey image (H, W), uint8 or uint16, of a file.

    Raises CorruptImageError naming the file when it is truncated or damaged, InputError when it
    cannot be read.
    """
    return decode_file(read_bytes(path), str(path))


def read_colour(path: Path) -> Grey:
    """Return the image of a file as `read_grey`, but (H, W, 3), BGR, where it has colours."""
    return decode_colour(read_bytes(path), str(path))


def read_depth(path: Path) -> NDArray[Any]:
    """Return the depth image (H, W) of a file, also of floats; errors as of `read_grey`."""
    return _decoded(read_bytes(path), str(path), GREY, (np.uint8, np.uint16, np.float32))


def read_mask(path: Path) -> NDArray[np.uint8]:
    """Return the mask (H, W) of an image file of 8 bits. Raises InputError."""
    return _eight_bit(read_grey(path), path)


def read_picture(path: Path) -> NDArray[np.uint8]:
    """Return the picture (H, W) or (H, W, C), BGR, of an image file of 8 bits, as it is. Raises
    InputError.
    """
    return _eight_bit(_decoded(read_bytes(path), str(path), cv2.IMREAD_UNCHANGED), path)


def decode_file(data: bytes, name: str) -> Grey:
    """Return the grey image of the bytes of a PNG, JPEG or other image file.

    Raises CorruptImageError, naming it, when it is truncated or damaged, also where a decoder would
    make up the missing part.
    """
    return _decoded(data, name, GREY)


def png_bytes(image: NDArray[Any]) -> bytes:
    """Return an image (H, W) or (H, W, 3), BGR, as a PNG file."""
    return cv2.imencode('.png', image)[1].tobytes()


def jpeg_bytes(image: NDArray[np.uint8], quality: int = JPEG_QUALITY) -> bytes:
    """Return an image (H, W) or (H, W, 3), BGR, as a JPEG file."""
    return cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def decode_colour(data: bytes, name: str) -> Grey:
    """Return the image of the bytes of a file as `decode_file`, BGR where it has colours."""
    return _decoded(data, name, COLOUR)


def check_same_size(image: NDArray[Any], shape: tuple[int, ...], path: Path) -> None:
    """Raise InputError unless the image of a file has the shape of the one it belongs to."""
    if image.shape[:2] != shape[:2]:
        found, expected = (f'{width}x{height}' for height, width in (image.shape[:2], shape[:2]))
        raise InputError(f'{path}: is {found}, but the image it belongs to is {expected}')


def _eight_bit(image: NDArray[Any], path: Path) -> NDArray[np.uint8]:
    if image.dtype != np.uint8:
        raise InputError(f'{path}: has 16 bits per pixel, expected 8')
    return image


def _decoded(
    data: bytes, name: str, flags: int, kinds: tuple[type, ...] = (np.uint8, np.uint16)
) -> NDArray[Any]:
    _check_complete(data, name)
    try:
        with silent_libraries():
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise CorruptImageError(f'{name}: the image cannot be decoded')
    if image.dtype not in kinds:
        expected = ' or '.join(np.dtype(kind).name for kind in kinds)
        raise CorruptImageError(f'{name}: pixels are {image.dtype}, expected {expected}')
    check_size(image.shape[1], image.shape[0], name)
    return image


def _check_complete(data: bytes, name: str) -> None:
    if not data:
        raise CorruptImageError(f'{name}: the image is empty')
    # Cameras pad their JPEGs with zeros.
    if data.startswith(JPEG_START) and JPEG_END not in data.rstrip(b'\0')[-64:]:
        raise CorruptImageError(f'{name}: the JPEG is truncated')
    if data.startswith(PNG_SIGNATURE):
        _check_png(data, name)


def _check_png(data: bytes, name: str) -> None:
    """Walk over the chunks (length, type, data, CRC; ISO/IEC 15948) up to the end mark."""
    position = len(PNG_SIGNATURE)
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], 'big')
        end = position + 8 + length
        if end + 4 > len(data):
            break
        checksum = int.from_bytes(data[end : end + 4], 'big')
        if zlib.crc32(data[position + 4 : end]) != checksum:
            raise CorruptImageError(f'{name}: the PNG is damaged')
        if data[position + 4 : position + 8] == b'IEND':
            return
        position = end + 4
    raise CorruptImageError(f'{name}: the PNG is truncated')
