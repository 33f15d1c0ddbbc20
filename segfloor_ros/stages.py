"""How the stages are put together from their settings; the pipeline and the nodes both build
them here.
"""

from __future__ import annotations

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.plane.mount import MountEstimator
from segfloor_ros.slam.settings import StereoSlamSettings
from segfloor_ros.slam.stereo_slam import StereoSlam
from segfloor_ros.timing import StageTimes


def make_slam(
    camera: StereoCamera,
    settings: StereoSlamSettings,
    mount: Mount | None = None,
    times: StageTimes | None = None,
    background: bool = False,
) -> StereoSlam:
    """Build stereo SLAM with the camera's mount: `mount` when it is known (from tf), else from
    the settings, and whatever the settings leave open is measured from the floor the camera
    sees. background: adjust the map beside tracking.
    """
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
    return StereoSlam(camera, settings, mount, meter, times, background)
