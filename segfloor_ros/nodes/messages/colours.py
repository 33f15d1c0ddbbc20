"""Images in colour out of messages."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from segfloor_ros.core.camera.images import colour_image
from segfloor_ros.core.errors import InputError
from segfloor_ros.nodes.messages.images import _eight_bit


def colour8_image(message: Image, topic: str) -> NDArray[np.uint8]:
    """Return the image of a message of 8 bits, (H, W, 3) BGR, or (H, W) where it has no colours.
    Raises InputError.
    """
    return _eight_bit(colour_image(message, topic), message, topic)


def bgr_image(message: Image, topic: str) -> NDArray[np.uint8]:
    """Return the picture (H, W, 3) of a message of encoding bgr8. Raises InputError."""
    row = np.frombuffer(message.data, np.uint8)
    if message.encoding != 'bgr8' or len(row) != message.height * message.width * 3:
        raise InputError(f'{topic}: {message.encoding} or its size is not that of a bgr8 picture')
    return row.reshape(message.height, message.width, 3)
