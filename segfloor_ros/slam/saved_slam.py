"""SLAM as a part of a saved map, and SLAM that goes on with one."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.errors import InputError, MapError
from segfloor_ros.geometry import invert, transform_points
from segfloor_ros.map_file import MapFile
from segfloor_ros.slam.results import KeyframePath, SparseCloud
from segfloor_ros.slam.stereo_slam import StereoSlam

PART = 'slam'
BEFORE_ALL_NS = -1_000_000_000
"""Where the stamps of a loaded map end: a new drive comes after it, whatever its clock says."""


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
        'T_world_odom': slam.T_world_odom.tolist(),
    }
    return MapFile(header, {PART: slam.to_arrays()})


def load_slam(
    slam: StereoSlam,
    camera: StereoCamera,
    saved: MapFile,
    name: str,
    localize: bool = False,
    ends_ns: int | None = BEFORE_ALL_NS,
) -> LoadedMap:
    """Go on with a saved map, before the first frame. name: of the file. localize: the map stays as
    it is. ends_ns: the stamp that the last keyframe of the map is to have; None: the drive that was
    saved goes on, with its stamps and its `odom`, and is looked for where it ended.

    Raises InputError for a map that is damaged or of another camera.
    """
    try:
        if saved.header['camera'] != asdict(camera):
            raise InputError(f'{name}: was made with another camera or calibration; map anew')
        mount, arrays = Mount(**saved.header['mount']), saved.parts[PART]
        stamp_ns = arrays['keyframe_stamp_ns']
        shift_ns = 0 if ends_ns is None else ends_ns - int(stamp_ns[-1])
        T_world_odom = np.array(saved.header['T_world_odom']) if ends_ns is None else None
        moved = arrays | {'keyframe_stamp_ns': stamp_ns + shift_ns}
        slam.load(moved, mount, localize, T_world_odom)
        T_map_world = mount.T_base_left
        T_map_base = T_map_world @ invert(arrays['keyframe_T_camera_world']) @ invert(T_map_world)
        xyz = transform_points(T_map_world, arrays['point_xyz_world']).astype(np.float32)
        return LoadedMap(
            KeyframePath(stamp_ns + shift_ns, T_map_base),
            SparseCloud(arrays['point_stable_id'], xyz),
            shift_ns,
        )
    except (KeyError, ValueError, IndexError, TypeError):
        raise InputError(f'{name}: parts of the map do not fit; save it anew') from None
