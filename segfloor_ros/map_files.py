"""What can be done with saved maps without driving: look at them, compare them, make one of two.

Saved maps are the files of `--save-map`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.errors import InputError, MapError
from segfloor_ros.evaluation.maps import resample
from segfloor_ros.files.results import Arrays, MapFile, read_map_file
from segfloor_ros.geometry import planar
from segfloor_ros.grid.map_file import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    OccupancyGridSettings,
    enlarged,
)
from segfloor_ros.grid.mapper import OccupancyGridMapper
from segfloor_ros.slam.places.loop_closing import OFFSET, as_seen_by, merge_slam
from segfloor_ros.slam.places.loops import MAX_SLOPE, MAX_STEP_UP_M
from segfloor_ros.slam.results import KeyframePath, SparseCloud
from segfloor_ros.slam.rig import Rig
from segfloor_ros.slam.saved_slam import (
    PART,
    gap_ns,
    loaded_map,
    mount_of,
    saved_camera,
    sessions_of,
)

APPEARED_BGR, GONE_BGR = (40, 40, 220), (60, 170, 60)


@dataclass(frozen=True)
class SavedMap:
    """A saved map and the name of its file. Everything raises InputError, by that name, for parts
    that are damaged.
    """

    name: str
    file: MapFile

    @property
    def slam(self) -> Arrays:
        """What SLAM knows."""
        return self.file.parts[PART]

    def grid(self) -> OccupancyGrid:
        """Return the occupancy grid."""
        return grid_of(self.file.parts['grid'])

    def facts(self) -> dict[str, Any]:
        """Return what the map holds, by name: counts, areas in m², metres."""
        slam, camera, mount = self.slam, saved_camera(self.file, self.name), mount_of(self.file)
        grid = self.grid()
        known_y, known_x = np.nonzero(grid.cells != UNKNOWN)
        poses = loaded_map(self.file, 0).path.T_map_base
        steps_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        return {
            'keyframes': len(poses),
            'points': len(slam['point_stable_id']),
            'loops': len(slam['loop_ends']),
            'path_m': round(float(steps_m.sum()), 2),
            'free_m2': round(grid.area_m2(grid.cells == FREE), 2),
            'occupied_m2': round(grid.area_m2(grid.cells == OCCUPIED), 2),
            'size_m': [
                round(float(np.ptp(known) + 1) * grid.resolution_m, 2) if len(known) else 0.0
                for known in (known_x, known_y)
            ],
            'camera': f'{camera.width}x{camera.height}, baseline {camera.baseline_m:.3f} m',
            'camera_height_m': round(mount.height_m, 3),
            'sessions': sessions_of(self.file),
        }


def open_map(path: Path) -> SavedMap:
    """Read a saved map with all its parts. Raises InputError."""
    saved = SavedMap(str(path), read_map_file(path))
    with _parts_that_fit(saved.name):
        saved.facts()
    return saved


@contextmanager
def _parts_that_fit(name: str) -> Iterator[None]:
    """Raise InputError, by the name of a file, where its parts turn out to be damaged."""
    try:
        yield
    except (ArithmeticError, LookupError, ValueError, TypeError, AttributeError):
        raise InputError(f'{name}: parts of the map do not fit; save it anew') from None


def merge(first: SavedMap, second: SavedMap) -> SavedMap:
    """Return two maps as one, in the frame of the first; its keyframes come first. The cameras may
    differ, but not how they are mounted. Raises InputError where they are, MapError where no place
    is in both.
    """
    _check_mounts(first, second)
    added = _after(first, second)
    camera = saved_camera(first.file, first.name)
    with _parts_that_fit(f'{first.name} or {second.name}'):
        slam = merge_slam(first.slam, added.parts[PART], Rig(camera, mount_of(first.file)))
    if slam is None:
        raise MapError(
            f'{second.name}: shows no place of {first.name}; both must have seen the same things '
            'from the same side over half a metre or more'
        )
    sessions = sessions_of(first.file) + sessions_of(second.file)
    merged = MapFile(first.file.header | {'sessions': sessions}, {PART: slam})
    both = first.file, added
    merged.parts['cloud'] = _labels(loaded_map(merged, 0).cloud, both)
    merged.parts['grid'] = _evidence(loaded_map(merged, 0).path, both)
    return SavedMap(f'{first.name} and {second.name}', merged)


def _check_mounts(first: SavedMap, second: SavedMap) -> None:
    mount, other = mount_of(first.file), mount_of(second.file)
    turned = max(abs(mount.pitch_rad - other.pitch_rad), abs(mount.roll_rad - other.roll_rad))
    if abs(mount.height_m - other.height_m) > MAX_STEP_UP_M or turned > MAX_SLOPE:
        raise InputError(
            f'{second.name}: the camera is not mounted as in {first.name} (it is '
            f'{other.height_m:.2f} m above the floor, not {mount.height_m:.2f} m); keep both maps'
        )


def _after(first: SavedMap, second: SavedMap) -> MapFile:
    """Return the second map as the camera of the first would have measured it, with ids and stamps
    that come after those of the first.
    """
    slam, parts = second.slam, second.file.parts
    count, shift_ns = first.slam['num_ever'], gap_ns(first.slam, slam)
    seen = as_seen_by(
        saved_camera(first.file, first.name),
        float(first.slam[OFFSET][0]),
        saved_camera(second.file, second.name),
        slam,
    )
    ids = slam['point_stable_id'] + count.astype(np.int32)
    stamp_ns = slam['keyframe_stamp_ns'] + shift_ns
    changed = {
        'keyframe_stamp_ns': stamp_ns,
        'point_stable_id': ids,
        'num_ever': slam['num_ever'] + count,
    }
    cloud = parts['cloud'] | {'point_id': parts['cloud']['point_id'] + count.astype(np.int32)}
    grid = parts['grid'] | {'stamp_ns': parts['grid']['stamp_ns'] + shift_ns}
    return MapFile(second.file.header, {PART: seen | changed, 'cloud': cloud, 'grid': grid})


def _labels(cloud: SparseCloud, files: Sequence[MapFile]) -> Arrays:
    """Return what is known of the points of a cloud that was merged of those of files; floor and
    height move along with a point.
    """
    parts = []
    for file in files:
        known, before = file.parts['cloud'], loaded_map(file, 0).cloud
        row = np.searchsorted(cloud.point_id, known['point_id'])
        row = np.minimum(row, len(cloud.point_id) - 1)
        kept = cloud.point_id[row] == known['point_id']
        at = np.searchsorted(before.point_id, known['point_id'][kept])
        raised_m = cloud.xyz_map[row[kept], 2] - before.xyz_map[at, 2]
        part = {name: column[kept] for name, column in known.items()}
        part |= {name: part[name] + raised_m for name in ('floor_z_m', 'judged_z_m')}
        parts.append(part)
    return _joined(parts)


def _evidence(path: KeyframePath, files: Sequence[MapFile]) -> Arrays:
    """Return the evidence of keyframes that were merged of those of files."""
    arrays = _joined([file.parts['grid'] for file in files])
    row = np.searchsorted(path.stamp_ns, arrays['stamp_ns'])
    return arrays | {'pose': planar(path.T_map_base[row])}


def _joined(parts: Sequence[Arrays]) -> Arrays:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def changes(first: SavedMap, second: SavedMap) -> tuple[OccupancyGrid, NDArray[np.int8]]:
    """Return the map that both make, and what changed (H, W) from the first to the second: 1 in
    cells that were free and are occupied, -1 the other way round, else 0. What stands beside a cell
    in which something stood before is the same. Raises what `merge` does.
    """
    whole = merge(first, second).file.parts['grid']
    grid, count = grid_of(whole), len(first.file.parts['grid']['stamp_ns'])
    poses = whole['pose'][:count], whole['pose'][count:]
    then, now = (
        resample(grid_of(saved.file.parts['grid'] | {'pose': pose}), grid)
        for saved, pose in zip((first, second), poses, strict=True)
    )
    stood, stands = (_occupied_or_beside(cells) for cells in (then, now))
    change = np.zeros(grid.cells.shape, np.int8)
    change[(now == OCCUPIED) & (then == FREE) & ~stood] = 1
    change[(then == OCCUPIED) & (now == FREE) & ~stands] = -1
    return grid, change


def draw_changes(grid: OccupancyGrid, change: NDArray[np.int8]) -> NDArray[np.uint8]:
    """Return a picture (h, w, 3) BGR of a map and of what `changes` says of it."""
    picture = cv2.cvtColor(grid.picture, cv2.COLOR_GRAY2BGR)
    for sign, colour in ((1, APPEARED_BGR), (-1, GONE_BGR)):
        picture[change[::-1] == sign] = colour
    return enlarged(picture)


def grid_of(evidence: Arrays) -> OccupancyGrid:
    """Return the occupancy grid of the evidence that a map holds."""
    mapper = OccupancyGridMapper(OccupancyGridSettings())
    mapper.from_arrays(evidence, evidence['stamp_ns'])
    return mapper.grid()


def _occupied_or_beside(cells: NDArray[np.int8]) -> NDArray[np.bool_]:
    return cv2.dilate((cells == OCCUPIED).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
