"""The simulation of a drive: images of a stereo camera with everything true about them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.errors import InputError
from segfloor_ros.geometry import Array
from segfloor_ros.grid.map_file import OCCUPIED, OccupancyGrid
from segfloor_ros.simulation import rig as sensors
from segfloor_ros.simulation.drive import Drive, plan_drive
from segfloor_ros.simulation.renderer import WorldRenderer
from segfloor_ros.simulation.rig import (
    Picture,
    RigMotion,
    develop,
    ideal_image,
    plan_imaging,
    rectified_camera,
)
from segfloor_ros.simulation.scene import Scene
from segfloor_ros.simulation.solids import floors, obstacles, true_map
from segfloor_ros.simulation.world import CAMERAS, build_world

BLUR_SAMPLES = 6


@dataclass(frozen=True)
class SimulatedFrame:
    """One pair of images (H, W) uint8 as the cameras deliver them, where the rectified left
    optical frame was (4, 4), and the depth image (H, W) uint16 in mm, where there is a sensor.
    """

    index: int
    time_s: float
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    T_world_left: Array
    depth_mm: NDArray[np.uint16] | None = None


@dataclass(frozen=True)
class FrameTruth:
    """What is true of one frame's rectified left image: floor mask (H, W) uint8, 255 floor;
    depth_m and disparity_px (H, W) float32.
    """

    floor: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    disparity_px: NDArray[np.float32]


class Simulation:
    """Drives through a scene. Use as a context manager; raises RenderingError where nothing can
    be rendered and InputError for an impossible scene. supersampling: the pictures are
    rendered this many times finer than the camera's pixels.
    """

    def __init__(self, scene: Scene, supersampling: int = 1):
        self.scene = scene
        self.drive: Drive = plan_drive(scene.path, scene.camera.rate_hz)
        self.camera = rectified_camera(scene.camera)
        self.imaging = plan_imaging(scene)
        if scene.sensors.depth.max_m and not scene.camera.rectified:
            raise InputError('a depth sensor needs a camera without distortion and misalignment')
        solids, ground = obstacles(scene), floors(scene)
        self.motion = RigMotion(scene, self.drive, ground)
        self.true_map: OccupancyGrid = true_map(scene, solids, ground, self.drive.xy_yaw[0, :2])
        _check_clear(self.true_map, self.drive)
        width, height = self.imaging.width * supersampling, self.imaging.height * supersampling
        world = build_world(scene, max(width, self.camera.width), max(height, self.camera.height))
        self._renderer = WorldRenderer(scene, world)
        self._pictures = self._renderer.view(width, height, self.imaging.focal_px * supersampling)
        self._truth = self._renderer.view(self.camera.width, self.camera.height, self.camera.fx)

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, *error: object) -> None:
        self._pictures.close()
        self._truth.close()

    @property
    def frame_count(self) -> int:
        """How many pairs the drive has."""
        return len(self.drive.times_s)

    def frames(self, every: int = 1) -> Iterator[SimulatedFrame]:
        """Yield the pairs in order, or only one of every so many."""
        for index in range(0, self.frame_count, every):
            yield self.frame(index)

    def frame(self, index: int) -> SimulatedFrame:
        """Render one pair."""
        time_s = float(self.drive.times_s[index])
        left, right = (
            develop(picture, self.imaging, self.scene, side, index, time_s)
            for side, picture in enumerate(self._exposed(time_s))
        )
        pose = self.motion.T_world_left(time_s)
        return SimulatedFrame(index, time_s, left, right, pose, self._depth_mm(index))

    def truth(self, index: int) -> FrameTruth:
        """Render what is true of one frame's rectified left image."""
        time_s = float(self.drive.times_s[index])
        self._renderer.move(self.motion.T_world_left(time_s), time_s)
        depth_m = self._truth.depth_m(CAMERAS[0])
        disparity_px = np.float32(self.camera.disparity_times_depth) / depth_m
        return FrameTruth(self._truth.floor_mask(CAMERAS[0]), depth_m, disparity_px)

    def wheels(self) -> sensors.WheelReadings | None:
        """Return what the wheels tell of the whole drive, where the scene has such."""
        if not self.scene.sensors.wheel_odometry.rate_hz:
            return None
        return sensors.wheel_readings(self.scene, sensors.smooth_motion(self.motion))

    def imu(self) -> sensors.ImuReadings | None:
        """Return what the IMU tells of the whole drive, where the scene has one."""
        if not self.scene.sensors.imu.rate_hz:
            return None
        return sensors.imu_readings(self.scene, sensors.smooth_motion(self.motion))

    def _depth_mm(self, index: int) -> NDArray[np.uint16] | None:
        if not self.scene.sensors.depth.max_m:
            return None
        true_m = self.truth(index).depth_m
        time_s = float(self.drive.times_s[index])
        return sensors.depth_reading_mm(self.scene, self.camera.fx, true_m, index, time_s)

    def moving_mask(self, index: int) -> NDArray[np.uint8]:
        """Render what moves in one frame's left image: (H, W) uint8, 255 moving."""
        time_s = float(self.drive.times_s[index])
        self._renderer.move(self.motion.T_world_left(time_s), time_s)
        mask = self._pictures.mask(CAMERAS[0], self._renderer.moving_geoms(time_s))
        share = ideal_image(mask.astype(np.float32), self.imaging, 0)
        return np.where(share > 127, np.uint8(255), np.uint8(0))

    def _exposed(self, time_s: float) -> list[Picture]:
        """Return the ideal left and right pictures, averaged over the exposure around a time."""
        exposure_s = self.scene.camera.exposure_s
        moments = [time_s]
        if exposure_s > 0:
            moments = list(time_s + exposure_s * (np.arange(BLUR_SAMPLES) / BLUR_SAMPLES - 0.5))
        pictures: list[list[Picture]] = [[], []]
        for moment in moments:
            self._renderer.move(self.motion.T_world_left(moment), moment)
            for side, camera in enumerate(CAMERAS):
                pictures[side].append(self._pictures.grey(camera))
        return [np.mean(side, axis=0, dtype=np.float32) for side in pictures]


def _check_clear(grid: OccupancyGrid, drive: Drive) -> None:
    cells = ((drive.xy_yaw[:, :2] - np.array(grid.origin_xy_m)) / grid.resolution_m).astype(int)
    hits = np.nonzero(grid.cells[cells[:, 1], cells[:, 0]] == OCCUPIED)[0]
    if len(hits):
        x, y, _ = drive.xy_yaw[hits[0]]
        raise InputError(f'the path runs into an obstacle at x {x:.2f}, y {y:.2f} m')
