"""Recordings as folders that other tools read: a KITTI odometry sequence, or one of the TUM RGB-D
benchmark; what wheels and IMU measured goes beside the images, as our own reader takes it.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from enum import Enum
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from segfloor_ros.apps.recordings.bag import odometry_path
from segfloor_ros.apps.recordings.bag_file import is_bag
from segfloor_ros.apps.recordings.calibration_files import write_ros_calibration
from segfloor_ros.apps.recordings.files import IMU_COLUMNS, IMU_FILE, WHEEL_FILE
from segfloor_ros.apps.recordings.source import StereoSource
from segfloor_ros.apps.trajectory import Trajectory, read_trajectory, write_tum
from segfloor_ros.core.camera.calibration import EyeCalibration
from segfloor_ros.core.camera.model import is_disparity
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.contracts import ImuSample, WheelPose
from segfloor_ros.core.errors import InputError, os_errors
from segfloor_ros.core.files.images import png_bytes
from segfloor_ros.core.files.paths import user_path
from segfloor_ros.core.files.writing import scratch_folder
from segfloor_ros.core.geometry import Array, invert, make_transform

logger = logging.getLogger(__name__)

UNITS_PER_M = {'kitti': 1000.0, 'tum': 5000.0}
"""Of depth images with 16 bits: millimetres, and the units of the TUM RGB-D benchmark."""


class Layout(str, Enum):
    """How a recording is written: as a bag, a KITTI odometry folder or a TUM RGB-D folder."""

    bag = 'bag'
    kitti = 'kitti'
    tum = 'tum'


def layout_for(name: Path, out: Path, source: StereoSource) -> Layout:
    """Return the layout that fits: a bag becomes a folder of images, of TUM where depth images
    stand in place of the right ones; everything else, and what is to be an mcap file, a bag.
    """
    if out.suffix == '.mcap' or not is_bag(name):
        return Layout.bag
    return Layout.tum if source.takes_depth else Layout.kitti


ROUNDED_NS = 1000
"""Times of seconds in a file are off by so much at most: a float has 16 digits."""


def write_folder(
    source: StereoSource,
    out: Path,
    layout: Layout,
    on_progress: Callable[[int], None] = lambda done: None,
    depth: StereoSource | None = None,
    truth: Trajectory | None = None,
) -> int:
    """Write every pair of a source to a new folder and return how many there were.

    KITTI: `image_0/` and `image_1/` rectified, grey, with `calib.txt` and `times.txt`; `depth/` in
    mm in place of the right images, or beside them where they are rectified already. TUM: `rgb/`,
    in colour where there is one, and `depth/` as recorded (16 bits, 5000 to the metre, nothing
    beyond 13.1 m), `rgb.txt`, `depth.txt` and `camera.yaml`. Both: what wheels and IMU measured, in
    `wheel_odometry.txt` and `imu.csv`, and the true poses at the images, where given, in
    `poses.txt` and `groundtruth.txt`. depth: the same recording opened with
    its depth images. on_progress gets the number of pairs done. Raises InputError where `out`
    exists, cannot be written, or has no depth images for TUM.
    """
    if os.path.lexists(out):
        raise InputError(f'{out}: exists already; choose another name')
    if layout is Layout.tum and not source.takes_depth:
        if depth is None:
            raise InputError(
                f'{source.name}: has no depth images, which a TUM RGB-D folder is made of; write '
                'it with --layout kitti'
            )
        source, depth = depth, None
    with os_errors(f'{out}: cannot be written'):
        out.parent.mkdir(parents=True, exist_ok=True)
        with scratch_folder(out.parent) as scratch:
            made = scratch / 'made'
            made.mkdir()
            write = _write_tum if layout is Layout.tum else _write_kitti
            stamps_ns = write(made, source, depth, on_progress)
            if not stamps_ns:
                raise InputError(
                    f'{source.name}: no pair of images can be read; nothing is written'
                )
            _write_measurements(made, source)
            if truth is not None:
                _write_truth(made, layout, at_times(truth, stamps_ns, source.name))
            made.rename(out)
    return len(stamps_ns)


def _write_kitti(
    folder: Path,
    source: StereoSource,
    depth: StereoSource | None,
    on_progress: Callable[[int], None],
) -> list[int]:
    """Return the stamps of the pairs written."""
    camera = source.camera
    rows = []
    for number, shift in enumerate((0.0, -camera.disparity_times_depth)):
        P = np.hstack([camera.K, np.zeros((3, 1))])
        P[0, 3] = shift
        rows.append(f'P{number}: ' + ' '.join(repr(float(value)) for value in P.ravel()))
    (folder / 'calib.txt').write_text('\n'.join(rows) + '\n')
    if depth is not None and not source.calibration.is_rectified:
        logger.warning(
            '%s: its depth images do not lie on rectified images; they are left out', source.name
        )
        depth = None
    depths = _by_stamp(depth)
    stamps_ns = []
    for number, frame in enumerate(source.frames()):
        name = f'{number:06d}.png'
        _write_png(folder / 'image_0' / name, frame.left)
        if is_disparity(frame.right):
            image = depth_image(frame.right, camera.disparity_times_depth, UNITS_PER_M['kitti'])
            _write_png(folder / 'depth' / name, image)
        else:
            _write_png(folder / 'image_1' / name, frame.right)
        other = depths(frame.stamp_ns)
        if other is not None and depth is not None:
            scale = depth.camera.disparity_times_depth
            _write_png(folder / 'depth' / name, depth_image(other, scale, UNITS_PER_M['kitti']))
        stamps_ns.append(frame.stamp_ns)
        on_progress(len(stamps_ns))
    (folder / 'times.txt').write_text(''.join(f'{seconds(ns)}\n' for ns in stamps_ns))
    return stamps_ns


def _write_tum(
    folder: Path,
    source: StereoSource,
    depth: StereoSource | None,
    on_progress: Callable[[int], None],
) -> list[int]:
    """Return the stamps of the pairs written. depth: not needed."""
    write_ros_calibration(folder / 'camera.yaml', source.calibration.left, 'camera')
    source.takes_colour = True
    scale, stamps_ns = source.camera.disparity_times_depth, []
    lists: dict[str, list[str]] = {'rgb': [], 'depth': []}
    for pair in source.raw_pairs():
        name = f'{seconds(pair.stamp_ns)}.png'
        grey_or_colour = pair.left if pair.colour is None else pair.colour
        _write_png(folder / 'rgb' / name, grey_or_colour)
        _write_png(folder / 'depth' / name, depth_image(pair.right, scale, UNITS_PER_M['tum']))
        for kind, rows in lists.items():
            rows.append(f'{seconds(pair.stamp_ns)} {kind}/{name}\n')
        stamps_ns.append(pair.stamp_ns)
        on_progress(len(stamps_ns))
    for kind, rows in lists.items():
        (folder / f'{kind}.txt').write_text(''.join(['# timestamp filename\n', *rows]))
    return stamps_ns


def _by_stamp(source: StereoSource | None) -> Callable[[int], NDArray[np.float32] | None]:
    """Return a function that gives the disparities of a source at a stamp, each later than the
    last, None where it has no image then.
    """
    frames: Iterator[tuple[int, NDArray[np.float32]]] = (
        iter(()) if source is None else ((f.stamp_ns, f.right) for f in source.frames())
    )
    waiting = next(frames, None)

    def take(stamp_ns: int) -> NDArray[np.float32] | None:
        nonlocal waiting
        while waiting is not None and waiting[0] < stamp_ns:
            waiting = next(frames, None)
        return waiting[1] if waiting is not None and waiting[0] == stamp_ns else None

    return take


def depth_image(
    disparity: NDArray[np.float32], disparity_times_depth: float, units_per_m: float
) -> NDArray[np.uint16]:
    """Return disparities (H, W) as depths (H, W) in whole units; 0 where there is none, and where
    16 bits are too few.
    """
    with np.errstate(divide='ignore', invalid='ignore'):
        units = np.rint(disparity_times_depth * units_per_m / disparity.astype(np.float64))
    fits = np.isfinite(units) & (units > 0) & (units <= np.iinfo(np.uint16).max)
    return np.where(fits, units, 0).astype(np.uint16)


def seconds(stamp_ns: int) -> str:
    """Return a stamp in seconds, exact to the nanosecond."""
    whole, rest = divmod(stamp_ns, 1_000_000_000)
    return f'{whole}.{rest:09d}'


def _write_png(path: Path, image: NDArray[np.generic]) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(png_bytes(image))


def _write_measurements(folder: Path, source: StereoSource) -> None:
    """Write what wheels and IMU measured, the latter in the rectified left optical frame."""
    measured = [one for sensor in source.sensors if sensor.used for one in sensor.read()]
    wheels = [m for m in measured if isinstance(m, WheelPose)]
    wheels = [m for m in wheels if np.isfinite(m.T_wheels_base).all()]
    if wheels:
        poses = np.array([m.T_wheels_base for m in wheels])
        stamps_ns = np.array([m.stamp_ns for m in wheels], np.int64)
        write_tum(folder / WHEEL_FILE, Trajectory(stamps_ns, poses))
    samples = [m for m in measured if isinstance(m, ImuSample)]
    if not samples:
        return
    rows = [f'# {IMU_COLUMNS}']
    for one in samples:
        values = (*one.gyro_rad_s.tolist(), *one.accel_m_s2.tolist())
        rows.append(f'{one.stamp_ns},' + ','.join(repr(value) for value in values))
    (folder / IMU_FILE).write_text('\n'.join(rows) + '\n')
    place_m = samples[0].place_m
    if place_m.any():
        T_left_imu = make_transform(np.eye(3), place_m)
        matrix = {'T_BS': {'rows': 4, 'cols': 4, 'data': T_left_imu.ravel().tolist()}}
        (folder / IMU_FILE).with_suffix('.yaml').write_text(yaml.safe_dump(matrix))


def read_truth(name: str, settings: StereoCameraSettings, left: EyeCalibration) -> Trajectory:
    """Return the true poses of a recording's left camera. name: a file (TUM or KITTI), or of a bag
    the topic of an Odometry, whose poses are brought to the camera where the fixed transforms of
    the bag say how it is mounted. left: of the raw images. Raises InputError.
    """
    recording = user_path(settings.input)
    if user_path(name).is_file() or not is_bag(recording):
        times_s, poses = read_trajectory(user_path(name))
        return Trajectory(np.rint(times_s * 1e9).astype(np.int64), poses)
    stamps_ns, poses, T_base_raw = odometry_path(recording, name, settings)
    T_raw_left = make_transform(left.R.T, np.zeros(3))
    return Trajectory(stamps_ns, poses @ T_base_raw @ T_raw_left)


def at_times(truth: Trajectory, stamps_ns: list[int], name: str) -> Trajectory:
    """Return the poses at stamps: positions on straight lines between the nearest, turns at even
    speed. Raises InputError where a stamp lies before the first pose or after the last.
    """
    at, known = np.array(stamps_ns, np.int64), truth.stamp_ns
    if len(known) < 2 or at[0] < known[0] - ROUNDED_NS or at[-1] > known[-1] + ROUNDED_NS:
        span = f'{seconds(int(known[0]))} to {seconds(int(known[-1]))} s' if len(known) else 'none'
        raise InputError(
            f'{name}: the true poses ({span}) do not cover the images, {seconds(int(at[0]))} to '
            f'{seconds(int(at[-1]))} s; choose a part with --start and --frames'
        )
    from_first_s, at_s = 1e-9 * (known - known[0]), 1e-9 * (at - known[0])
    at_s = at_s.clip(0.0, from_first_s[-1])
    poses = np.tile(np.eye(4), (len(at), 1, 1))
    for axis in range(3):
        poses[:, axis, 3] = np.interp(at_s, from_first_s, truth.poses[:, axis, 3])
    turns = Slerp(from_first_s, Rotation.from_matrix(truth.poses[:, :3, :3]))
    poses[:, :3, :3] = turns(at_s).as_matrix()
    exact = np.searchsorted(known, at).clip(max=len(known) - 1)
    there = known[exact] == at
    poses[there] = truth.poses[exact[there]]
    return Trajectory(at, poses)


def _write_truth(folder: Path, layout: Layout, truth: Trajectory) -> None:
    """Write poses of the left camera: for KITTI in the first one's frame, for TUM as they are."""
    if layout is Layout.tum:
        write_tum(folder / 'groundtruth.txt', truth)
        return
    poses: Array = invert(truth.poses[0]) @ truth.poses
    rows = (' '.join(f'{value:.12g}' for value in pose[:3].ravel() + 0.0) for pose in poses)
    (folder / 'poses.txt').write_text('\n'.join(rows) + '\n')
