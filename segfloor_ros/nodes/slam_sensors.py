"""What the node `stereo_slam` takes besides images: wheel odometry, an IMU, masks of what moves,
and about where the robot is.
"""

from __future__ import annotations

import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image, Imu

from segfloor_ros.core.camera.measurements import (
    imu_sample,
    is_upright,
    measures_motion,
    wheel_pose,
    xyz,
)
from segfloor_ros.core.camera.rectification import StereoRectifier
from segfloor_ros.core.contracts import Measurement, WheelPose
from segfloor_ros.core.geometry import Array, make_transform
from segfloor_ros.core.slam.rig import GATE, chi2_limit
from segfloor_ros.core.slam.stereo_slam import StereoSlam
from segfloor_ros.nodes.messages.images import grey8_image
from segfloor_ros.nodes.messages.poses import pose_array
from segfloor_ros.nodes.messages.topics import (
    FRESH_S,
    IMAGES,
    PATIENCE_S,
    SENSORS,
    best_effort,
    stamp_of,
    to_ns,
)
from segfloor_ros.nodes.shared.inputs import DISCOVERY_S, LOOK_S
from segfloor_ros.nodes.shared.stage_node import AnyStageNode
from segfloor_ros.nodes.shared.transforms import Transforms
from segfloor_ros.nodes.slam_camera import offered

WHEELS, IMU, TF_WHEELS = 'wheel_odometry', 'imu', 'odom → base_link'
MASKS, INITIAL_POSE = 'dynamic_mask', 'initialpose'
LEAST_SIGMA_M, LEAST_SIGMA_RAD = 0.5, 0.26
"""Nobody points more exactly than RViz says by itself: half a metre and 15 degrees."""


class SensorInput:
    """Receives what wheels and IMU measure, in the axes of the rectified left camera.

    on_message: called after each. Where nobody publishes `wheel_odometry` and another node owns
    odom → base_link, that is taken for it. Where an IMU is, tf tells; without it, one for which
    up is up in the image is taken to be in the frame of the left images, others are not used.
    """

    def __init__(
        self,
        node: AnyStageNode,
        transforms: Transforms,
        on_message: Callable[[], None],
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._node = node
        self._clock_s = clock_s
        self._transforms = transforms
        self._on_message = on_message
        self._takes_best_effort = False
        self._same_time_ns = 1e9 * node.settings.sync_tolerance_s
        self.reset()
        for name in (WHEELS, IMU):
            receive = partial(self.receive, name)
            node.inputs.subscribe(name, receive, self._choose_profile, takes_all=True)

    def reset(self) -> None:
        """Know no camera and no measurement."""
        self._camera: tuple[str, Array] | None = None
        self._T_left_imu: Array | None = None
        self._uses_imu = True
        self._waiting: dict[str, deque[Odometry | Imu]] = {
            name: deque(maxlen=SENSORS.depth) for name in (WHEELS, IMU)
        }
        self._latest: dict[str, tuple[int, float]] = {}
        self._asked: tuple[int, float] = (0, 0.0)
        self._began_s = self._clock_s()
        self._has_tf_wheels = False

    def begin(self, left_frame: str, R_rectified_left: Array) -> None:
        """Know the camera. R_rectified_left: (3, 3) turns the frame of the left images into the
        rectified one.
        """
        self._camera = left_frame, R_rectified_left

    def adapt_reliability(self) -> None:
        """Receive best effort where a driver offers no more."""
        lossy = offered(self._node, (WHEELS, IMU), reliability=ReliabilityPolicy.BEST_EFFORT)
        if lossy and not self._takes_best_effort:
            self._takes_best_effort = True
            self._node.inputs.reopen()

    def _choose_profile(self) -> QoSProfile:
        return best_effort(SENSORS) if self._takes_best_effort else SENSORS

    def take(self, stamp_ns: int, lag_ns: int = 0) -> list[Measurement]:
        """Return what has not been returned yet, up to the first measurement of each sensor at or
        after the time of an image, so that poses can be interpolated there; lag_ns: by how much
        later its stamps are. So does a recording that is run without nodes.
        """
        wheels = self._tf_wheels(stamp_ns + lag_ns)
        measured = [self._measured(message) for message in self._due(stamp_ns + lag_ns)]
        return [*wheels, *(one for one in measured if one is not None)]

    def _due(self, stamp_ns: int) -> Iterator[Odometry | Imu]:
        """Yield the messages of each sensor up to the first at or after a time."""
        for name, waiting in self._waiting.items():
            in_order = sorted(waiting, key=stamp_of)
            count = bisect_left(in_order, stamp_ns, key=stamp_of) + 1
            yield from in_order[:count]
            self._waiting[name] = deque(in_order[count:], SENSORS.depth)

    def is_behind(self, stamp_ns: int, lag_ns: int = 0) -> bool:
        """Whether a sensor is about to tell what it measured up to the time of an image, and may
        still be waited for; lag_ns: by how much later its stamps are.
        """
        now_s = self._clock_s()
        if self._asked[0] != stamp_ns:
            self._asked = stamp_ns, now_s
        if now_s > self._asked[1] + LOOK_S:
            return False
        self._look_at_tf(now_s)
        return any(
            latest_ns < stamp_ns + lag_ns - self._same_time_ns and now_s < heard_s + FRESH_S
            for latest_ns, heard_s in self._latest.values()
        )

    def _look_at_tf(self, now_s: float) -> None:
        """Note how far tf has the base, once it is clear that no topic tells it."""
        until_ns = self._transforms.fused_until_ns()
        if WHEELS in self._latest or until_ns is None or now_s < self._began_s + DISCOVERY_S:
            return
        self._has_tf_wheels = True
        if until_ns != self._latest.get(TF_WHEELS, (0, 0.0))[0]:
            self._latest[TF_WHEELS] = until_ns, now_s

    def _tf_wheels(self, stamp_ns: int) -> list[WheelPose]:
        T_odom_base = self._transforms.fused_base(stamp_ns) if self._has_tf_wheels else None
        return [] if T_odom_base is None else [WheelPose(stamp_ns, T_odom_base)]

    def receive(self, name: str, message: Odometry | Imu) -> None:
        """Take in a message of a topic."""
        if self._has_tf_wheels and name == WHEELS:
            return
        self._waiting[name].append(message)
        if name == WHEELS or self._uses_imu:
            self._note(name, message)

    def _measured(self, message: Odometry | Imu) -> Measurement | None:
        """Return what a message tells; None where it is not used."""
        if isinstance(message, Odometry):
            return wheel_pose(message, WHEELS)
        if not measures_motion(message):
            return None
        T_left_imu = self._place(message)
        self._uses_imu = T_left_imu is not None
        if T_left_imu is not None:
            return imu_sample(message, T_left_imu)
        # No image waits for what is not used.
        self._latest.pop(IMU, None)
        assert self._camera is not None
        self._node.reporter.diagnose(
            IMU,
            f'no tf from {self._camera[0]} to {message.header.frame_id or "its frame"}: '
            f'{IMU} is not used; let another node publish where the IMU is',
        )
        return None

    def _place(self, message: Imu) -> Array | None:
        """Return where the IMU is in the rectified left optical frame (4, 4); tf may come late."""
        assert self._camera is not None
        if self._T_left_imu is None:
            left_frame, R_rectified_left = self._camera
            T_rectified_left = make_transform(R_rectified_left, np.zeros(3))
            T = self._transforms.between(left_frame, message.header.frame_id)
            if T is None:
                return T_rectified_left if is_upright(xyz(message.linear_acceleration)) else None
            self._T_left_imu = T_rectified_left @ T
        return self._T_left_imu

    def _note(self, name: str, message: Odometry | Imu) -> None:
        latest_ns = max(stamp_of(message), self._latest.get(name, (0, 0.0))[0])
        self._latest[name] = latest_ns, self._clock_s()
        self._on_message()


class MaskInput:
    """Receives masks and gives each frame the one of its stamp, or the latest that is not too old:
    a network is slower than the camera, and no frame waits for it. on_mask: gets the stamp of each.
    """

    def __init__(
        self,
        node: AnyStageNode,
        timeout_s: float,
        on_mask: Callable[[int], None] = lambda stamp_ns: None,
    ) -> None:
        self._on_mask = on_mask
        self._timeout_ns = round(timeout_s * 1e9)
        self.reset()
        node.inputs.subscribe(MASKS, self.take)

    def reset(self) -> None:
        """Forget the masks."""
        self.images: dict[int, Image] = {}
        """Those that are kept, by stamp."""

    def take(self, message: Image) -> None:
        """Keep a mask."""
        self.images[to_ns(message.header.stamp)] = message
        while len(self.images) > IMAGES.depth:
            del self.images[min(self.images)]
        self._on_mask(to_ns(message.header.stamp))

    def mask_for(self, stamp_ns: int, rectifier: StereoRectifier) -> NDArray[np.uint8] | None:
        """Return the mask (H, W) uint8 on the rectified left image of a frame, None where there is
        none. Raises InputError for one that is no grey image, CalibrationError for a wrong size.
        """
        fitting = [at for at in self.images if stamp_ns - self._timeout_ns <= at <= stamp_ns]
        return self.mask_of(max(fitting), rectifier) if fitting else None

    def mask_of(self, stamp_ns: int, rectifier: StereoRectifier) -> NDArray[np.uint8]:
        """Return the mask of a stamp that is kept, like `mask_for`."""
        return rectifier.rectify_mask(grey8_image(self.images[stamp_ns], MASKS))


class InitialPose:
    """Narrows the search of the camera in a known map to the surroundings of a pose."""

    def __init__(self, node: AnyStageNode) -> None:
        self._node = node
        self._map_frame = node.settings.map_frame
        self.reset()
        node.inputs.subscribe(INITIAL_POSE, self._take)

    def reset(self) -> None:
        """Know no pose."""
        self._given: tuple[Array, float, float] | None = None

    def apply(self, slam: StereoSlam) -> None:
        """Have SLAM look around a pose that was given since the last call, once it has a map."""
        if self._given is not None and slam.mount is not None and slam.map.keyframes:
            slam.search_near(*self._given)
            self._given = None

    def _take(self, message: PoseWithCovarianceStamped) -> None:
        its, own = message.header.frame_id, self._map_frame
        text = '' if its in ('', own) else f'{INITIAL_POSE} is in frame {its}; give it in {own}'
        if not np.isfinite(message.pose.covariance).all():
            text = f'{INITIAL_POSE}: its covariance is not finite; give numbers, or zeros'
        if text:
            self._node.reporter.diagnose(INITIAL_POSE, text, lasts_s=PATIENCE_S)
            return
        T_map_base = pose_array(message.pose.pose)
        sigma = np.sqrt(np.maximum(np.diag(np.reshape(message.pose.covariance, (6, 6))), 0.0))
        sigmas = float(np.sqrt(chi2_limit(1, GATE)))
        reach_m = sigmas * max(float(sigma[:3].max()), LEAST_SIGMA_M)
        reach_rad = sigmas * max(float(sigma[3:].max()), LEAST_SIGMA_RAD)
        self._given = T_map_base, reach_m, reach_rad
        x, y = T_map_base[:2, 3].tolist()
        self._node.get_logger().info(f'looks within {reach_m:.1f} m around x {x:.2f}, y {y:.2f}')
