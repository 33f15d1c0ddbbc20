"""Guessing what kind of recording an input is."""

from __future__ import annotations

from pathlib import Path

from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.camera.sources.bag import open_bag
from segfloor_ros.camera.sources.bag_file import is_bag
from segfloor_ros.camera.sources.depth_images import DEPTH, is_tum_rgbd, open_tum_rgbd
from segfloor_ros.camera.sources.euroc import is_euroc, open_euroc
from segfloor_ros.camera.sources.image_folders import has_image_sides, open_image_folders
from segfloor_ros.camera.sources.kitti import is_kitti, open_kitti
from segfloor_ros.camera.sources.masks import MaskFolder
from segfloor_ros.camera.sources.source import StereoSource
from segfloor_ros.camera.sources.video import is_device, is_video, open_device, open_video
from segfloor_ros.errors import InputError

KINDS = (
    'a KITTI odometry folder, an EuRoC folder, image folders left and right with left.yaml and '
    'right.yaml, a TUM RGB-D folder, a ROS bag (.mcap, .db3, .bag), or a video or device with a '
    'calibration'
)


def open_source(settings: StereoCameraSettings) -> StereoSource:
    """Open the recording or device `settings.input`, whatever its kind.

    Raises InputError when there is nothing to read or its parts do not fit together,
    CalibrationError when the calibration is missing, impossible or for other images.
    """
    if not settings.input:
        raise InputError(f'no input is given; set stereo_camera.input to {KINDS}')
    try:
        source = _open(settings)
        if settings.masks:
            source.masks = MaskFolder(Path(settings.masks).expanduser(), source.camera)
        return source
    except OSError as error:
        raise InputError(
            f'{error.filename or settings.input}: cannot be read ({error.strerror})'
        ) from None


def _open(settings: StereoCameraSettings) -> StereoSource:
    source = _open_any(settings)
    if settings.depth and not any(s.name == DEPTH and s.used for s in source.sensors):
        raise InputError(f'{source.name}: no depth images can be read from it; leave out --depth')
    return source


def _open_any(settings: StereoCameraSettings) -> StereoSource:
    path = Path(settings.input).expanduser()
    if is_device(settings.input) and not path.is_dir():
        return open_device(settings.input, settings)
    if not path.exists():
        raise InputError(f'{path}: no such file or folder; give {KINDS}')
    if path.is_dir():
        return _open_folder(path, settings)
    if is_bag(path):
        return open_bag(path, settings)
    if is_video(path):
        return open_video(path, settings)
    raise InputError(f'{path}: not a known kind of recording; give {KINDS}')


def _open_folder(folder: Path, settings: StereoCameraSettings) -> StereoSource:
    if is_tum_rgbd(folder):
        return open_tum_rgbd(folder, settings)
    if is_kitti(folder):
        return open_kitti(folder, settings)
    if is_euroc(folder):
        return open_euroc(folder, settings)
    if is_bag(folder):
        return open_bag(folder, settings)
    if has_image_sides(folder):
        return open_image_folders(folder, settings)
    raise InputError(f'{folder}: no recording was recognised in it; give {KINDS}')
