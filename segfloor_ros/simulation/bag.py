"""A simulated drive as a rosbag2 (mcap): images, CameraInfo and where the robot really was."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

from segfloor_ros.camera.bag_messages import ODOMETRY
from segfloor_ros.camera.bag_writer import DEPTH_TOPIC, JPEG_QUALITY, BagWriter, ImageCoding
from segfloor_ros.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.camera.sources.bag_topics import IMAGE
from segfloor_ros.camera.sources.source import RawPair
from segfloor_ros.geometry import invert
from segfloor_ros.measurements import (
    ImuSample,
    Measurement,
    MeasurementLog,
    RecordedSensor,
    WheelPose,
)
from segfloor_ros.simulation.rig import RawCamera
from segfloor_ros.simulation.simulation import SimulatedFrame, Simulation

BAG_NAME = 'drive.mcap'
ODOMETRY_TOPIC = '/ground_truth/odometry'


class SimulatedBag:
    """Writes the frames of a simulation to a bag in a folder. Besides the images and CameraInfo it
    has the true pose of `base_link` in `map`, the base's first pose, as Odometry, and what wheels,
    IMU and depth camera tell. Use as a context manager; jpeg_quality is 1 to 100.
    """

    def __init__(
        self,
        folder: Path,
        simulation: Simulation,
        coding: ImageCoding,
        jpeg_quality: int = JPEG_QUALITY,
    ):
        left, right = (
            _eye(side, simulation.camera.width, simulation.camera.height)
            for side in simulation.imaging.raw
        )
        calibration = StereoCalibration(left, right)
        self._bag = BagWriter(folder / BAG_NAME, calibration, coding, jpeg_quality)
        self._motion = simulation.motion
        self._T_map_world = invert(simulation.motion.T_world_base(0.0))
        self._log = MeasurementLog(_sensors(simulation))

    def __enter__(self) -> SimulatedBag:
        self._bag.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bag.__exit__(kind, error, traceback)

    def add(self, frame: SimulatedFrame) -> None:
        """Append one frame, the pose of the base at that time, and what sensors told till then."""
        bag, stamp_ns = self._bag, round(frame.time_s * 1e9)
        for measurement in self._log.until(stamp_ns):
            bag.write_measurement(measurement)
        if frame.depth_mm is not None:
            depth = bag.image_message(stamp_ns, frame.depth_mm, '16UC1')
            bag.write_message(DEPTH_TOPIC, IMAGE, stamp_ns, depth)
        bag.write(RawPair(frame.index, stamp_ns, frame.left, frame.right))
        T_map_base = self._T_map_world @ self._motion.T_world_base(frame.time_s)
        truth = bag.messages.odometry(stamp_ns, 'map', T_map_base)
        bag.write_message(ODOMETRY_TOPIC, ODOMETRY, stamp_ns, truth)


def _sensors(simulation: Simulation) -> list[RecordedSensor]:
    """Return what wheels and IMU tell of the whole drive."""
    wheels, imu = simulation.wheels(), simulation.imu()
    told: list[Measurement] = []
    if wheels is not None:
        for time_s, T_odom_base in zip(wheels.times_s, wheels.T_odom_base, strict=True):
            told.append(WheelPose(round(time_s * 1e9), T_odom_base))
    if imu is not None:
        for time_s, gyro, accel in zip(imu.times_s, imu.gyro_rad_s, imu.accel_m_s2, strict=True):
            told.append(ImuSample(round(time_s * 1e9), gyro, accel))
    return [RecordedSensor('wheels and IMU', '', len(told), True, lambda: told)]


def _eye(side: RawCamera, width: int, height: int) -> EyeCalibration:
    return EyeCalibration(width, height, side.K, side.D, side.R, side.P, origin='simulation')
