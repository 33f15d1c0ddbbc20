"""SLAM as a part of a saved map, and SLAM that goes on with one."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

import numpy as np

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import (
    KeyframePath,
    LastPose,
    LoadedMap,
    Mount,
    SparseCloud,
    WheelPose,
)
from segfloor_ros.core.errors import CalibrationError, InputError, MapError
from segfloor_ros.core.files.arrays import Arrays, MapFile
from segfloor_ros.core.geometry import invert, transform_points
from segfloor_ros.core.plugins.sensors.gyroscope import MOMENT_NS
from segfloor_ros.core.slam.stereo_slam import StereoSlam
from segfloor_ros.core.twists import without_drift

PART = 'slam'
BEFORE_ALL_NS = -MOMENT_NS
"""Where the stamps of a loaded map end: a new drive comes after it, whatever its clock says."""

PLACES = ('point_xyz_world', 'keyframe_T_camera_world', 'keyframe_T_camera_followed')
BENT = 1e-3
"""Rotations that are off by more bend a map by as many metres per metre."""

LAST_ARRAYS = ('T_camera_world', 'T_world_odom', 'covariance', 'velocity')

LOST_IDS = 1_000_000
"""More than a drive gives to points after its map was kept for the last time: who goes on with that
map does not give them again."""

logger = logging.getLogger(__name__)


def save_slam(slam: StereoSlam, camera: StereoCamera) -> MapFile:
    """Return what SLAM knows. Raises MapError before there is a map."""
    if slam.mount is None or not slam.map.keyframes:
        raise MapError('there is no map yet that could be saved')
    arrays = slam.to_arrays()
    own_ns = arrays['keyframe_stamp_ns'][arrays['keyframe_stamp_ns'] >= 0].tolist()
    sessions = slam.sessions
    if own_ns:
        own = {'first_ns': own_ns[0], 'last_ns': own_ns[-1], 'keyframes': len(own_ns)}
        # A drive that goes on after it was broken off is in the list already.
        sessions = [s for s in sessions if s['first_ns'] != own_ns[0]] + [own]
    rig = slam.rig
    header = {
        'camera': asdict(camera),
        'mount': asdict(rig.mount or slam.mount),
        'sessions': sessions,
        **({'base': asdict(rig.base)} if rig.base else {}),
    }
    return MapFile(header, {PART: arrays})


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
    with parts_that_fit(name):
        check_camera(saved, camera, name)
        saved = straightened(saved, name)
        mount, arrays = mount_of(saved), saved.parts[PART]
        stamp_ns = arrays['keyframe_stamp_ns']
        shift_ns = 0 if last is not None else BEFORE_ALL_NS - int(stamp_ns[-1])
        skipped = 0 if last is None else LOST_IDS
        moved = arrays | {
            'keyframe_stamp_ns': stamp_ns + shift_ns,
            'num_ever': arrays['num_ever'] + skipped,
        }
        slam.load(moved, mount, localize, last)
        slam.sessions = sessions_of(saved)
        return loaded_map(saved, shift_ns)


def straightened(saved: MapFile, name: str) -> MapFile:
    """Return a map with true rotations of its keyframes; releases up to 2026-11 let many loops bend
    them, which is said by the name of the file. Raises ValueError where something is nowhere.
    """
    arrays = saved.parts[PART]
    if not all(np.isfinite(arrays[column]).all() for column in PLACES):
        raise ValueError('places that are nowhere')
    straight = {column: without_drift(arrays[column]) for column in PLACES[1:]}
    off = max(float(np.abs(arrays[c] - T).max(initial=0.0)) for c, T in straight.items())
    if off < BENT:
        return saved
    logger.warning(
        '%s: is bent by up to %.0f %%, as it was made by a release that let every loop bend it a '
        'little more; map anew',
        name,
        100 * off,
    )
    return MapFile(saved.header, saved.parts | {PART: arrays | straight})


@contextmanager
def parts_that_fit(name: str) -> Iterator[None]:
    """Raise InputError, by the name of a file, where its parts turn out to be damaged."""
    try:
        yield
    except (ArithmeticError, LookupError, ValueError, TypeError, AttributeError):
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
    T_map_world, arrays = mount_of(saved).T_base_left, saved.parts[PART]
    T_map_base = T_map_world @ invert(arrays['keyframe_T_camera_world']) @ invert(T_map_world)
    xyz = transform_points(T_map_world, arrays['point_xyz_world']).astype(np.float32)
    path = KeyframePath(arrays['keyframe_stamp_ns'] + shift_ns, T_map_base)
    return LoadedMap(path, SparseCloud(arrays['point_stable_id'], xyz), shift_ns)


def gap_ns(first: Arrays, second: Arrays) -> int:
    """Return by how much the stamps of a second map are to grow to come after those of a first."""
    return int(first['keyframe_stamp_ns'][-1] - BEFORE_ALL_NS - second['keyframe_stamp_ns'][0])


def sessions_of(saved: MapFile) -> list[dict[str, int]]:
    """Return the drives that made a map; none are known of maps of earlier releases. Raises
    KeyError, TypeError or ValueError.
    """
    names = ('first_ns', 'last_ns', 'keyframes')
    return [{name: int(s[name]) for name in names} for s in saved.header.get('sessions', [])]


def base_of(saved: MapFile) -> Mount | None:
    """Return where poses alone had the base, None for at the mount. Raises as `mount_of`."""
    return mount_of(saved, 'base') if 'base' in saved.header else None


def mount_of(saved: MapFile, name: str = 'mount') -> Mount:
    """Return the mount that a map was made with. Raises KeyError, TypeError or ValueError."""
    values = saved.header[name]
    if not all(type(value) in (int, float) and math.isfinite(value) for value in values.values()):
        raise ValueError('a mount of no numbers')
    return Mount(**values)


def new_keyframes(path: KeyframePath) -> KeyframePath:
    """Return the keyframes of the drive itself, without those of the map that was loaded."""
    new = path.stamp_ns >= 0
    return KeyframePath(path.stamp_ns[new], path.T_map_base[new])
