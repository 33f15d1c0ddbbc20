"""What a camera publishes besides raw images: calibrations and compressed images."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.nodes.messages.making import Make, Message, make_header, ros_message

WHOLE_IMAGE = {'x_offset': 0, 'y_offset': 0, 'height': 0, 'width': 0, 'do_rectify': False}


def camera_info_message(
    stamp_ns: int, frame_id: str, eye: EyeCalibration, make: Make = ros_message
) -> Message:
    """Return the calibration of one eye; both eyes carry the left optical frame (REP-104: the
    right one's offset stands in P[3]). A part of an image has a roi as large as itself.
    """
    part = {'height': eye.height, 'width': eye.width} if eye.is_part else {}
    arrays = {name: np.asarray(getattr(eye, name.upper()), np.float64).ravel() for name in 'dkrp'}
    return make(
        'sensor_msgs/msg/CameraInfo',
        header=make_header(stamp_ns, frame_id, make),
        width=int(eye.width),
        height=int(eye.height),
        distortion_model=eye.distortion_model,
        **arrays,
        binning_x=0,
        binning_y=0,
        roi=make('sensor_msgs/msg/RegionOfInterest', **WHOLE_IMAGE | part),
    )


def same_calibration(a: Message, b: Message) -> bool:
    """Return whether two messages hold the same calibration, of the same part of the image."""
    plain = ('width', 'height', 'distortion_model', 'binning_x', 'binning_y', 'roi')
    return all(getattr(a, name) == getattr(b, name) for name in plain) and all(
        np.array_equal(getattr(a, name), getattr(b, name)) for name in ('d', 'k', 'r', 'p')
    )


def rectified_calibration(camera: StereoCamera) -> StereoCalibration:
    """Return the calibration of rectified images of a camera."""
    P = np.hstack([camera.K, np.zeros((3, 1))])
    is_part = not (0 < camera.cx < camera.width and 0 < camera.cy < camera.height)
    of_size = partial(EyeCalibration.of_rectified, camera.width, camera.height, is_part=is_part)
    left = of_size(P)
    P[0, 3] = -camera.disparity_times_depth
    return StereoCalibration(left, of_size(P))


def compressed_message(
    stamp_ns: int,
    frame_id: str,
    image: NDArray[np.generic],
    jpeg_quality: int | None,
    make: Make = ros_message,
) -> Message:
    """Return a grey image (H, W) as a message as image_transport makes it: JPEG of a quality of
    1 to 100, or PNG, without loss, where that is None or the image has 16 bits.
    """
    kind = 'png' if jpeg_quality is None or image.dtype == np.uint16 else 'jpeg'
    options = [] if kind == 'png' else [cv2.IMWRITE_JPEG_QUALITY, int(jpeg_quality or 0)]
    _, data = cv2.imencode(f'.{kind}', np.ascontiguousarray(image), options)
    encoding = 'mono16' if image.dtype == np.uint16 else 'mono8'
    return make(
        'sensor_msgs/msg/CompressedImage',
        header=make_header(stamp_ns, frame_id, make),
        format=f'{encoding}; {kind} compressed {encoding}',
        data=data.ravel(),
    )
