"""Images out of ROS messages, of `rclpy` as well as of `rosbags`: encodings are decoded, colours
become grey where grey is asked for, and 16 bits are brought to 8.
"""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.pixels import Grey, check_size
from segfloor_ros.core.errors import CorruptImageError, InputError

USUAL_BIT_DEPTHS = (8, 10, 12, 14, 16)

# OpenCV names a Bayer pattern by the second pixel of the second row, ROS by the first of the first.
BAYER_CODES = {
    'rggb': cv2.COLOR_BayerBG2GRAY,
    'bggr': cv2.COLOR_BayerRG2GRAY,
    'gbrg': cv2.COLOR_BayerGR2GRAY,
    'grbg': cv2.COLOR_BayerGB2GRAY,
}
CHANNELS = {
    'mono8': 1, 'mono16': 1, '8UC1': 1, '16UC1': 1, 'rgb8': 3, 'bgr8': 3, '8UC3': 3, 'rgba8': 4,
    'bgra8': 4, '8UC4': 4, 'rgb16': 3, 'bgr16': 3, '16UC3': 3, 'rgba16': 4, 'bgra16': 4,
    'yuv422': 2, 'uyvy': 2, 'yuv422_yuy2': 2, 'yuyv': 2,
    **{f'bayer_{pattern}{bits}': 1 for pattern in BAYER_CODES for bits in (8, 16)},
}  # fmt: skip
"""Channels by encoding, as in `sensor_msgs/image_encodings.hpp` and cv_bridge's generic names."""


CLEARLY, LEAST_CONTRAST, SMOOTH_SHARE = 2.0, 10.0, 0.25
"""Brightness has so many times the contrast of colours, in grey levels more than noise has; from
pixel to pixel it changes by less than this share of that."""

NO_COLOUR, COLOUR_REACH = 128.0, 24.0
"""What U and V are without a colour, and how far their mean over an image is from that."""

DEPTH_TYPES = {'16UC1': np.uint16, 'mono16': np.uint16, '32FC1': np.float32}

DEPTH_HEADER = struct.Struct('<iff')
"""What compressed_depth_image_transport writes before the PNG: a format, and for depth in metres a
and b of the pixel's value a / depth + b."""


def grey_image(message: Any, name: str) -> Grey:
    """Return the grey image (H, W) of a sensor_msgs Image or CompressedImage, of `rclpy` or of
    `rosbags`; colour becomes grey.

    Raises, naming the topic or file, InputError for an encoding that is no picture and
    CorruptImageError when the data is damaged or not of the size the header says.
    """
    if not hasattr(message, 'encoding'):
        return _decoded(message.data, name)
    encoding = message.encoding
    if encoding not in CHANNELS:
        raise InputError(
            f'{name}: image encoding {encoding} is not supported; known are mono8, rgb8, …'
        )
    dtype = np.dtype(np.uint16 if '16' in encoding else np.uint8)
    return _grey_of(_unpacked(message, name, CHANNELS[encoding], dtype), encoding)


def colour_image(message: Any, name: str) -> Grey:
    """Return the image of a message as `grey_image`, but (H, W, 3), BGR, where it has colours."""
    if not hasattr(message, 'encoding'):
        return _decoded(message.data, name, colour=True)
    encoding = message.encoding
    if CHANNELS.get(encoding, 1) == 1 and not encoding.startswith('bayer_'):
        return grey_image(message, name)
    dtype = np.dtype(np.uint16 if '16' in encoding else np.uint8)
    channels = CHANNELS[encoding]
    pixels = _unpacked(message, name, channels, dtype)
    kind = encoding[6:10] if encoding.startswith('bayer_') else encoding.rstrip('0123456789UC')
    if channels == 2:
        kind = ('yuyv', 'uyvy')[_luma_of(pixels, encoding)]
    return cv2.cvtColor(pixels, TO_BGR[kind]) if kind in TO_BGR else pixels[:, :, :3]


def depth_image(message: Any, name: str) -> NDArray[np.uint16] | NDArray[np.float32]:
    """Return the depth image (H, W) of a sensor_msgs Image (REP-118), or of a CompressedImage of
    compressed_depth_image_transport: uint16 in mm or float32 in metres. Raises as `grey_image`.
    """
    if not hasattr(message, 'encoding'):
        return _unpacked_depth(message, name)
    if message.encoding not in DEPTH_TYPES:
        raise InputError(
            f'{name}: encoding {message.encoding} is no depth; depth images are 16UC1 (mm) or '
            '32FC1 (m)'
        )
    return _unpacked(message, name, 1, np.dtype(DEPTH_TYPES[message.encoding]))[:, :, 0]


def _unpacked_depth(message: Any, name: str) -> NDArray[np.uint16] | NDArray[np.float32]:
    encoding, _, transport = message.format.partition(';')
    data = bytes(message.data)
    if encoding not in DEPTH_TYPES or 'compressedDepth' not in transport or 'rvl' in transport:
        raise InputError(
            f'{name}: format "{message.format}" is no depth; it must be compressedDepth of 16UC1 '
            'or 32FC1 as png'
        )
    if len(data) < DEPTH_HEADER.size:
        raise CorruptImageError(f'{name}: {len(data)} bytes are no compressed depth image')
    _, scale, offset = DEPTH_HEADER.unpack_from(data)
    pixels = _decoded(data[DEPTH_HEADER.size :], name).astype(np.uint16, copy=False)
    if DEPTH_TYPES[encoding] == np.uint16:
        return pixels
    with np.errstate(divide='ignore'):
        metres = np.float32(scale) / (pixels.astype(np.float32) - np.float32(offset))
    return np.where(pixels > 0, metres, np.float32(np.nan))


def _decoded(data: Any, name: str, colour: bool = False) -> Grey:
    """Return the image of the bytes of a compressed one; the decoders are loaded with the first."""
    from segfloor_ros.core.files.images import decode_colour, decode_file

    return (decode_colour if colour else decode_file)(bytes(data), name)


def _unpacked(message: Any, name: str, channels: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the pixels (H, W, channels) of a message; rows may be padded up to its `step`."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    check_size(width, height, name)
    row_bytes = width * channels * dtype.itemsize
    step = step or row_bytes  # some drivers leave it out
    buffer = np.frombuffer(message.data, np.uint8)
    if width <= 0 or height <= 0 or step < row_bytes or buffer.size != step * height:
        raise CorruptImageError(
            f'{name}: {buffer.size} bytes do not make a {width}x{height} {message.encoding} image '
            f'with a row step of {step}'
        )
    rows = np.ascontiguousarray(buffer.reshape(height, step)[:, :row_bytes])
    sent = dtype.newbyteorder('>' if message.is_bigendian else '<')
    pixels = rows.view(sent).astype(dtype, copy=False)
    return np.asarray(pixels.reshape(height, width, channels))


def to_grey(image: Grey) -> Grey:
    """Return the grey image (H, W) of a grey, BGR or BGRA image, 8 or 16 bit."""
    if image.ndim == 2:
        return image
    if image.shape[2] == 1:
        return image[:, :, 0]
    code = cv2.COLOR_BGRA2GRAY if image.shape[2] == 4 else cv2.COLOR_BGR2GRAY
    return cv2.cvtColor(image, code)


TO_BGR = {
    'rggb': cv2.COLOR_BayerBG2BGR, 'bggr': cv2.COLOR_BayerRG2BGR,
    'gbrg': cv2.COLOR_BayerGR2BGR, 'grbg': cv2.COLOR_BayerGB2BGR,
    'rgb': cv2.COLOR_RGB2BGR, 'rgba': cv2.COLOR_RGBA2BGR,
    'uyvy': cv2.COLOR_YUV2BGR_UYVY, 'yuyv': cv2.COLOR_YUV2BGR_YUY2,
}  # fmt: skip
"""How encodings that are not BGR become it, by the encoding without its numbers."""


class EightBitScale:
    """Brings grey pairs of 16 bits to 8 by one curve for the whole recording: the square root.

    The noise of light grows with the root of its amount, so that one step of the result is the same
    part of the noise everywhere, and dark floors keep theirs below bright lamps (Anscombe, The
    transformation of Poisson, binomial and negative-binomial data, 1948). A scale per image would
    change the brightness of the same point from frame to frame. The number of bits in use is
    the smallest usual one that holds all pairs so far: a recording may begin in the dark.
    """

    def __init__(self) -> None:
        self._use(0)

    def __call__(self, left: Grey, right: Grey) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return both images (H, W) as uint8; 8-bit images pass through."""
        deep = [int(image.max()) for image in (left, right) if image.dtype == np.uint16]
        if deep and max(deep) >= 1 << self._bit_depth:
            self._use(next(bits for bits in USUAL_BIT_DEPTHS if max(deep) < 1 << bits))
        return self._scaled(left), self._scaled(right)

    def _use(self, bit_depth: int) -> None:
        self._bit_depth = bit_depth
        brightest = (1 << bit_depth) - 1
        share = np.minimum(np.arange(1 << 16), brightest) / max(brightest, 1)
        # Eight bits in sixteen are those of a camera that has brought them to 8 itself.
        curve = np.sqrt(share) if bit_depth > 8 else share
        self._table = np.rint(255 * curve).astype(np.uint8)

    def _scaled(self, image: Grey) -> NDArray[np.uint8]:
        return self._table[image] if image.dtype == np.uint16 else np.asarray(image, np.uint8)


def _grey_of(pixels: Grey, encoding: str) -> Grey:
    if encoding.startswith('bayer_'):
        return cv2.cvtColor(pixels[:, :, 0], BAYER_CODES[encoding[6:10]])
    if CHANNELS[encoding] == 2:
        return pixels[:, :, _luma_of(pixels, encoding)].copy()
    if encoding.startswith('rgb'):
        code = cv2.COLOR_RGBA2GRAY if pixels.shape[2] == 4 else cv2.COLOR_RGB2GRAY
        return cv2.cvtColor(pixels, code)
    return to_grey(pixels)


def _luma_of(pixels: Grey, encoding: str) -> int:
    """Return which of both channels (H, W, 2) is the brightness: that of the encoding unless it
    looks like colours and the other one does not, as drivers mix UYVY and YUYV up. The colours U
    and V take turns along a row, around 128; brightness hardly changes from pixel to pixel.
    """
    declared = int(encoding in ('yuv422', 'uyvy'))
    rows = pixels[::8].astype(np.float32)
    even, odd = rows[:, : rows.shape[1] // 2 * 2 : 2], rows[:, 1::2]
    contrast = even.std(axis=(0, 1)) + odd.std(axis=(0, 1))
    other = 1 - declared
    steps = float(np.abs(even[:, :, other] - odd[:, :, other]).mean())
    is_mixed_up = (
        abs(float(rows[:, :, declared].mean()) - NO_COLOUR) < COLOUR_REACH
        and contrast[other] > max(CLEARLY * contrast[declared], LEAST_CONTRAST)
        and steps < SMOOTH_SHARE * contrast[other]
    )
    return other if is_mixed_up else declared
