"""Images as messages."""

from __future__ import annotations

import array
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage, Image

from segfloor_ros.camera.images import Grey, decode_compressed, decode_depth, decode_raw
from segfloor_ros.errors import InputError
from segfloor_ros.messages.errors import MessageError
from segfloor_ros.messages.headers import make_header

MAX_PIXELS = 50_000_000
ENCODINGS = {'mono8': np.uint8, 'mono16': np.uint16, '32FC1': np.float32, 'bgr8': np.uint8}
"""What this package publishes."""

ENCODING_OF = {np.uint8: 'mono8', np.uint16: 'mono16', np.float32: '32FC1'}


def image_message(
    stamp_ns: int, frame_id: str, image: NDArray[np.generic], encoding: str = ''
) -> Image:
    """Return an image (H, W), or (H, W, 3) with its encoding, as a message; grey images of 8 and 16
    bits and disparities, float32, need none.
    """
    if not encoding:
        encoding = ENCODING_OF[image.dtype.type]
    assert image.dtype == ENCODINGS[encoding], (image.dtype, encoding)
    pixels = np.ascontiguousarray(image)
    height, width = pixels.shape[:2]
    return Image(
        header=make_header(stamp_ns, frame_id),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=pixels.strides[0],
        data=array.array('B', pixels.tobytes()),
    )


def compressed_message(
    stamp_ns: int, frame_id: str, image: NDArray[np.generic], jpeg_quality: int | None
) -> CompressedImage:
    """Return a grey image (H, W) as a message as image_transport makes it: JPEG of a quality of
    1 to 100, or PNG, without loss, where that is None or the image has 16 bits.
    """
    kind = 'png' if jpeg_quality is None or image.dtype == np.uint16 else 'jpeg'
    options = [] if kind == 'png' else [cv2.IMWRITE_JPEG_QUALITY, int(jpeg_quality or 0)]
    _, data = cv2.imencode(f'.{kind}', np.ascontiguousarray(image), options)
    encoding = 'mono16' if image.dtype == np.uint16 else 'mono8'
    return CompressedImage(
        header=make_header(stamp_ns, frame_id),
        format=f'{encoding}; {kind} compressed {encoding}',
        data=array.array('B', data.tobytes()),
    )


def grey_image(message: Image | CompressedImage, topic: str) -> Grey:
    """Return the grey image (H, W) of a message, uint8 or uint16; colour becomes grey.

    Raises MessageError, naming the topic, for an encoding that is no picture, sizes that
    contradict the data, and damaged files.
    """
    if isinstance(message, CompressedImage):
        return _grey_of_file(message, topic)
    width, height = int(message.width), int(message.height)
    if width * height > MAX_PIXELS:
        raise MessageError(f'{topic}: an image of {width}x{height} pixels is not taken')
    try:
        return decode_raw(
            np.frombuffer(message.data, np.uint8),
            width=width,
            height=height,
            encoding=message.encoding,
            step=int(message.step),
            is_bigendian=bool(message.is_bigendian),
        )
    except InputError as error:
        raise MessageError(f'{topic}: {error}') from None


def grey8_image(message: Image, topic: str) -> NDArray[np.uint8]:
    """Return the grey image (H, W) of a message of 8 bits. Raises MessageError."""
    image = grey_image(message, topic)
    if image.dtype != np.uint8:
        raise MessageError(f'{topic}: {message.encoding} has 16 bits, expected mono8')
    return image.astype(np.uint8, copy=False)


def right_image(message: Image, topic: str) -> NDArray[Any]:
    """Return the right image (H, W) uint8 of a message; of a depth camera the disparity (H, W)
    float32 in its place. Raises MessageError.
    """
    if message.encoding != '32FC1':
        return grey8_image(message, topic)
    return depth_image(message, topic)


def depth_image(message: Image, topic: str) -> NDArray[np.uint16] | NDArray[np.float32]:
    """Return the depth image (H, W) of a message: uint16 in mm or float32 in metres.

    Raises MessageError.
    """
    try:
        return decode_depth(
            np.frombuffer(message.data, np.uint8),
            width=int(message.width),
            height=int(message.height),
            encoding=message.encoding,
            step=int(message.step),
            is_bigendian=bool(message.is_bigendian),
        )
    except InputError as error:
        raise MessageError(f'{topic}: {error}') from None


def _grey_of_file(message: CompressedImage, topic: str) -> Grey:
    try:
        image = decode_compressed(bytes(message.data))
    except InputError as error:
        raise MessageError(f'{topic}: {error}') from None
    if image.size > MAX_PIXELS:
        rows, columns = image.shape
        raise MessageError(f'{topic}: an image of {columns}x{rows} pixels is not taken')
    return image
