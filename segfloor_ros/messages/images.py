"""Images as messages. Sizes are checked against the data before anything is copied."""

from __future__ import annotations

import array

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from segfloor_ros.messages.errors import MessageError
from segfloor_ros.messages.headers import make_header

MAX_PIXELS = 50_000_000

_ENCODINGS: dict[str, tuple[str, int]] = {
    'mono8': ('u1', 1),
    '8UC1': ('u1', 1),
    'mono16': ('u2', 1),
    '16UC1': ('u2', 1),
    '32FC1': ('f4', 1),
    'bgr8': ('u1', 3),
    'rgb8': ('u1', 3),
    '8UC3': ('u1', 3),
    'bgra8': ('u1', 4),
    'rgba8': ('u1', 4),
    'bayer_rggb8': ('u1', 1),
    'bayer_bggr8': ('u1', 1),
    'bayer_gbrg8': ('u1', 1),
    'bayer_grbg8': ('u1', 1),
}


def image_message(
    stamp_ns: int, frame_id: str, image: NDArray[np.generic], encoding: str = 'mono8'
) -> Image:
    """Return an image (H, W) or (H, W, C) as a message. The array's type must suit the encoding."""
    code, channels = _ENCODINGS[encoding]
    pixels = np.ascontiguousarray(image, np.dtype('<' + code))
    height, width = pixels.shape[:2]
    return Image(
        header=make_header(stamp_ns, frame_id),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=width * channels * pixels.itemsize,
        data=array.array('B', pixels.tobytes()),
    )


def image_array(message: Image, topic: str) -> NDArray[np.generic]:
    """Return the pixels (H, W) or (H, W, C) of a message, without padding.

    Raises MessageError, naming the topic, for an unknown encoding or sizes that contradict.
    """
    if message.encoding not in _ENCODINGS:
        raise MessageError(
            f'{topic}: images of encoding {message.encoding!r} are not taken; publish one of '
            + ', '.join(_ENCODINGS)
        )
    code, channels = _ENCODINGS[message.encoding]
    dtype = np.dtype(('>' if message.is_bigendian else '<') + code)
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * channels * dtype.itemsize
    if not 0 < height * width <= MAX_PIXELS or step < row_bytes:
        raise MessageError(f'{topic}: an image of {width}x{height} with rows of {step} bytes')
    if len(message.data) != height * step:
        raise MessageError(
            f'{topic}: {len(message.data)} bytes do not make {height} rows of {step} bytes'
        )
    rows = np.frombuffer(message.data, np.uint8).reshape(height, step)[:, :row_bytes]
    pixels = np.ascontiguousarray(rows).view(dtype).astype(dtype.newbyteorder('='), copy=False)
    return pixels if channels == 1 else pixels.reshape(height, width, channels)
