"""Wheel odometry and IMU as messages: for the node `stereo_slam`."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Imu

from segfloor_ros.geometry import Array
from segfloor_ros.measurements import Measurement, WheelPose
from segfloor_ros.messages import qos
from segfloor_ros.messages.headers import to_ns
from segfloor_ros.messages.sensors import NOT_MEASURED, imu_sample, wheel_pose
from segfloor_ros.nodes.qos_check import offered_best_effort
from segfloor_ros.nodes.stage_node import AnyStageNode
from segfloor_ros.nodes.transforms import Transforms

WHEELS, IMU, TF_WHEELS = 'wheel_odometry', 'imu', 'odom → base_link'
MAX_LATE_S = 0.05
"""So long an image waits for what sensors measured up to its time."""

LIVE_S = 0.5
"""A sensor that has said nothing for so long is not waited for."""

MAX_WAITING = 500
TF_AFTER_S = 3.0
"""A topic is waited for so long before tf is taken for the wheels' odometry: it takes a while to
connect."""

UPRIGHT = 0.8
"""Cosine of the angle between gravity and the image's vertical up to which a camera is upright."""


class SensorInput:
    """Receives what wheels and IMU measure, in the axes of the rectified left camera.

    on_message: called after each. Where nobody publishes `wheel_odometry` and another node owns
    odom → base_link, that is taken for it. Samples of an IMU are turned by tf; without it, one for
    which up is up in the image is taken to be in the frame of the left images, others are not used.
    """

    def __init__(
        self, node: AnyStageNode, transforms: Transforms, on_message: Callable[[], None]
    ) -> None:
        self._node = node
        self._transforms = transforms
        self._on_message = on_message
        self._takes_best_effort = False
        self.reset()
        node.inputs.subscribe(WHEELS, self._take_wheels, self._choose_profile)
        node.inputs.subscribe(IMU, self._take_imu, self._choose_profile)

    def reset(self) -> None:
        """Know no camera and no measurement."""
        self._camera: tuple[str, Array] | None = None
        self._R_left_imu: Array | None = None
        self._measured: deque[Measurement] = deque(maxlen=MAX_WAITING)
        self._latest: dict[str, tuple[int, float]] = {}
        self._asked: tuple[int, float] = (0, 0.0)
        self._began_s = time.monotonic()
        self._has_tf_wheels = False

    def begin(self, left_frame: str, R_rectified_left: Array) -> None:
        """Take measurements from now on. R_rectified_left: (3, 3) turns the frame of the left
        images into the rectified one.
        """
        self._camera = left_frame, R_rectified_left

    def adapt_reliability(self) -> None:
        """Receive best effort where a driver offers no more."""
        if not self._takes_best_effort and offered_best_effort(self._node, (WHEELS, IMU)):
            self._takes_best_effort = True
            self._node.inputs.reopen()

    def _choose_profile(self) -> QoSProfile:
        return qos.SENSORS if self._takes_best_effort else qos.SENSORS_RELIABLE

    def take(self, stamp_ns: int, lag_ns: int = 0) -> list[Measurement]:
        """Return what has been measured since the last call, up to the time of an image."""
        self._add_tf_wheels(stamp_ns + lag_ns)
        measured = [*self._measured]
        self._measured.clear()
        return measured

    def is_behind(self, stamp_ns: int, lag_ns: int = 0) -> bool:
        """Whether a sensor is about to tell what it measured up to the time of an image; lag_ns: by
        how much later its stamps are.
        """
        now_s = time.monotonic()
        if self._asked[0] != stamp_ns:
            self._asked = stamp_ns, now_s
        if now_s > self._asked[1] + MAX_LATE_S:
            return False
        self._look_at_tf(now_s)
        return any(
            latest_ns < stamp_ns + lag_ns and now_s < heard_s + LIVE_S
            for latest_ns, heard_s in self._latest.values()
        )

    def _look_at_tf(self, now_s: float) -> None:
        """Note how far tf has the base, once it is clear that no topic tells it."""
        until_ns = self._transforms.fused_until_ns()
        if WHEELS in self._latest or until_ns is None or now_s < self._began_s + TF_AFTER_S:
            return
        self._has_tf_wheels = True
        if until_ns != self._latest.get(TF_WHEELS, (0, 0.0))[0]:
            self._latest[TF_WHEELS] = until_ns, now_s

    def _add_tf_wheels(self, stamp_ns: int) -> None:
        T_odom_base = self._transforms.fused_base(stamp_ns) if self._has_tf_wheels else None
        if T_odom_base is not None:
            self._measured.append(WheelPose(stamp_ns, T_odom_base))

    def _take_wheels(self, message: Odometry) -> None:
        if self._has_tf_wheels:
            return
        if self._camera is not None:
            self._measured.append(wheel_pose(message, WHEELS))
        self._note(WHEELS, message)

    def _take_imu(self, message: Imu) -> None:
        if self._camera is not None and self._measures(message):
            R_left_imu = self._rotation(message)
            if R_left_imu is None:
                self._node.reporter.diagnose(
                    IMU,
                    f'no tf from {self._camera[0]} to {message.header.frame_id or "its frame"}: '
                    f'{IMU} is not used; let another node publish where the IMU is',
                )
                return
            self._measured.append(imu_sample(message, R_left_imu))
        self._note(IMU, message)

    def _measures(self, message: Imu) -> bool:
        covariances = message.angular_velocity_covariance, message.linear_acceleration_covariance
        return all(covariance[0] != NOT_MEASURED for covariance in covariances)

    def _rotation(self, message: Imu) -> Array | None:
        assert self._camera is not None
        if self._R_left_imu is None:
            left_frame, R_rectified_left = self._camera
            R = self._transforms.rotation(left_frame, message.header.frame_id)
            if R is None:
                felt = message.linear_acceleration
                length = np.linalg.norm([felt.x, felt.y, felt.z])
                R = np.eye(3) if -felt.y > UPRIGHT * length else None
            self._R_left_imu = None if R is None else R_rectified_left @ R
        return self._R_left_imu

    def _note(self, name: str, message: Odometry | Imu) -> None:
        latest_ns = max(to_ns(message.header.stamp), self._latest.get(name, (0, 0.0))[0])
        self._latest[name] = latest_ns, time.monotonic()
        self._on_message()
