"""SLAM and the pipeline with everything plugged in."""

from __future__ import annotations

import math
from functools import partial

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import Mount
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.floor.plane.mount import MountEstimator
from segfloor_ros.core.pipeline import KeyframeListener, KeyframeStages, Pipeline
from segfloor_ros.core.plugins.maps.session import MapSession
from segfloor_ros.core.plugins.moving.moving_regions import MovingRegions
from segfloor_ros.core.plugins.rig.check import RigCheck
from segfloor_ros.core.plugins.rig.image_check import ImageCheck
from segfloor_ros.core.plugins.semantics.late_masks import LateMasks
from segfloor_ros.core.plugins.semantics.network import ImageLabeller
from segfloor_ros.core.plugins.semantics.semantic_map import SemanticMap
from segfloor_ros.core.plugins.sensors.body_motion import BodyMotion
from segfloor_ros.core.slam.mount_search import MountMeter
from segfloor_ros.core.slam.optional import NothingMoves, Plugins
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.stereo_slam import CAMERA_AS_BASE, StereoSlam
from segfloor_ros.core.timing import StageTimes


def make_slam(
    camera: StereoCamera,
    settings: StereoSlamSettings,
    mount: Mount | None = None,
    times: StageTimes | None = None,
    background: bool = False,
    path_only: bool = False,
) -> StereoSlam:
    """Build stereo SLAM with the camera's mount: `mount` when it is known (from tf), else from
    the settings, and whatever the settings leave open is measured from the floor the camera
    sees. CAMERA_AS_BASE: it is measured, too, and tracking is the same, but results wait for none
    and have the axes of the camera. background: adjust the map beside tracking. path_only: a
    frame that no camera on a robot has is treated so, too; else it raises InputError.
    """
    is_frame = path_only and mount is not None and bool(mount_fault(mount))
    base = mount if mount is CAMERA_AS_BASE or is_frame else None
    mount = None if base is not None else mount
    height_m, pitch_rad, roll_rad = (
        settings.camera_height_m,
        settings.camera_pitch_rad,
        settings.camera_roll_rad,
    )
    if mount is None and settings.has_mount:
        mount = Mount(
            height_m, pitch_rad, roll_rad, settings.camera_forward_m, settings.camera_left_m
        )
    meter = None
    if mount is None:
        meter = MountEstimator(
            camera,
            height_m,
            pitch_rad,
            roll_rad,
            forward_m=settings.camera_forward_m,
            left_m=settings.camera_left_m,
        )
    else:
        if fault := mount_fault(mount):
            raise InputError(fault)
        meter = MountEstimator(camera, forward_m=mount.forward_m, left_m=mount.left_m, given=mount)
    slam = equipped_slam(camera, settings, mount, meter, times, background)
    slam.rig.base = base
    return slam


STRAIGHT_DOWN_RAD = math.radians(75)
LEAST_HEIGHT_M, MOST_UP_RAD, MOST_ROLL_RAD = 0.02, math.radians(30), math.radians(60)
"""A camera that maps a floor is above it, and sees it upright."""


def mount_fault(mount: Mount) -> str:
    """Return why a camera cannot be mounted so, and what to do; '' where it can."""
    pitch, roll = math.degrees(mount.pitch_rad), math.degrees(mount.roll_rad)
    place_m = mount.height_m, mount.forward_m, mount.left_m
    if not any(place_m) and pitch < -89.0:  # x and z of a frame are those of the camera
        return (
            'the frame of the base is the camera itself; set base_frame to the frame of the robot '
            'on the floor, e.g. base_link'
        )
    # Of a camera that looks straight down, roll and heading are one.
    is_rolled = mount.pitch_rad < STRAIGHT_DOWN_RAD and abs(mount.roll_rad) > MOST_ROLL_RAD
    if -mount.pitch_rad > MOST_UP_RAD or is_rolled:
        return (
            f'the camera would look down by {pitch:.0f} deg and be rolled by {roll:.0f} deg: its '
            'frame is no optical one (x right, y down, z ahead; REP-103); let its driver stamp the '
            'images with the optical frame, and put that below its body with roll -90, yaw -90 deg'
        )
    if mount.height_m < LEAST_HEIGHT_M:
        return (
            f'the camera would be {mount.height_m:.3f} m above the floor, on which the base frame '
            'lies; correct the height in the transform, or set base_frame to a frame on the floor, '
            'e.g. base_footprint'
        )
    return ''


def equipped_slam(
    camera: StereoCamera,
    settings: StereoSlamSettings,
    mount: Mount | None = None,
    meter: MountMeter | None = None,
    times: StageTimes | None = None,
    background: bool = False,
) -> StereoSlam:
    """Build stereo SLAM with all that it can do without, and a given meter of the mount."""
    plugins = Plugins(
        MovingRegions(camera) if settings.detect_moving else NothingMoves(),
        BodyMotion(),
        RigCheck(camera),
        ImageCheck(),
        MapSession,
        LateMasks,
    )
    return StereoSlam(camera, settings, mount, meter, times, background, plugins)


def make_stages(
    camera: StereoCamera,
    configuration: Configuration,
    times: StageTimes,
    labeller: ImageLabeller | None = None,
) -> KeyframeStages:
    """Build the stages behind SLAM. labeller: of their keyframes, where there is a network."""
    height_m = configuration.floor_segmentation.robot_height_m
    semantics = SemanticMap(camera, labeller, height_m)
    return KeyframeStages(camera, configuration, times, semantics)


def make_pipeline(
    camera: StereoCamera,
    configuration: Configuration,
    on_keyframe: KeyframeListener | None = None,
    path_only: bool = False,
    labeller: ImageLabeller | None = None,
    times: StageTimes | None = None,
) -> Pipeline:
    """Build the whole pipeline. path_only: SLAM runs alone, also where no floor shows the mount;
    the camera is then taken for the base. labeller: of the frames, where there is a network.
    """
    times = times or StageTimes()
    mount = CAMERA_AS_BASE if path_only and not configuration.stereo_slam.has_mount else None
    slam = make_slam(camera, configuration.stereo_slam, mount, times, path_only=path_only)
    stages = partial(make_stages, camera, configuration, times, labeller)
    return Pipeline(slam, stages, times, on_keyframe, path_only)
