"""Images and disparities as messages, and out of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.images import depth_image, grey_image
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import FloorObservation
from segfloor_ros.core.errors import InputError
from segfloor_ros.nodes.messages.making import Make, Message, make_header, ros_message

ENCODING_OF = {np.uint8: 'mono8', np.uint16: 'mono16', np.float32: '32FC1'}


def image_message(
    stamp_ns: int, frame_id: str, image: NDArray[Any], encoding: str = '', make: Make = ros_message
) -> Message:
    """Return an image (H, W), or (H, W, 3) with its encoding, as a message; grey images of 8 and 16
    bits and disparities, float32, need none.
    """
    pixels = np.ascontiguousarray(image)
    height, width = pixels.shape[:2]
    return make(
        'sensor_msgs/msg/Image',
        header=make_header(stamp_ns, frame_id, make),
        height=height,
        width=width,
        encoding=encoding or ENCODING_OF[image.dtype.type],
        is_bigendian=0,
        step=pixels[0].nbytes,
        data=pixels.ravel().view(np.uint8),
    )


def grey8_image(message: Message, topic: str) -> NDArray[np.uint8]:
    """Return the grey image (H, W) of a message of 8 bits. Raises InputError."""
    return _eight_bit(grey_image(message, topic), message, topic)


def _eight_bit(image: NDArray[Any], message: Message, topic: str) -> NDArray[np.uint8]:
    if image.dtype != np.uint8:
        raise InputError(f'{topic}: {message.encoding} has 16 bits, expected 8')
    return image.astype(np.uint8, copy=False)


def right_image(message: Message, topic: str) -> NDArray[Any]:
    """Return the right image (H, W) uint8 of a message; of a depth camera the disparity (H, W)
    float32 in its place. Raises InputError.
    """
    if message.encoding != '32FC1':
        return grey8_image(message, topic)
    return depth_image(message, topic)


def disparity_message(
    stamp_ns: int, frame_id: str, camera: StereoCamera, floor: FloorObservation
) -> Message:
    """Return the disparity image: Z = f * t / d; 0 where there is no match."""
    message = ros_message(
        'stereo_msgs/msg/DisparityImage',
        header=make_header(stamp_ns, frame_id),
        image=image_message(stamp_ns, frame_id, floor.disparity_px, '32FC1'),
        f=float(camera.fx),
        t=float(camera.baseline_m),
        min_disparity=0.0,
        max_disparity=float(floor.max_disparity_px),
        delta_d=1.0 / 16.0,
    )
    message.valid_window.width, message.valid_window.height = camera.width, camera.height
    return message
