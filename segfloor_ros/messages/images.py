"""Images, their calibrations, and the floor seen in them as messages: mask, disparity, scan."""

from __future__ import annotations

import array
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, LaserScan
from stereo_msgs.msg import DisparityImage

from segfloor_ros.camera.calibration.parameters import EyeCalibration, StereoCalibration
from segfloor_ros.camera.images import depth_image, grey_image
from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.errors import InputError
from segfloor_ros.floor.observation import FloorObservation, FloorScan, free_ranges
from segfloor_ros.messages.topics import make_header

ENCODING_OF = {np.uint8: 'mono8', np.uint16: 'mono16', np.float32: '32FC1'}


def image_message(
    stamp_ns: int, frame_id: str, image: NDArray[np.generic], encoding: str = ''
) -> Image:
    """Return an image (H, W), or (H, W, 3) with its encoding, as a message; grey images of 8 and 16
    bits and disparities, float32, need none.
    """
    if not encoding:
        encoding = ENCODING_OF[image.dtype.type]
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


def grey8_image(message: Image, topic: str) -> NDArray[np.uint8]:
    """Return the grey image (H, W) of a message of 8 bits. Raises InputError."""
    image = grey_image(message, topic)
    if image.dtype != np.uint8:
        raise InputError(f'{topic}: {message.encoding} has 16 bits, expected mono8')
    return image.astype(np.uint8, copy=False)


def bgr_image(message: Image, topic: str) -> NDArray[np.uint8]:
    """Return the picture (H, W, 3) of a message of encoding bgr8. Raises InputError."""
    row = np.frombuffer(message.data, np.uint8)
    if message.encoding != 'bgr8' or len(row) != message.height * message.width * 3:
        raise InputError(f'{topic}: {message.encoding} or its size is not that of a bgr8 picture')
    return row.reshape(message.height, message.width, 3)


def right_image(message: Image, topic: str) -> NDArray[Any]:
    """Return the right image (H, W) uint8 of a message; of a depth camera the disparity (H, W)
    float32 in its place. Raises InputError.
    """
    if message.encoding != '32FC1':
        return grey8_image(message, topic)
    return depth_image(message, topic)


def camera_info_message(stamp_ns: int, frame_id: str, eye: EyeCalibration) -> CameraInfo:
    """Return the calibration of one eye; both eyes carry the left optical frame (REP-104: the
    right one's offset stands in P[3]).
    """
    return CameraInfo(
        header=make_header(stamp_ns, frame_id),
        width=int(eye.width),
        height=int(eye.height),
        distortion_model=eye.distortion_model,
        d=array.array('d', np.asarray(eye.D, np.float64).tobytes()),
        k=np.asarray(eye.K, np.float64).ravel(),
        r=np.asarray(eye.R, np.float64).ravel(),
        p=np.asarray(eye.P, np.float64).ravel(),
    )


def same_calibration(a: CameraInfo, b: CameraInfo) -> bool:
    """Return whether two messages hold the same calibration."""
    sizes = ((a.width, a.height), (b.width, b.height))
    return (
        sizes[0] == sizes[1]
        and a.distortion_model == b.distortion_model
        and all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ('d', 'k', 'r', 'p'))
    )


def rectified_calibration(camera: StereoCamera) -> StereoCalibration:
    """Return the calibration of rectified images of a camera."""
    P = np.zeros((3, 4))
    P[:, :3] = camera.K
    left = EyeCalibration.of_rectified(camera.width, camera.height, P)
    P[0, 3] = -camera.disparity_times_depth
    right = EyeCalibration.of_rectified(camera.width, camera.height, P)
    return StereoCalibration(left, right)


def disparity_message(
    stamp_ns: int, frame_id: str, camera: StereoCamera, floor: FloorObservation
) -> DisparityImage:
    """Return the disparity image: Z = f * t / d; 0 where there is no match."""
    message = DisparityImage(
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


def scan_message(stamp_ns: int, frame_id: str, scan: FloorScan) -> LaserScan:
    """Return the floor scan in the base's plane: how far the floor was seen, per bearing. The
    distances of upright things go into `intensities`, which stay empty where they are not known;
    `range_max` is the range whose error is 0.3 m, one sigma.
    """
    ranges = np.ascontiguousarray(scan.ranges_m, np.float32)
    obstacles = scan.obstacle_m if scan.obstacle_m is not None else np.zeros(0, np.float32)
    steps = max(len(ranges) - 1, 0)
    return LaserScan(
        header=make_header(stamp_ns, frame_id),
        angle_min=float(scan.angle_min_rad),
        angle_max=float(scan.angle_min_rad + steps * scan.angle_increment_rad),
        angle_increment=float(scan.angle_increment_rad),
        range_min=0.0,
        range_max=float(scan.range_max_m),
        ranges=array.array('f', ranges.tobytes()),
        intensities=array.array('f', np.ascontiguousarray(obstacles, np.float32).tobytes()),
    )


def free_scan_message(stamp_ns: int, frame_id: str, scan: FloorScan) -> LaserScan:
    """Return how far the floor is free per bearing, in the base's plane, for a costmap to clear:
    see `free_ranges`.
    """
    message = scan_message(stamp_ns, frame_id, scan)
    message.ranges = array.array('f', free_ranges(scan).tobytes())
    message.intensities = array.array('f')
    return message


def scan_arrays(message: LaserScan, topic: str) -> FloorScan:
    """Return the floor scan of a message. Raises InputError, naming the topic."""
    if not message.range_max > 0:
        raise InputError(f'{topic}: range_max of the scan is {message.range_max:g} m')
    if not np.isfinite([message.angle_min, message.angle_increment]).all():
        raise InputError(f'{topic}: the angles of the scan are not finite')
    ranges = np.frombuffer(message.ranges, np.float32).copy()
    obstacles = np.frombuffer(message.intensities, np.float32).copy()
    if len(obstacles) not in (0, len(ranges)):
        raise InputError(f'{topic}: {len(ranges)} ranges, but {len(obstacles)} intensities')
    return FloorScan(
        float(message.angle_min),
        float(message.angle_increment),
        ranges,
        obstacles if len(obstacles) else None,
        float(message.range_max),
    )
