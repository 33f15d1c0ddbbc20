"""The types that pass between stages: units, shapes and frames, no logic beyond them.

Read in the order of the data: what the camera and sensors deliver, what SLAM makes of it frame by
frame and keyframe by keyframe, what the floor stage sees, and the labelled points that the grid
gets. Stages import these and their own room, never one another.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.files.arrays import Arrays
from segfloor_ros.core.geometry import (
    R_ROS_OPTICAL,
    Array,
    angles_of_rotation,
    make_transform,
    rotation_from_angles,
)


@dataclass(frozen=True)
class Mount:
    """Where the left camera sits on the base (`base_link`: on the floor below the robot's
    centre, x forward, z up). height_m: of the left camera's centre above the floor. pitch_rad:
    positive looks down. roll_rad: positive when the camera is rolled to its right, yaw_rad:
    positive looks to the left (REP-103 angles, applied yaw, pitch, roll). forward_m, left_m:
    of the camera's centre ahead of and to the left of the base.
    """

    height_m: float
    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    forward_m: float = 0.0
    left_m: float = 0.0
    yaw_rad: float = 0.0

    @cached_property
    def T_base_left(self) -> Array:
        """The pose (4, 4) of the left optical frame in the base frame; not to be written to."""
        R_base_camera = rotation_from_angles(self.yaw_rad, self.pitch_rad, self.roll_rad)
        translation = np.array([self.forward_m, self.left_m, self.height_m])
        T_base_left = make_transform(R_base_camera @ R_ROS_OPTICAL, translation)
        T_base_left.flags.writeable = False
        return T_base_left

    @classmethod
    def from_transform(cls, T_base_left: Array) -> Mount:
        """Return the mount of a (4, 4) pose of the left optical frame in the base frame."""
        R_base_camera = T_base_left[:3, :3] @ R_ROS_OPTICAL.T
        yaw, pitch, roll = angles_of_rotation(R_base_camera)
        x, y, z = (float(value) for value in T_base_left[:3, 3])
        return cls(z, pitch, roll, x, y, yaw)

    @property
    def up_in_camera(self) -> Array:
        """The floor's unit normal (3,) pointing up, in the left optical frame."""
        return self.T_base_left[2, :3].copy()

    def heights_m(self, points_left: Array) -> Array:
        """Return the heights (N,) above the floor of points (N, 3) of the left optical frame."""
        return points_left @ self.up_in_camera + self.height_m


@dataclass(frozen=True)
class StereoFrame:
    """One rectified grey stereo pair: images (H, W) uint8, the frame's number in its recording,
    its stamp in ns. right: of a depth camera, in its place, the disparity (H, W) float32 (see
    `depth`). excluded: mask (H, W) uint8 of the left image, 255 where something moves, as
    far as a segmentation network says. colour: the left image (H, W, 3) BGR, if it was asked
    for and there is one.
    """

    index: int
    stamp_ns: int
    left: NDArray[np.uint8]
    right: NDArray[Any]
    excluded: NDArray[np.uint8] | None = None
    colour: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class WheelPose:
    """Where wheel odometry has the base at a time: (4, 4) in a frame of its own."""

    stamp_ns: int
    T_wheels_base: Array


@dataclass(frozen=True)
class ImuSample:
    """Angular velocity and specific force (3,) at a time, and where the IMU is (3,), all in the
    rectified left optical frame.
    """

    stamp_ns: int
    gyro_rad_s: Array
    accel_m_s2: Array
    place_m: Array = field(default_factory=lambda: np.zeros(3))

    @staticmethod
    def seen_from(T_left_imu: Array, stamp_ns: int, gyro: Array, accel: Array) -> ImuSample:
        """Return what an IMU at a pose (4, 4) in the rectified left optical frame measured."""
        R = T_left_imu[:3, :3]
        return ImuSample(stamp_ns, R @ gyro, R @ accel, T_left_imu[:3, 3])


@dataclass(frozen=True)
class Up:
    """A unit vector (3,) that points up, and the standard deviation of its tilt in radians."""

    direction: Array
    sigma_rad: float


Measurement = WheelPose | ImuSample

UNKNOWN_COVARIANCE = 1e6

NO_POINT = -1
"""Id of a feature that has no map point."""


@dataclass(frozen=True)
class KeyframeFeatures:
    """The features of one keyframe. uv_px: (N, 2) float32, position in the rectified left
    image. point_id: (N,) int32, stable for the life of the map, `NO_POINT` where the feature
    has no map point. xyz_map: (N, 3) float32 in metres, NaN where unknown.
    """

    uv_px: NDArray[np.float32]
    point_id: NDArray[np.int32]
    xyz_map: Array


@dataclass(frozen=True)
class SparseCloud:
    """The whole sparse map: ids (N,) int32 ascending, positions (N, 3) float32 in frame `map`,
    metres.
    """

    point_id: NDArray[np.int32]
    xyz_map: Array


@dataclass(frozen=True)
class KeyframePath:
    """All keyframes as now optimised: stamps (K,) int64 ascending and base poses (K, 4, 4) in
    frame `map`.
    """

    stamp_ns: NDArray[np.int64]
    T_map_base: Array


@dataclass(frozen=True)
class MovingPoints:
    """Points of what moves: positions (N, 3) in frame `map`, m, and velocities (N, 3), m/s, NaN
    where they are not known.
    """

    xyz_map: NDArray[np.floating]
    velocity_m_s: NDArray[np.floating]


@dataclass(frozen=True)
class Keyframe:
    """Everything published about one keyframe. All parts share its stamp. moving: mask (H, W)
    uint8 of the left image, 255 where something moves. offset_px2: covariance (3, 3) of what
    disparities are still off, in the middle of the image, at its right edge and as far below.
    """

    stamp_ns: int
    frame_index: int
    T_map_base: Array
    left: NDArray[np.uint8]
    right: NDArray[Any]
    features: KeyframeFeatures
    path: KeyframePath
    cloud: SparseCloud
    moving: NDArray[np.uint8] | None = None
    offset_px2: Array = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True)
class LastPose:
    """Where a drive was broken off: the last pose T_camera_world (4, 4) with its covariance (6, 6)
    and velocity (6,), the correction of the odometry T_world_odom (4, 4), and what wheels measured.
    """

    stamp_ns: int
    T_camera_world: Array
    T_world_odom: Array
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    velocity: Array = field(default_factory=lambda: np.zeros(6))
    wheels: tuple[WheelPose, ...] = ()


@dataclass(frozen=True)
class FrameResult:
    """The outcome of one frame. tracked: whether there is a pose. T_odom_base: the base in the
    continuous `odom` frame; T_map_odom: the present correction, so that T_map_odom @
    T_odom_base is the base in `map` (REP-105). Both are the last known ones while lost.
    covariance: (6, 6) of the base pose, order x y z roll pitch yaw (m², rad²), in the odom
    frame. reference_keyframe: stamp of the keyframe the pose is expressed against, for
    correcting it later. state: words for people ('tracking', or why not). blind: whether the pose
    is that of wheels or a gyroscope alone. keyframe: set when
    this frame became one. moving: what moves, where this frame was searched for it. in_submap:
    whether it was mapped in a submap beside the map: `tracked` where it was merged later. repeated:
    whether the left image is the one before, bit for bit. outside: whether `map` is a frame of its
    own, for the map that was loaded is not recognised yet.
    """

    index: int
    stamp_ns: int
    tracked: bool
    T_odom_base: Array
    T_map_odom: Array
    covariance: Array
    num_matches: int
    state: str
    reference_keyframe_ns: int
    keyframe: Keyframe | None = None
    moving: MovingPoints | None = None
    blind: bool = False
    in_submap: bool = False
    repeated: bool = False
    outside: bool = False

    @property
    def covariance_in_map(self) -> Array:
        """The covariance (6, 6) in the axes of `map`; outside of a loaded one the place in it is
        not known.
        """
        if self.outside:
            return np.eye(6) * UNKNOWN_COVARIANCE
        axes = np.kron(np.eye(2), self.T_map_odom[:3, :3])
        return np.asarray(axes @ self.covariance @ axes.T)


FLOOR, NO_EVIDENCE, MOVING, NOT_FLOOR = 255, 127, 64, 0
"""Pixels of a mask: floor, not known, and what stands there. What moves is in what a network says
alone: neither floor nor in the way."""

RANGE_MAX_ERROR_M = 0.3
SAME_SURFACE_SHARE = 0.06
"""Ranges, or disparities, that differ by more than this share are those of two surfaces."""

CELL_M = 0.05
"""Side of a usual cell of a map. A ray ends so far before what stands up, so that it does not clear
the cell of that.
"""


@dataclass(frozen=True)
class FloorScan:
    """How far the floor was seen without interruption, per bearing, from the base's origin in
    the base's x-y plane. Bearing i is angle_min_rad + i * angle_increment_rad, counter-
    clockwise from x forward. ranges_m: (N,) float32 in metres; 0 where something stands right
    in front, NaN where the image shows nothing about that bearing. obstacle_m: (N,) float32,
    distance at which the nearest upright thing was measured on that bearing, NaN where none
    was; None from a source that does not tell. range_max_m: the range whose error, one sigma, is
    `RANGE_MAX_ERROR_M`; errors grow with the square of the range. movable_m: (N,) float32, as
    obstacle_m, of what a network says to be of a class that moves: it does not end the floor. None
    without a network.
    """

    angle_min_rad: float
    angle_increment_rad: float
    ranges_m: NDArray[np.float32]
    obstacle_m: NDArray[np.float32] | None = None
    range_max_m: float = math.inf
    movable_m: NDArray[np.float32] | None = None

    @property
    def bearings_rad(self) -> NDArray[np.float64]:
        """Bearings (N,) in radians."""
        steps = np.arange(len(self.ranges_m), dtype=np.float64)
        return self.angle_min_rad + self.angle_increment_rad * steps

    def ends(self) -> NDArray[np.float64]:
        """Return where the finite ranges end, (M, 3) in the base's x-y plane."""
        known = np.isfinite(self.ranges_m)
        bearings, ranges = self.bearings_rad[known], self.ranges_m[known]
        x, y = ranges * np.cos(bearings), ranges * np.sin(bearings)
        return np.stack([x, y, np.zeros_like(x)], axis=1)

    @property
    def error_per_m(self) -> float:
        """The error of a range, one sigma, is this times the square of the range."""
        return RANGE_MAX_ERROR_M / self.range_max_m**2


@dataclass(frozen=True)
class VDisparity:
    """How often each disparity occurs per row, without what is upright or blank: counts (R, B),
    row i being the de-rolled image row first_row + i, bin j the disparity j / bins_per_px.
    """

    counts: NDArray[np.integer]
    first_row: int
    bins_per_px: int


@dataclass(frozen=True)
class FloorObservation:
    """The floor seen in one rectified stereo pair.
    disparity_px: (H, W) float32, 0 where there is no match, and where something moves, unless a
    network knows it. mask: (H, W) uint8 of `FLOOR`,
    `NO_EVIDENCE` and `NOT_FLOOR`. profile_px: (H,) float64, the floor's disparity at each image row
    in the de-rolled image (NaN above the horizon). scan: the compact free-space scan.
    v_disparity: what the profile was fitted to.
    """

    disparity_px: NDArray[np.float32]
    mask: NDArray[np.uint8]
    profile_px: NDArray[np.float64]
    scan: FloorScan
    max_disparity_px: float
    v_disparity: VDisparity


POINT_UNKNOWN, POINT_FLOOR, POINT_OBSTACLE = range(3)
"""Labels of a point."""


@dataclass(frozen=True)
class LabelledPoints:
    """The labelled cloud as arrays over points. point_id: (N,) int32 ascending. xyz_map: (N,
    3) float32, metres. label: (N,) uint8 of `POINT_UNKNOWN`, `POINT_FLOOR`, `POINT_OBSTACLE`.
    confidence: (N,) float32 in [0, 1], how sure the label is.
    """

    point_id: NDArray[np.int32]
    xyz_map: NDArray[np.float32]
    label: NDArray[np.uint8]
    confidence: NDArray[np.float32]


@dataclass(frozen=True)
class RelativeMotion:
    """The camera's motion between two frames: T_now_before (4, 4), and the covariance (6, 6) of the
    twist in exp(twist) T_now_before, translation first. source: wheels, the images of two frames
    alone, an IMU, a gyroscope alone with a speed that is taken for constant, or nothing at all: the
    last pose is held.
    """

    T_now_before: Array
    covariance: Array
    source: Literal['wheels', 'images', 'IMU', 'gyroscope', 'nothing'] = 'wheels'

    @property
    def by_wheels(self) -> bool:
        """Whether wheels measured it."""
        return self.source == 'wheels'

    @classmethod
    def none(cls) -> RelativeMotion:
        """Return the motion of no time at all."""
        return cls(np.eye(4), np.zeros((6, 6)))


@dataclass(frozen=True)
class LoadedMap:
    """What SLAM has loaded, for the stages behind it: all keyframes, all points, and by how much
    the stamps of the keyframes are later than in the file.
    """

    path: KeyframePath
    cloud: SparseCloud
    shift_ns: int


@dataclass(frozen=True)
class Searched:
    """What a search for moving things found. disparity: (h, w) px of the shrunk image, 0 where none
    was found. moving: what moves in it, (h, w), 255. region: the same in the image, None for
    nothing. points: of what moves, in the world.
    """

    disparity: NDArray[np.float32]
    moving: NDArray[np.uint8]
    region: NDArray[np.uint8] | None
    points: MovingPoints


@dataclass(frozen=True)
class InputFault:
    """What is wrong with the images: `fault` in a word, a figure with its unit, what was found in
    words that go on after the name of the images, and what to do.
    """

    fault: str
    value: float
    unit: str
    finding: str
    remedy: str
    images: str = 'left and right images'

    def line(self, images: str = '') -> str:
        """Return the fault in one line. images: their name, if they have one of their own."""
        return f'{images or self.images} {self.finding}; {self.remedy}'


class Placed(Protocol):
    """A keyframe of the sparse map, whose pose T_camera_world (4, 4) is adjusted later."""

    T_camera_world: Array


class RigCheck(Protocol):
    """Finds what is wrong with the images of a rig, and corrects what it can. faults: by name."""

    faults: dict[str, InputFault]

    def watch(self, frame: StereoFrame, turn_rad: float) -> None:
        """Take in a frame. turn_rad: by how much the camera turned since the one before."""

    def corrected(self, frame: StereoFrame) -> StereoFrame:
        """Return a frame with its right image corrected by what was found."""

    def as_dicts(self) -> list[dict[str, Any]]:
        """Return fault, value, unit and remedy of all that was found."""


class MovingObjects(Protocol):
    """Finds what moves in keyframes, and in some of the frames between."""

    def is_due(self, stamp_ns: int, is_keyframe: bool, is_tracked: bool) -> bool:
        """Whether to search a frame."""

    def search(
        self, frame: StereoFrame, T_camera_world: Array, T_odom_camera: Array, mount: Mount | None
    ) -> Searched:
        """Find what moves in a frame whose pose is known."""

    def remember(self, keyframe: Placed, disparity: NDArray[np.float32]) -> None:
        """Take in what a keyframe saw."""

    def seen_through(self, disparity: NDArray[np.float32], points: Array) -> NDArray[np.bool_]:
        """Return at which points (N, 3) of the left optical frame nothing is any more."""

    def reset(self) -> None:
        """Forget all frames: where the next ones are relative to them is not known."""


class BodySensors(Protocol):
    """Measures the motion of the camera by wheels and IMU, and learns their errors from the images.

    T_base_left: (4, 4), the mount, None until it is known. messages: used, by sensor. remarks:
    what seems wrong, in words.
    """

    T_base_left: Array | None
    messages: dict[str, int]
    remarks: dict[str, str]

    @property
    def lag_ns(self) -> int:
        """How much later than those of the images the stamps of the sensors are."""

    @property
    def latest_wheels(self) -> Sequence[WheelPose]:
        """The last poses that the wheels measured."""

    @property
    def up_world(self) -> Up | None:
        """Up in the world, as an accelerometer has it."""

    def up_camera(self, T_odom_camera: Array) -> Up | None:
        """Return up in the camera's axes as the latest measurement has it."""

    def add(self, measurement: Measurement) -> None:
        """Take in what a sensor measured."""

    def remark(self, remarks: Mapping[str, str]) -> None:
        """Note what seems wrong."""

    def turn(self, before_ns: int, now_ns: int) -> tuple[Array, float] | None:
        """Return R_now_before (3, 3) by the gyroscope, and the sigma of its angles in radians."""

    def between(self, before_ns: int, now_ns: int) -> RelativeMotion | None:
        """Return the motion between two times by wheels."""

    def by_inertia(
        self, before_ns: int, now_ns: int, T_odom_before: Array, R_world_odom: Array
    ) -> RelativeMotion | None:
        """Return the motion since the last pose by an IMU alone."""

    def learn(self, stamp_ns: int, T_odom_camera: Array, R_world_odom: Array) -> None:
        """Learn from the pose of a frame that the images show well."""

    def carry(
        self, stamp_ns: int, T_odom_camera: Array, R_world_odom: Array, on_wheels: bool
    ) -> None:
        """Note the pose of a frame that the sensors alone measured."""

    def reset(self) -> None:
        """Begin anew after a frame without a pose."""

    def reset_world(self) -> None:
        """Forget where up is: the world is another one."""


class Semantics(Protocol):
    """Labels what keyframes show by a segmentation network, and the map by them."""

    @property
    def remarks(self) -> list[str]:
        """What seems wrong, in words."""

    @property
    def is_late(self) -> bool:
        """Whether the network looks at keyframes alone, once they are keyframes."""

    def moving(self, frame: StereoFrame) -> NDArray[np.uint8]:
        """Return the mask (H, W) of what may move in a frame, 255."""

    def says(self, keyframe: Keyframe) -> NDArray[np.uint8] | None:
        """Return what the network says of the floor in a keyframe, (H, W) as a floor mask."""

    def add(self, keyframe: Keyframe, floor: FloorObservation, mount: Mount) -> None:
        """Take in a keyframe whose floor is segmented."""

    def to_parts(self) -> dict[str, Arrays]:
        """Return what keyframes showed, as parts of a saved map."""

    def from_parts(self, parts: dict[str, Arrays], shift_ns: int) -> None:
        """Go on with the parts of a saved map, whose stamps are later by shift_ns."""


MAX_KEYFRAMES_UNDER_WAY = 4
"""Keyframes that may be between SLAM and the grid while the next frame is taken."""
