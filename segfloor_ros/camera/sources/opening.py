"""Guessing what kind of recording an input is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.camera.sources.bag import open_bag
from segfloor_ros.camera.sources.bag_file import is_bag
from segfloor_ros.camera.sources.depth_images import is_tum_rgbd, open_tum_rgbd
from segfloor_ros.camera.sources.image_folders import (
    has_image_sides,
    is_euroc,
    is_kitti,
    open_euroc,
    open_image_folders,
    open_kitti,
)
from segfloor_ros.camera.sources.source import MaskFolder, StereoSource
from segfloor_ros.camera.sources.video import is_device, is_video, open_device, open_video
from segfloor_ros.errors import InputError

KINDS = (
    'a KITTI odometry folder, an EuRoC folder, image folders left and right with left.yaml and '
    'right.yaml, a TUM RGB-D folder, a ROS bag (.mcap, .db3, .bag), or a video or device with a '
    'calibration'
)


Openers = tuple[
    tuple[Callable[[Path], bool], Callable[[Path, StereoCameraSettings], StereoSource]], ...
]
FOLDERS: Openers = (
    (is_tum_rgbd, open_tum_rgbd),
    (is_kitti, open_kitti),
    (is_euroc, open_euroc),
    (is_bag, open_bag),
    (has_image_sides, open_image_folders),
)
FILES: Openers = ((is_bag, open_bag), (is_video, open_video))
"""What recognises a kind of recording, and what opens it."""


def open_source(settings: StereoCameraSettings) -> StereoSource:
    """Open the recording or device `settings.input`, whatever its kind.

    Raises InputError when there is nothing to read or its parts do not fit together,
    CalibrationError when the calibration is missing, impossible or for other images.
    """
    if not settings.input:
        raise InputError(f'no input is given; set stereo_camera.input to {KINDS}')
    try:
        source = _open(settings)
        if settings.depth and not source.takes_depth:
            raise InputError(
                f'{source.name}: no depth images can be read from it; leave out --depth'
            )
        if settings.masks:
            source.masks = MaskFolder(Path(settings.masks).expanduser(), source.camera)
        return source
    except OSError as error:
        raise InputError(
            f'{error.filename or settings.input}: cannot be read ({error.strerror})'
        ) from None


def _open(settings: StereoCameraSettings) -> StereoSource:
    path = Path(settings.input).expanduser()
    if is_device(settings.input) and not path.is_dir():
        return open_device(settings.input, settings)
    if not path.exists():
        raise InputError(f'{path}: no such file or folder; give {KINDS}')
    for recognises, open_path in FOLDERS if path.is_dir() else FILES:
        if recognises(path):
            return open_path(path, settings)
    raise InputError(f'{path}: not a known kind of recording; give {KINDS}')
