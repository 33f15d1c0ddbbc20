"""Buildings that are driven through, there and back: are they recognised from the other side?

    python -m tools.there_and_back FOLDER      renders, measures, prints a row for each drive

Ten kinds of buildings, as many seeds as asked for. Sizes, furniture, textures and light follow from
the seed; floors take turns. The robot drives there, turns on the spot and drives back. Measured of
each drive, and kept beside it in paths.json and maps.json:

    path      error and loops; again at a focal length 1 % too long, with and without the floor
    session   the way back, in the map of the way there
    kidnaps   in the map of the drive as it went, in the map of the way there facing the other way
    merge     two maps: there and back, and two parts of the way there that overlap
"""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from segfloor_ros.apps.evaluation.trajectory import rigid_alignment
from segfloor_ros.apps.simulation.scene_file import scene_from_mapping
from segfloor_ros.apps.simulation.simulation import render_once
from segfloor_ros.apps.trajectory import corrected_trajectory, read_trajectory
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import FrameResult, StereoFrame
from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.core.files.results import read_map_file, write_map_file
from segfloor_ros.core.geometry import Array, invert, transform_points
from segfloor_ros.core.plugins.assembly import make_slam
from segfloor_ros.core.plugins.maps.known_map import OFFSET, as_seen_by, merge_slam
from segfloor_ros.core.plugins.maps.saved_slam import PART, gap_ns, load_slam, mount_of, save_slam
from segfloor_ros.core.slam.rig import DisparityOffset, Rig
from segfloor_ros.nodes.configuration import resolve
from tools.buildings import KINDS, make_building
from tools.driving import open_recording
from tools.mechanisms import NOTHING, SLAM
from tools.places import FALSE_M, Followed, is_false, tracked_poses, worse

COLUMNS = (
    'drive | floor | stretches driven back, known, loop closed | false loops | path, mm | '
    '1 % off without, with | way back found from, s | frames | kidnaps within 2 s | facing back: '
    'within 2 s, found | wrong | merged, mm | merged there and back, mm'
)

FLOOR = 'places by their floor'
STRETCH_M, BESIDE_M = 1.5, 0.6
"""The shortest straight part of a way that counts, and how far beside it the robot may be."""

PROOF, KIDNAPS, PATIENCE_S, NOISE = 3, 6, 6.0, 2.0
"""Keyframes that must see a stretch again; kidnaps of each sort, how long each may take, and the
noise added to their images, in grey levels: they are not those of the map."""

FOCAL_FACTOR = 1.01


Maps = tuple[Followed, dict[int, MapFile]]
"""SLAM after the last frame, and the map as it was after some frames, by index."""

Found = Iterator[tuple[int, int, float]]


@dataclass(frozen=True)
class Drive:
    """A rendered drive. truth: poses T_world_left (N, 4, 4). there, back: indices of the frames of
    either way. stretch: of each frame (N,), -1 beside all.
    """

    camera: StereoCamera
    frames: list[StereoFrame]
    truth: Array
    there: range
    back: range
    stretch: NDArray[np.intp]

    @cached_property
    def index(self) -> dict[int, int]:
        """Frames by stamp."""
        return {frame.stamp_ns: k for k, frame in enumerate(self.frames)}

    @property
    def kept(self) -> tuple[int, int]:
        """The frames after which the map so far is kept: on the way there, and at its end."""
        return self.there[6 * len(self.there) // 10], self.there[-1]


def open_drive(folder: Path, way: Array) -> Drive:
    """Read a drive along a way (M, 2) and back."""
    source = open_recording(folder, resolve())
    xy = np.loadtxt(folder / 'base_poses.txt')[:, 1:3]
    away_m = np.linalg.norm(xy - way[-1], axis=1)
    turn = np.linalg.norm(xy - xy[away_m.argmin()], axis=1) < 0.1
    first, last = int(turn.argmax()), len(xy) - 1 - int(turn[::-1].argmax())
    starts, steps = way[:-1], np.diff(way, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    along = np.einsum('nmi,mi->nm', xy[:, None] - starts, steps) / lengths**2
    nearest = starts + np.clip(along, 0, 1)[..., None] * steps
    beside_m = np.where(lengths < STRETCH_M, np.inf, 0)
    beside_m = beside_m + np.linalg.norm(xy[:, None] - nearest, axis=-1)
    stretch = np.where(beside_m.min(axis=1) < BESIDE_M, beside_m.argmin(axis=1), -1)
    frames = list(source.frames())
    truth = read_trajectory(folder / 'poses.txt')[1]
    return Drive(source.camera, frames, truth, range(first + 1), range(last, len(frames)), stretch)


def follow(drive: Drive, rows: Sequence[int], focal: float = 1.0, left_out: str = NOTHING) -> Maps:
    """Put some frames through SLAM. left_out: one of its mechanisms."""
    camera = drive.camera
    camera = dataclasses.replace(camera, fx=focal * camera.fx, fy=focal * camera.fy)
    maps = {}
    with SLAM[left_out].left_out():
        followed = Followed(make_slam(camera, resolve().stereo_slam))
        for k in rows:
            followed.process([drive.frames[k]])
            if k in drive.kept:
                maps[k] = save_slam(followed.slam, camera)
    maps[rows[-1]] = save_slam(followed.slam, camera)
    return followed, maps


def measure_path(drive: Drive, followed: Followed, focal: float) -> dict[str, Any]:
    """Return the error of the path, and the loops on the way back."""
    slam, seen = followed.slam, dict[str, list[int]](known=[], closed=[])
    verdicts: Counter[str] = Counter()
    for candidate in slam.back_end.loops.candidates:
        wrong = is_false(slam, drive.truth, candidate)
        verdicts[f'{candidate.verdict}: {"FALSE" if wrong else "true"}'] += 1
        frame = slam.map.keyframes[candidate.keyframe].frame_index
        if not wrong and frame in drive.back:
            stretch = int(drive.stretch[frame])
            seen['known'] += [stretch] * (candidate.verdict in ('seen', 'closed', 'no drift'))
            is_closed = any(edge.i == candidate.keyframe for edge in slam.map.loops)
            seen['closed'] += [stretch] * is_closed
    driven = sorted({int(k) for k in drive.stretch[drive.back] if k >= 0})
    return {
        'rmse_m': _path_error_m(followed, drive, focal),
        'tracked': float(np.mean([r.tracked for r in followed.results])),
        'stretches': len(driven),
        'closed_in': sum(k in seen['closed'] for k in driven),
        'known': sum(seen['known'].count(k) >= PROOF for k in driven),
        'loops': slam.back_end.loop_count,
        'verdicts': dict(sorted(verdicts.items())),
    }


def _path_error_m(followed: Followed, drive: Drive, focal: float) -> float:
    """Return the RMSE of the camera's path, once the scale of the focal length is taken off."""
    slam = followed.slam
    if followed.path is None or slam.mount is None:
        return float('nan')
    poses = tracked_poses(followed.results)
    path = corrected_trajectory(poses, followed.path).seen_from(slam.mount.T_base_left)
    truth = drive.truth[[drive.index[ns] for ns in path.stamp_ns.tolist()], :3, 3]
    return _aligned_error_m(path.poses[:, :3, 3] / focal, truth)


def _aligned_error_m(estimate: Array, truth: Array) -> float:
    """Return the RMSE of places (N, 3) once they are laid on the truth."""
    off = transform_points(rigid_alignment(estimate, truth), estimate) - truth
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def measure_session(drive: Drive, saved: MapFile) -> dict[str, Any]:
    """Return how the way back is found in a map that begins with the first frame of the drive."""
    found = list(_found(drive, saved, [drive.frames[k] for k in drive.back]))
    errors = np.array([error for *_, error in found])
    first = found[0][0] if found else -1
    return {
        'first_frame': first - drive.back[0] if found else -1,
        'found_share': float((errors <= FALSE_M).sum() / len(drive.back)),
        'wrong': int((errors > FALSE_M).sum()),
        'median_m': float(np.median(errors)) if found else float('nan'),
    }


def _found(drive: Drive, saved: MapFile, frames: list[StereoFrame]) -> Found:
    """Yield frames that are found in a map: after which frame, which one, and how far off."""
    slam = make_slam(drive.camera, resolve().stereo_slam)
    load_slam(slam, drive.camera, saved, 'map')
    for frame in frames:
        for result in slam.process(frame):
            if result.tracked and not result.outside:
                assert slam.mount is not None
                error_m = _error_m(slam.mount.T_base_left, result, drive.truth)
                yield frame.index, result.index, error_m


def _error_m(T_base_left: Array, result: FrameResult, truth: Array) -> float:
    pose = invert(T_base_left) @ result.T_map_odom @ result.T_odom_base @ T_base_left
    return float(np.linalg.norm((invert(truth[0]) @ truth[result.index] - pose)[:3, 3]))


def measure_kidnaps(drive: Drive, saved: MapFile, rows: range) -> dict[str, Any]:
    """Return how soon a camera is found that begins somewhere in a known map: not in the last
    third of the frames, where the way back leaves what was seen on the way there.
    """
    took_s, wrong, last = [], 0, rows[2 * len(rows) // 3]
    for number, start in enumerate(np.linspace(rows[0], last, KIDNAPS).astype(int)):
        end = min(rows[-1] + 1, start + int(PATIENCE_S * _rate_hz(drive)))
        frames = list(worse(drive.frames[start:end], 1, NOISE, number))
        found = _found(drive, saved, frames)
        index, _, error = next(found, (None, None, 0.0))
        took_s.append((index - start) / _rate_hz(drive) if index is not None else float('inf'))
        wrong += error > FALSE_M
    return {'took_s': np.round(took_s, 2).tolist(), 'wrong': wrong}


def _rate_hz(drive: Drive) -> float:
    return 1e9 / (drive.frames[1].stamp_ns - drive.frames[0].stamp_ns)


def measure_merge(drive: Drive, first: MapFile, second: MapFile) -> dict[str, Any]:
    """Return the error of a map that was made of two; none where they stay two."""
    a, b = first.parts[PART], second.parts[PART]
    stamps = np.concatenate([a['keyframe_stamp_ns'], b['keyframe_stamp_ns']]).tolist()
    later = {
        'keyframe_stamp_ns': b['keyframe_stamp_ns'] + gap_ns(a, b),
        'point_stable_id': b['point_stable_id'] + a['num_ever'].astype(np.int32),
        'num_ever': b['num_ever'] + a['num_ever'],
    }
    offset, own = (DisparityOffset(drive.camera).restored(one[OFFSET]) for one in (a, b))
    seen = as_seen_by(offset, own, b) | later
    merged = merge_slam(a, seen, Rig(drive.camera, mount_of(first)))
    if merged is None:
        return {'merged': False}
    estimate = invert(merged['keyframe_T_camera_world'].astype(float))[:, :3, 3]
    truth = drive.truth[[drive.index[ns] for ns in stamps], :3, 3]
    return {'merged': True, 'rmse_m': _aligned_error_m(estimate, truth)}


def measure_paths(drive: Drive, folder: Path) -> dict[str, Any]:
    """Return the errors of paths and their loops; keep the maps."""
    everything, there = range(len(drive.frames)), drive.there
    followed, maps = follow(drive, everything)
    values = {'path': measure_path(drive, followed, 1.0)}
    for name, left_out in (('focal_without', FLOOR), ('focal', NOTHING)):
        again, _ = follow(drive, everything, FOCAL_FACTOR, left_out)
        values[name] = measure_path(drive, again, FOCAL_FACTOR)
    part, known = drive.kept
    second, back = there[4 * len(there) // 10 :], drive.back
    made = {'part': maps[part], 'there': maps[known], 'whole': maps[everything[-1]]}
    made |= {'second': follow(drive, second)[1][there[-1]]}
    made |= {'back': follow(drive, back)[1][everything[-1]]}
    for name, saved in made.items():
        write_map_file(folder / f'{name}.map', saved)
    return values


def measure_maps(drive: Drive, folder: Path) -> dict[str, Any]:
    """Return how cameras and other maps are found in the maps that were kept."""
    part, there, whole, second, back = (
        read_map_file(folder / f'{name}.map')
        for name in ('part', 'there', 'whole', 'second', 'back')
    )
    return {
        'session': measure_session(drive, there),
        'kidnaps': measure_kidnaps(drive, whole, range(len(drive.frames))),
        'kidnaps_back': measure_kidnaps(drive, there, drive.back),
        'merge': measure_merge(drive, part, second),
        'merge_back': measure_merge(drive, there, back),
    }


def row(values: dict[str, Any]) -> str:
    """Return a row of the table."""
    path, focal, session = values['path'], values['focal'], values['session']
    same, back = (np.array(values[name]['took_s']) for name in ('kidnaps', 'kidnaps_back'))
    false = sum(
        count
        for name in ('path', 'focal')
        for verdict, count in values[name]['verdicts'].items()
        if verdict == 'closed: FALSE'
    )
    merges = (
        f'{1e3 * merge["rmse_m"]:.0f}' if merge['merged'] else '–'
        for merge in (values['merge'], values['merge_back'])
    )
    known = ', '.join(str(focal[name]) for name in ('stretches', 'known', 'closed_in'))
    errors = (1e3 * run['rmse_m'] for run in (path, values['focal_without'], focal))
    path_mm, without_mm, with_mm = (f'{error:.0f}' for error in errors)
    wrong = session['wrong'] + values['kidnaps']['wrong'] + values['kidnaps_back']['wrong']
    first = f'{session["first_frame"] / 5:.1f}' if session['first_frame'] >= 0 else '–'
    return (
        f'{values["drive"]} | {values["floor"]} | {known} | {false} | {path_mm} | {without_mm}, '
        f'{with_mm} | {first} | {100 * session["found_share"]:.0f} % | {(same <= 2).sum()} of '
        f'{len(same)} | {(back <= 2).sum()}, {np.isfinite(back).sum()} of {len(back)} | {wrong} | '
        + ' | '.join(merges)
    )


PARTS = {'paths': measure_paths, 'maps': measure_maps}


def main(
    folder: Path,
    seeds: Annotated[int, typer.Option(help='Drives of each kind.')] = 3,
    only: Annotated[list[str] | None, typer.Option(help='These kinds alone.')] = None,
) -> None:
    """Render the drives and measure what is not in the results yet."""
    cv2.setNumThreads(1)
    folder.mkdir(parents=True, exist_ok=True)
    print(COLUMNS)
    for seed in range(1, seeds + 1):
        for kind in only or KINDS:
            name, drive = f'{kind}_{seed}', None
            scene, way = make_building(kind, seed)
            values = {'drive': name, 'floor': scene['floor']['texture']}
            for part, measure in PARTS.items():
                kept = folder / name / f'{part}.json'
                if not kept.exists():
                    render_once(scene_from_mapping(scene, name), folder / name)
                    drive = drive or open_drive(folder / name, np.array(way))
                    kept.write_text(json.dumps(measure(drive, folder / name)))
                values |= json.loads(kept.read_text())
            print(row(values), flush=True)


if __name__ == '__main__':
    typer.run(main)
