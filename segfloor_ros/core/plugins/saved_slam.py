"""SLAM as a part of a saved map, and SLAM that goes on with one.

Features that show no point are left out, and so are the motions that sensors measured; nothing is
lost that tracking, relocalisation or the closing of loops need.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import (
    NO_POINT,
    KeyframePath,
    LastPose,
    Mount,
    SparseCloud,
    WheelPose,
)
from segfloor_ros.core.errors import CalibrationError, InputError, MapError
from segfloor_ros.core.files.results import Arrays, MapFile, joined, split, take
from segfloor_ros.core.geometry import Array, invert, transform_points, without_drift
from segfloor_ros.core.plugins.sensors.gyroscope import MOMENT_NS
from segfloor_ros.core.slam.places.views import views_to_keep
from segfloor_ros.core.slam.rig import MIN_DEPTH_M, Observations
from segfloor_ros.core.slam.sparse_map import (
    NOTHING,
    OF_KEYFRAMES,
    GroundView,
    KeyframeRecord,
    LoopEdge,
    Retirement,
    SparseMap,
)

if TYPE_CHECKING:  # which uses this module
    from segfloor_ros.core.slam.stereo_slam import StereoSlam

PART = 'slam'
BEFORE_ALL_NS = -MOMENT_NS
"""Where the stamps of a loaded map end: a new drive comes after it, whatever its clock says."""

PLACES = ('point_xyz_world', 'keyframe_T_camera_world', 'keyframe_T_camera_followed')
OF_KEYFRAME = 'keyframe_', 'feature_', 'corner_', 'word'
"""How the names of arrays begin that hold something for each keyframe."""
BENT = 1e-3
"""Rotations that are off by more bend a map by as many metres per metre."""

LAST_ARRAYS = ('T_camera_world', 'T_world_odom', 'covariance', 'velocity')

LOST_IDS = 1_000_000
"""More than a drive gives to points after its map was kept for the last time: who goes on with that
map does not give them again."""

logger = logging.getLogger(__name__)


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
    arrays = slam.to_arrays()
    own_ns = arrays['keyframe_stamp_ns'][arrays['keyframe_stamp_ns'] >= 0].tolist()
    sessions = slam.sessions
    if own_ns:
        own = {'first_ns': own_ns[0], 'last_ns': own_ns[-1], 'keyframes': len(own_ns)}
        # A drive that goes on after it was broken off is in the list already.
        sessions = [s for s in sessions if s['first_ns'] != own_ns[0]] + [own]
    header = {'camera': asdict(camera), 'mount': asdict(slam.mount), 'sessions': sessions}
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


def mount_of(saved: MapFile) -> Mount:
    """Return the mount that a map was made with. Raises KeyError, TypeError or ValueError."""
    values = saved.header['mount']
    if not all(type(value) in (int, float) and math.isfinite(value) for value in values.values()):
        raise ValueError('a mount of no numbers')
    return Mount(**values)


def new_keyframes(path: KeyframePath) -> KeyframePath:
    """Return the keyframes of the drive itself, without those of the map that was loaded."""
    new = path.stamp_ns >= 0
    return KeyframePath(path.stamp_ns[new], path.T_map_base[new])


def map_to_arrays(sparse_map: SparseMap) -> Arrays:
    """Return a map as arrays; points are numbered anew in the order of their ids."""
    alive = np.flatnonzero(sparse_map.alive)
    alive = alive[np.argsort(sparse_map.stable_id[alive])]
    new_row = np.full(len(sparse_map.alive) + 1, NO_POINT, np.int32)
    new_row[alive] = np.arange(len(alive), dtype=np.int32)
    keyframes = sparse_map.keyframes
    shown = [np.flatnonzero(k.point_id != NO_POINT) for k in keyframes]
    pairs = list(zip(keyframes, shown, strict=True))
    uvd, length = joined([k.observations.uvd_px[r] for k, r in pairs], np.zeros((0, 3)))
    sigma, _ = joined([k.observations.sigma_px[r] for k, r in pairs], np.zeros((0, 3)))
    octave, _ = joined([k.octave[r] for k, r in pairs], np.zeros(0, np.uint8))
    point, _ = joined([new_row[k.point_id[r]] for k, r in pairs], np.zeros(0, np.int32))
    links, link_length = joined(
        [np.array(k.links, np.int32) for k in keyframes], np.zeros(0, np.int32)
    )
    retired = [_followed(sparse_map, k) for k in keyframes]
    corners, corner_count = joined([k.ground.xy_m for k in keyframes], NOTHING.xy_m)
    looks, _ = joined([k.ground.descriptor for k in keyframes], NOTHING.descriptor)
    loops = sparse_map.loops
    return sparse_map.points.to_arrays(alive) | {
        'keyframe_frame_index': np.array([k.frame_index for k in keyframes], np.int64),
        'keyframe_stamp_ns': np.array([k.stamp_ns for k in keyframes], np.int64),
        'keyframe_T_camera_world': _stack([k.T_camera_world for k in keyframes]),
        'keyframe_features': length,
        'keyframe_link_count': link_length,
        'keyframe_links': links,
        'keyframe_follows': np.array([r.reference for r in retired], np.int32),
        'keyframe_T_camera_followed': _stack([r.T_camera_reference for r in retired]),
        'feature_uvd_px': uvd.astype(np.float32),
        'feature_sigma_px': sigma.astype(np.float16),
        'feature_octave': octave,
        'feature_point': point,
        'keyframe_corners': corner_count,
        'corner_xy_m': corners,
        'corner_descriptor': looks,
        'loop_ends': np.array([(e.i, e.j) for e in loops], np.int32).reshape(-1, 2),
        'loop_T_i_j': _stack([e.T_i_j for e in loops]),
        'loop_by_floor': np.array([e.by_floor for e in loops], bool),
    }


def fill_map(sparse_map: SparseMap, arrays: Arrays) -> None:
    """Add a map, whose stable ids come later, to one without gaps: an empty one, or one that was
    filled like this. Raises KeyError or ValueError for arrays that are no map.
    """
    first, first_row = len(sparse_map.keyframes), len(sparse_map.alive)
    sparse_map.points.from_arrays(arrays, first)
    for index, record in enumerate(_keyframes(arrays, first, first_row), first):
        if record.index != index or (record.point_id >= len(sparse_map.alive)).any():
            raise ValueError('features of points that are not there')
        sparse_map.restore(record)
    ends, T_i_j = (arrays['loop_ends'] + first).tolist(), arrays['loop_T_i_j']
    # Maps of earlier releases have loops by points alone.
    by_floor = arrays.get('loop_by_floor', np.zeros(len(ends), bool)).tolist()
    of_loops = zip(ends, T_i_j, by_floor, strict=True)
    sparse_map.loops += [LoopEdge(i, j, T, by) for (i, j), T, by in of_loops]


def prune_slam(arrays: Arrays) -> tuple[Arrays, NDArray[np.int64]]:
    """Return a map without the keyframes whose views later ones show again in the same light
    (`views_to_keep`), nor the points that no other keyframe observes; and the stamps of keyframes
    whose views no later ones show again in any light: what was taken away goes with what the others
    have seen of the floor. Raises KeyError, IndexError or ValueError for arrays that are no map.
    """
    poses, follows = arrays['keyframe_T_camera_world'], arrays['keyframe_follows']
    numbers = np.arange(len(poses))
    root = np.where(follows == NO_POINT, numbers, follows)
    views = poses, _depth_m(arrays)[root], follows == NO_POINT
    stands_in = views_to_keep(*views, _shared(arrays)[root])
    latest_ns = arrays['keyframe_stamp_ns'][views_to_keep(*views) == numbers]
    stays = stands_in == numbers
    number = (np.cumsum(stays) - 1)[stands_in].astype(np.int32)
    by_keyframe = {n: a for n, a in arrays.items() if n.startswith(OF_KEYFRAME)}
    lengths = {'keyframe_links': 'keyframe_link_count', 'words': 'word_count'}
    for kind in ('feature', 'corner'):
        columns = (n for n in arrays if n.startswith(f'{kind}_'))
        lengths |= dict.fromkeys(columns, f'keyframe_{kind}s')
    pruned = arrays | take(by_keyframe, stays, lengths)

    alive, point = np.unique(pruned['feature_point'], return_inverse=True)
    pruned['feature_point'] = point.astype(np.int32)
    pruned |= {n: array[alive] for n, array in arrays.items() if n.startswith('point_')}
    pruned |= {f'point_{name}': number[pruned[f'point_{name}']] for name in OF_KEYFRAMES}

    linking = np.repeat(numbers, arrays['keyframe_link_count'])
    links = np.sort(number[np.column_stack([arrays['keyframe_links'], linking])], axis=1)
    links = np.unique(links[links[:, 0] < links[:, 1]][:, ::-1], axis=0)
    pruned['keyframe_links'] = links[:, 1]
    pruned['keyframe_link_count'] = np.bincount(links[:, 0], minlength=stays.sum())

    holder = stands_in[root[stays]]
    pruned['keyframe_follows'] = np.where(follows[stays] == NO_POINT, NO_POINT, number[holder])
    pruned['keyframe_T_camera_followed'] = poses[stays] @ invert(poses[holder])

    ends = arrays['loop_ends']
    i, j = stands_in[ends].T
    to_i, from_j = poses[i] @ invert(poses[ends[:, 0]]), poses[ends[:, 1]] @ invert(poses[j])
    loops = np.unique(number[ends], axis=0, return_index=True)[1]
    loops = loops[i[loops] != j[loops]]
    pruned['loop_ends'] = number[ends][loops]
    pruned['loop_T_i_j'] = (to_i @ arrays['loop_T_i_j'] @ from_j)[loops]
    if 'loop_by_floor' in arrays:
        pruned['loop_by_floor'] = arrays['loop_by_floor'][loops]
    return pruned, latest_ns


def _shared(arrays: Arrays) -> sparse.csr_array:
    """Return the share (K, K) of the points of each keyframe of a map that another observes."""
    length, point = arrays['keyframe_features'], arrays['feature_point']
    ends = np.append(0, np.cumsum(length))
    shape = len(length), len(arrays['point_stable_id'])
    observes = sparse.csr_array((np.ones(len(point)), point, ends), shape)
    shared = observes @ observes.T
    return sparse.csr_array(shared.multiply(1.0 / np.maximum(length, 1)[:, None]))


def _depth_m(arrays: Arrays) -> Array:
    """Return the median depth (K,) of what the keyframes of a map observe."""
    observed = split(arrays['feature_point'], arrays['keyframe_features'])
    seen = zip(observed, arrays['keyframe_T_camera_world'], strict=True)
    depths = [transform_points(T, arrays['point_xyz_world'][ids])[:, 2] for ids, T in seen]
    return np.array([max(np.median(z), MIN_DEPTH_M) if len(z) else MIN_DEPTH_M for z in depths])


def moved(arrays: Arrays, T_new_old: Array) -> Arrays:
    """Return a map seen from another world frame."""
    return arrays | {
        'point_xyz_world': transform_points(T_new_old, arrays['point_xyz_world']),
        'point_viewing_direction': arrays['point_viewing_direction'] @ T_new_old[:3, :3].T,
        'keyframe_T_camera_world': arrays['keyframe_T_camera_world'] @ invert(T_new_old),
    }


def _keyframes(arrays: Arrays, first: int, first_row: int) -> list[KeyframeRecord]:
    length = arrays['keyframe_features']
    features = [arrays[f'feature_{name}'] for name in ('uvd_px', 'sigma_px', 'octave', 'point')]
    if any(array.shape[1:] != (3,) for array in features[:2]) or (features[3] < 0).any():
        raise ValueError('features that are measured nowhere, or show no point')
    uvd, sigma, octave, point = (split(array, length) for array in features)
    links = split(arrays['keyframe_links'], arrays['keyframe_link_count'])
    grounds = [NOTHING] * len(length)
    if 'keyframe_corners' in arrays:  # not in maps of earlier releases
        corners = (
            split(arrays[name], arrays['keyframe_corners'])
            for name in ('corner_xy_m', 'corner_descriptor')
        )
        grounds = [GroundView(xy_m, look) for xy_m, look in zip(*corners, strict=True)]
    records = []
    for k, stamp_ns in enumerate(arrays['keyframe_stamp_ns'].tolist()):
        follows = int(arrays['keyframe_follows'][k])
        retired = Retirement(first + follows, arrays['keyframe_T_camera_followed'][k])
        records.append(
            KeyframeRecord(
                first + k,
                int(arrays['keyframe_frame_index'][k]),
                stamp_ns,
                arrays['keyframe_T_camera_world'][k],
                None,
                octave[k],
                Observations(uvd[k], sigma[k]),
                (first_row + point[k]).astype(np.int32),
                retired=retired if follows != NO_POINT else None,
                links=tuple((first + links[k]).tolist()),
                ground=grounds[k],
            )
        )
    return records


def _followed(sparse_map: SparseMap, keyframe: KeyframeRecord) -> Retirement:
    """Return the keyframe with features that a retired one follows in the end, `NO_POINT` for one
    that is not retired.
    """
    root = keyframe
    while root.retired is not None:
        root = sparse_map.keyframes[root.retired.reference]
    if root is keyframe:
        return Retirement(NO_POINT, np.eye(4))
    return Retirement(root.index, keyframe.T_camera_world @ root.T_world_camera)


def _stack(transforms: list[Array]) -> NDArray[Any]:
    return np.array(transforms, np.float64).reshape(-1, 4, 4)
