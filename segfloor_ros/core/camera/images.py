"""Images as grey pixels, and what else ROS messages say, of `rclpy` as well as of `rosbags`.

Encodings are decoded, 16 bits brought to 8, and the black border is found that rectification
leaves: nothing was seen there. Messages tell calibrations and what wheels and IMUs have measured.

Depth images as disparities: a depth camera is taken for a stereo pair whose right image is not
there, but whose disparities are.

Where a stereo frame has a right image, that of a depth camera has the disparity (H, W) float32 in
pixels over a virtual baseline, not a number where nothing was measured. Active stereo and
structured light measure disparities, too: their noise is about constant in this form.
"""

from __future__ import annotations

import dataclasses
import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros import MAX_PIXELS
from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.pixels import Disparity
from segfloor_ros.core.contracts import ImuSample, WheelPose
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.images import (
    CorruptImageError,
    Grey,
    check_size,
    decode_colour,
    decode_file,
)
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.quaternions import transform_from_quaternion

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


DEPTH_TYPES = {'16UC1': np.uint16, 'mono16': np.uint16, '32FC1': np.float32}

DEPTH_HEADER = struct.Struct('<iff')
"""What compressed_depth_image_transport writes before the PNG: a format, and for depth in metres a
and b of the pixel's value a / depth + b."""


NOT_MEASURED = -1.0
"""First element of a covariance of what an IMU does not measure (sensor_msgs/Imu)."""

VIRTUAL_BASELINE_M = 0.075
"""Between projector and camera of the first depth cameras; any value would do."""


def grey_image(message: Any, name: str) -> Grey:
    """Return the grey image (H, W) of a sensor_msgs Image or CompressedImage, of `rclpy` or of
    `rosbags`; colour becomes grey.

    Raises, naming the topic or file, InputError for an encoding that is no picture and
    CorruptImageError when the data is damaged or not of the size the header says.
    """
    if not hasattr(message, 'encoding'):
        return decode_file(bytes(message.data), name)
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
        return decode_colour(bytes(message.data), name)
    encoding = message.encoding
    if CHANNELS.get(encoding, 1) == 1 and not encoding.startswith('bayer_'):
        return grey_image(message, name)
    dtype = np.dtype(np.uint16 if '16' in encoding else np.uint8)
    pixels = _unpacked(message, name, CHANNELS[encoding], dtype)
    kind = encoding[6:10] if encoding.startswith('bayer_') else encoding.rstrip('0123456789UC')
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
    pixels = decode_file(data[DEPTH_HEADER.size :], name).astype(np.uint16, copy=False)
    if DEPTH_TYPES[encoding] == np.uint16:
        return pixels
    with np.errstate(divide='ignore'):
        metres = np.float32(scale) / (pixels.astype(np.float32) - np.float32(offset))
    return np.where(pixels > 0, metres, np.float32(np.nan))


def _unpacked(message: Any, name: str, channels: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the pixels (H, W, channels) of a message; rows may be padded up to its `step`."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    check_size(width, height, name)
    row_bytes = width * channels * dtype.itemsize
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
    'yuv': cv2.COLOR_YUV2BGR_UYVY, 'uyvy': cv2.COLOR_YUV2BGR_UYVY,
    'yuv422_yuy': cv2.COLOR_YUV2BGR_YUY2, 'yuyv': cv2.COLOR_YUV2BGR_YUY2,
}  # fmt: skip
"""How encodings that are not BGR become it, by the encoding without its numbers."""


class EightBitScale:
    """Brings grey pairs of 16 bits to 8 by one curve for the whole recording: the square root.

    The noise of light grows with the root of its amount, so that one step of the result is the same
    part of the noise everywhere, and dark floors keep theirs below bright lamps (Anscombe, The
    transformation of Poisson, binomial and negative-binomial data, 1948). A scale per image would
    change the brightness of the same point from frame to frame. The number of bits in use is
    declared, or else the smallest usual one that holds all pairs so far: a recording may begin in
    the dark.
    """

    def __init__(self, bit_depth: int = 0) -> None:
        self._is_declared = bit_depth > 0
        self._use(bit_depth)

    def __call__(self, left: Grey, right: Grey) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return both images (H, W) as uint8; 8-bit images pass through."""
        deep = [int(image.max()) for image in (left, right) if image.dtype == np.uint16]
        if deep and not self._is_declared and max(deep) >= 1 << self._bit_depth:
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
    if encoding in ('yuv422', 'uyvy'):
        return pixels[:, :, 1].copy()
    if encoding in ('yuv422_yuy2', 'yuyv'):
        return pixels[:, :, 0].copy()
    if encoding.startswith('rgb'):
        code = cv2.COLOR_RGBA2GRAY if pixels.shape[2] == 4 else cv2.COLOR_RGB2GRAY
        return cv2.cvtColor(pixels, code)
    return to_grey(pixels)


def stamp_ns(message: Any) -> int:
    """Return the stamp in a message's header in ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def eye_calibration(info: Any, name: str) -> EyeCalibration:
    """Return the calibration of one eye of a CameraInfo. name: of the topic, for messages. Raises
    CalibrationError or InputError.
    """
    width, height = int(info.width), int(info.height)
    if width * height > MAX_PIXELS:
        raise InputError(f'{name}: a calibration of images of {width}x{height} pixels is not taken')
    # ROS 1 names the matrices in capitals, ROS 2 does not.
    K, D, R, P = (getattr(info, n if hasattr(info, n) else n.lower()) for n in 'KDRP')
    return EyeCalibration(width, height, K, D, R, P, info.distortion_model, name)


def wheel_pose(message: Any, name: str) -> WheelPose:
    """Return the pose that an Odometry of the wheels tells, NaN where it is none. name: of the
    topic.
    """
    pose = message.pose.pose
    try:
        T_wheels_base = rigid_motion(pose.position, pose.orientation, name)
    except InputError:
        T_wheels_base = np.full((4, 4), np.nan)
    return WheelPose(stamp_ns(message), T_wheels_base)


def imu_sample(message: Any, T_left_imu: Array) -> ImuSample:
    """Return a sample of an Imu at a pose (4, 4) in the rectified left optical frame."""
    gyro, accel = xyz(message.angular_velocity), xyz(message.linear_acceleration)
    return ImuSample.seen_from(T_left_imu, stamp_ns(message), gyro, accel)


def measures_motion(message: Any) -> bool:
    """Whether an Imu measures both angular velocity and acceleration."""
    covariances = message.angular_velocity_covariance, message.linear_acceleration_covariance
    return all(covariance[0] != NOT_MEASURED for covariance in covariances)


def rigid_motion(translation: Any, rotation: Any, name: str) -> Array:
    """Return the transform (4, 4) of a vector and a quaternion. Raises InputError where that is no
    rotation.
    """
    quat_xyzw = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
    length = float(np.linalg.norm(quat_xyzw))
    if not abs(length - 1) < 0.01:
        raise InputError(f'{name}: the orientation is no rotation; its length is {length:.3g}')
    return transform_from_quaternion(xyz(translation), quat_xyzw)


def xyz(vector: Any) -> Array:
    """Return the components (3,) of a vector or point."""
    return np.array([vector.x, vector.y, vector.z])


def depth_calibration(left: EyeCalibration) -> StereoCalibration:
    """Return the calibration of a depth camera whose depths are aligned with the raw left image: it
    is freed of its distortion, but not turned.
    """
    P = np.hstack([left.K, np.zeros((3, 1))])
    shift = np.array([[-left.K[0, 0] * VIRTUAL_BASELINE_M], [0.0], [0.0]])
    straight = dataclasses.replace(left, R=np.eye(3), P=P)
    virtual = EyeCalibration.of_rectified(
        left.width, left.height, np.hstack([left.K, shift]), left.origin
    )
    return StereoCalibration(straight, virtual)


def disparity_of_depth(
    depth: NDArray[np.generic], camera: StereoCamera, metres_per_unit: float | None = None
) -> Disparity:
    """Return the disparity (H, W) of a depth image (H, W): uint16, in mm unless said otherwise, or
    float32 in metres. What is 0, negative or not finite has none. Raises InputError.
    """
    if depth.dtype == np.uint16:
        metres = depth.astype(np.float32) * np.float32(metres_per_unit or 1e-3)
    elif depth.dtype == np.float32:
        metres = depth.astype(np.float32) * np.float32(metres_per_unit or 1.0)
    else:
        raise InputError(f'depth images have 16 bits (mm) or are float (m), not {depth.dtype}')
    with np.errstate(divide='ignore', invalid='ignore'):
        disparity = np.float32(camera.disparity_times_depth) / metres
    return np.where(np.isfinite(metres) & (metres > 0), disparity, np.float32(np.nan))
