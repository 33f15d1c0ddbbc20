"""SLAM as a part of a saved map, and SLAM that goes on with one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.errors import CalibrationError, InputError, MapError
from segfloor_ros.geometry import invert, transform_points
from segfloor_ros.map_file import MapFile
from segfloor_ros.measurements import WheelPose
from segfloor_ros.slam.results import KeyframePath, LastPose, SparseCloud
from segfloor_ros.slam.stereo_slam import StereoSlam

PART = 'slam'
BEFORE_ALL_NS = -1_000_000_000
"""Where the stamps of a loaded map end: a new drive comes after it, whatever its clock says."""

PLACES = ('point_xyz_world', 'keyframe_T_camera_world', 'keyframe_T_camera_followed')
LAST_ARRAYS = ('T_camera_world', 'T_world_odom', 'covariance', 'velocity')

LOST_IDS = 1_000_000
"""More than a drive gives to points after its map was kept for the last time: who goes on with that
map does not give them again."""


@dataclass(frozen=True)
class LoadedMap:
    """What SLAM has loaded, for the stages behind it: all keyframes, all points, and by how much
    the stamps of the keyframes are later than in the file.
    """

    path: KeyframePath
    cloud: SparseCloud
    shift_ns: int


def save_slam(slam: StereoSlam, camera: StereoCamera) -> MapFile:
    """Return what SLAM knows. Raises MapError before there is a map."""
    if slam.mount is None or not slam.map.keyframes:
        raise MapError('there is no map yet that could be saved')
    header = {
        'camera': asdict(camera),
        'mount': asdict(slam.mount),
    }
    return MapFile(header, {PART: slam.to_arrays()})


def load_slam(
    slam: StereoSlam,
    camera: StereoCamera,
    saved: MapFile,
    name: str,
    localize: bool = False,
    last: LastPose | None = None,
) -> LoadedMap:
    """Go on with a saved map, before the first frame. name: of the file. localize: the map stays as
    it is. last: where the drive that was saved was broken off: it goes on, with its stamps and its
    `odom`; else a new drive begins.

    Raises InputError for a map that is damaged or of another camera.
    """
    try:
        check_camera(saved, camera, name)
        mount, arrays = _mount(saved), saved.parts[PART]
        if not all(np.isfinite(arrays[column]).all() for column in PLACES):
            raise ValueError('places that are nowhere')
        stamp_ns = arrays['keyframe_stamp_ns']
        shift_ns = 0 if last is not None else BEFORE_ALL_NS - int(stamp_ns[-1])
        skipped = 0 if last is None else LOST_IDS
        moved = arrays | {
            'keyframe_stamp_ns': stamp_ns + shift_ns,
            'num_ever': arrays['num_ever'] + skipped,
        }
        slam.load(moved, mount, localize, last)
        return loaded_map(saved, shift_ns)
    except (ArithmeticError, LookupError, ValueError, TypeError):
        raise InputError(f'{name}: parts of the map do not fit; save it anew') from None


def last_pose_values(last: LastPose) -> dict[str, Any]:
    """Return where a drive may be broken off as values of JSON."""
    wheels = [[pose.stamp_ns, pose.T_wheels_base.tolist()] for pose in last.wheels]
    arrays = {name: getattr(last, name).tolist() for name in LAST_ARRAYS}
    return {'stamp_ns': last.stamp_ns, 'wheels': wheels, **arrays}


def last_pose_of(values: Mapping[str, Any]) -> LastPose:
    """Return what `last_pose_values` was made of. Raises InputError."""
    try:
        arrays = {name: np.array(values[name], float) for name in LAST_ARRAYS}
        wheels = tuple(WheelPose(int(ns), np.array(T, float)) for ns, T in values['wheels'])
        return LastPose(int(values['stamp_ns']), wheels=wheels, **arrays)
    except (KeyError, ValueError, TypeError):
        raise InputError('kept map: does not say where the drive was broken off') from None


def saved_camera(saved: MapFile, name: str) -> StereoCamera:
    """Return the camera that a map was made with. Raises InputError, by the file's name."""
    try:
        return StereoCamera(**saved.header['camera'])
    except (KeyError, TypeError, CalibrationError):
        raise InputError(f'{name}: does not say its camera; save it anew') from None


def check_camera(saved: MapFile, camera: StereoCamera, name: str) -> None:
    """Raise InputError, by the file's name, for a map that was made with another camera."""
    if saved_camera(saved, name) != camera:
        raise InputError(f'{name}: was made with another camera or calibration; map anew')


def loaded_map(saved: MapFile, shift_ns: int) -> LoadedMap:
    """Return what a saved map holds for the stages behind SLAM."""
    T_map_world, arrays = _mount(saved).T_base_left, saved.parts[PART]
    T_map_base = T_map_world @ invert(arrays['keyframe_T_camera_world']) @ invert(T_map_world)
    xyz = transform_points(T_map_world, arrays['point_xyz_world']).astype(np.float32)
    path = KeyframePath(arrays['keyframe_stamp_ns'] + shift_ns, T_map_base)
    return LoadedMap(path, SparseCloud(arrays['point_stable_id'], xyz), shift_ns)


def _mount(saved: MapFile) -> Mount:
    """Return the mount that a map was made with. Raises KeyError, TypeError or ValueError."""
    values = saved.header['mount']
    if not all(type(value) in (int, float) and math.isfinite(value) for value in values.values()):
        raise ValueError('a mount of no numbers')
    return Mount(**values)


def new_keyframes(path: KeyframePath) -> KeyframePath:
    """Return the keyframes of the drive itself, without those of the map that was loaded."""
    new = path.stamp_ns >= 0
    return KeyframePath(path.stamp_ns[new], path.T_map_base[new])
