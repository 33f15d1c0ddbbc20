"""A saved map without the views that later ones show again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from segfloor_ros.core.contracts import NO_POINT
from segfloor_ros.core.files.arrays import Arrays, MapFile, split, take
from segfloor_ros.core.files.results import read_map_file, write_map_file
from segfloor_ros.core.geometry import Array, invert, transform_points
from segfloor_ros.core.grid.keyframe_evidence import LENGTHS
from segfloor_ros.core.plugins.maps.map_arrays import OF_KEYFRAMES
from segfloor_ros.core.plugins.maps.saved_slam import PART as SLAM
from segfloor_ros.core.plugins.maps.saved_slam import parts_that_fit
from segfloor_ros.core.plugins.semantics.label_map import LABELS, SEEN_LENGTHS
from segfloor_ros.core.slam.places.views import NEW_MOTION_RATIO, SECOND_VISIT, novelty
from segfloor_ros.core.slam.rig import MIN_DEPTH_M
from segfloor_ros.core.slam.thresholds import MAJORITY, PROOF

OF_KEYFRAME = 'keyframe_', 'feature_', 'corner_', 'word'
"""How the names of arrays begin that hold something for each keyframe."""


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


def prune(saved: MapFile) -> MapFile:
    """Return a saved map without the views that later ones show again: what its parts know of the
    keyframes and points that go, goes with them. Raises KeyError, IndexError or ValueError for a
    map that is damaged.
    """
    slam, latest_ns = prune_slam(saved.parts[SLAM])
    parts = saved.parts | {SLAM: slam}
    cloud, latest_ns = saved.parts['cloud'], np.intersect1d(latest_ns, slam['keyframe_stamp_ns'])
    parts['cloud'] = take(cloud, np.isin(cloud['point_id'], slam['point_stable_id']), {})
    for name, lengths in (('grid', LENGTHS), (LABELS, SEEN_LENGTHS)):
        arrays = saved.parts.get(name, {})
        of_keyframes = {column: array for column, array in arrays.items() if column != 'names'}
        if arrays:
            stays = np.isin(arrays['stamp_ns'], latest_ns)
            parts[name] = arrays | take(of_keyframes, stays, lengths)
    return MapFile(saved.header, parts)


def prune_file(path: Path) -> str:
    """Prune the map in a file; returns its name and size in words. Raises InputError."""
    saved = read_map_file(path)
    with parts_that_fit(str(path)):
        pruned = prune(saved)
    write_map_file(path, pruned)
    before, after = (len(file.parts[SLAM]['keyframe_stamp_ns']) for file in (saved, pruned))
    return f'{path}, {before} keyframes before, {after} now'


def views_to_keep(
    T_camera_world: Array,
    depth_m: Array,
    may_stand_in: NDArray[np.bool_],
    shared: sparse.csr_array | None = None,
) -> NDArray[np.intp]:
    """Return for each view (K, 4, 4) of a map, the oldest first, which sees things at about depth_m
    (K,), the view that stands for it: itself, or where a later visit shows the same, the nearest
    of that visit that may (K,). Views then grow with the area, not with the visits. The first one
    stays, since it holds the map.

    shared: the share (K, K) of the points of one view that another observes. With it a later visit
    shows the same where it observes most of them, so in the same light. Of others the views of
    `PROOF` visits stay: those go first of which a later one observes most.
    """
    number, centres = np.arange(len(depth_m)), invert(T_camera_world)[:, :3, 3]
    reach_m = SECOND_VISIT * NEW_MOTION_RATIO * depth_m
    around, alike, likest = [], [], np.zeros(len(number))
    for k in number:
        near = np.flatnonzero(np.linalg.norm(centres - centres[k], axis=1) < reach_m[k])
        new = novelty(T_camera_world[near] @ invert(T_camera_world[k]), float(depth_m[k]))
        near, new = near[new < SECOND_VISIT], new[new < SECOND_VISIT]
        # The views of one visit follow each other.
        visit = np.cumsum(np.diff(near, prepend=0) > 1)
        later = visit > visit[near == k]
        around.append((near, new, visit, later))
        share = np.ones(len(near)) if shared is None else shared[[k]].toarray()[0, near]
        alike.append(share >= MAJORITY)
        likest[k] = share[later].max(initial=0.0)
    visits, order = (
        (1, number[:0:-1])
        if shared is None
        else (PROOF, 1 + np.argsort(-likest[1:], kind='stable'))
    )
    stands_in = number.copy()
    for k in order.tolist():
        near, new, visit, later = around[k]
        stays = (may_stand_in[near] & (stands_in[near] == near)) | (near == k)
        later = later & stays
        if len(np.unique(visit[stays])) <= visits:
            later &= alike[k]
        if later.any():
            stands_in[stands_in == k] = near[later][new[later].argmin()]
    return stands_in
