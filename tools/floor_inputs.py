"""What floor segmentation gets of drives whose floor is known, and the truth: made once, and kept
on disk, so that a change of the mask is scored without SLAM and without rendering.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.apps.cli.terminal import Announce
from segfloor_ros.apps.evaluation.floor import draw_outline, read_outlines
from segfloor_ros.apps.simulation.motion import RigMotion, plan_drive
from segfloor_ros.apps.simulation.scene import Scene
from segfloor_ros.apps.simulation.scene_file import open_scene, scene_from_mapping
from segfloor_ros.apps.simulation.simulation import DISPARITY_SCALE, RecordingOptions, render_once
from segfloor_ros.apps.simulation.solids import CLASSES, floors
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, FrameResult, Mount, StereoFrame
from segfloor_ros.core.errors import InputError, MapError
from segfloor_ros.core.files.images import read_mask
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.geometry import Array, transform_points
from segfloor_ros.core.plugins.assembly import make_slam
from segfloor_ros.nodes.configuration import resolve
from tools.driving import after_sensors, drive, open_recording
from tools.figures import DRIVES, OUTLINES
from tools.floor_masks import mount_of
from tools.low_things import SCENES, Thing, make_scene

Mask = NDArray[np.uint8]

FORMAT = 1
"""Of the files of the cache; another number makes them anew."""

UNKNOWN, TRUE_FLOOR, OTHER, OBSTACLE = range(4)
"""Pixels of a truth. Walls and ceilings of rendered scenes are `OTHER`: no floor, but no obstacle
either, as they would hide how many pixels of low things are called floor."""

STANDING = tuple(CLASSES.index(name) for name in ('box', 'furniture', 'person', 'car', 'glass'))
NEAR_M = 2.0
RENDERED_FRAMES = 10
"""So many frames of a rendered drive are scored."""

SURROUND_M = 0.015
"""A pixel shows a low thing within this distance of its footprint."""

SLAM_SETTINGS = {
    'backyard': {'camera_height_m': 1.1, 'camera_pitch_rad': 0.32, 'camera_roll_rad': -0.03}
}
"""By recording. The backyard does not show its mount; these are medians of planes through the
outlined floor, which is 1.05 to 1.5 m below a camera in a hand that is pitched by 11 to 22 degrees.
"""

LEAD_IN = {'backyard': 10, 'rover': 10}
"""The rover's black background is at first taken for the border of the image (`BlankBorder`). With
10 frames the masks are those of the whole drive, with 2 they differ by 0.4 % of the pixels. Of the
backyard the first frames show that the camera is not where its mount is (`Fixture.usual`).
"""


@dataclasses.dataclass(frozen=True)
class BenchDrive:
    """A drive of the bench. group: in the table. source: a recording, or the scene to render.
    things: that lie in the scene, where their heights are known. slam: settings of stereo SLAM.
    lead_in: so many frames before each scored one are segmented, too, where masks depend on them.
    """

    name: str
    group: str
    source: Path | Scene
    things: tuple[Thing, ...] = ()
    slam: dict[str, float] = dataclasses.field(default_factory=dict)
    lead_in: int = 0

    @property
    def outlines(self) -> Path:
        """The file of its outlines, if it has any."""
        return OUTLINES / f'{self.name}_floor_outlines.yaml'

    @property
    def key(self) -> str:
        """What the files of the cache depend on, the code of SLAM aside."""
        outlines = self.outlines.read_text() if self.outlines.is_file() else ''
        parts = FORMAT, self.lead_in, self.source, self.things, self.slam, outlines
        return hashlib.sha256(repr(parts).encode()).hexdigest()


OUTLINED, DRIVEN, LOW = 'outlined by hand', 'drives of README', 'low things'


def bench_drives(data: Path) -> list[BenchDrive]:
    """Return all drives of the bench. data: folder of the recordings; those it lacks are left out.
    Raises InputError.
    """
    found = []
    for file in sorted(OUTLINES.glob('*_floor_outlines.yaml')):
        name = file.name.removesuffix('_floor_outlines.yaml')
        slam, lead_in = SLAM_SETTINGS.get(name, {}), LEAD_IN.get(name, 0)
        found.append(BenchDrive(name, OUTLINED, data / name, (), slam, lead_in))
    for name, one in DRIVES.items():
        if one.scene:
            found.append(BenchDrive(name, DRIVEN, open_scene(one.scene)))
        elif (data / name / 'floor').is_dir():
            found.append(BenchDrive(name, DRIVEN, data / name))
    for name in SCENES:
        values, things = make_scene(name)
        scene = scene_from_mapping(values, name)
        mount = mount_of(scene)
        slam = {
            'camera_height_m': mount.height_m,
            'camera_pitch_rad': mount.pitch_rad,
            'camera_roll_rad': mount.roll_rad,
        }
        found.append(BenchDrive(name, LOW, scene, tuple(things), slam))
    return [one for one in found if isinstance(one.source, Scene) or one.source.is_dir()]


@dataclasses.dataclass(frozen=True)
class Truth:
    """What is true of a left image, (H, W) uint8. label: `UNKNOWN` and so on. near: 1 within 2 m,
    or, of an outlined image, in its lower half. height_cm: of the low thing that a pixel shows,
    0 where there is none or its height is not known.
    """

    label: Mask
    near: Mask
    height_cm: Mask


@dataclasses.dataclass(frozen=True)
class FloorFrame:
    """What floor segmentation gets of a frame: `left`, `right`, `moving` and T_map_base as in
    `FloorSegmentation.process`. truth: None where the frame only leads in.
    """

    index: int
    left: Mask
    right: NDArray[Any]
    T_map_base: Array | None
    moving: Mask | None
    truth: Truth | None = None


@dataclasses.dataclass(frozen=True)
class FloorDrive:
    """The frames of a drive, in their order, and what they were taken with."""

    camera: StereoCamera
    mount: Mount
    frames: list[FloorFrame]

    def masks(self, stage: FloorSegmentation) -> Iterator[tuple[FloorFrame, Mask]]:
        """Yield each frame with its mask."""
        for one in self.frames:
            found = stage.process(one.left, one.right, self.mount, one.T_map_base, one.moving)
            yield one, found.mask

    def save(self, file: Path, key: str) -> None:
        """Write the drive to a file of the cache."""
        scored = [one for one in self.frames if one.truth is not None]
        truths = [one.truth for one in scored if one.truth is not None]
        moved = [one for one in self.frames if one.moving is not None]
        lost = np.full((4, 4), np.nan)
        facts = {
            'key': key,
            'camera': dataclasses.asdict(self.camera),
            'mount': dataclasses.asdict(self.mount),
        }
        arrays: dict[str, Any] = {
            'facts': np.frombuffer(json.dumps(facts).encode(), np.uint8),
            'index': [one.index for one in self.frames],
            'left': [one.left for one in self.frames],
            'right': [one.right for one in self.frames],
            'T_map_base': [lost if f.T_map_base is None else f.T_map_base for f in self.frames],
            'moved': [one.index for one in moved],
            'moving': [np.packbits(one.moving > 0) for one in moved if one.moving is not None],
            'scored': [one.index for one in scored],
            **{name: [getattr(truth, name) for truth in truths] for name in _TRUTH},
        }
        file.parent.mkdir(parents=True, exist_ok=True)
        arrays = {name: np.array(values) for name, values in arrays.items()}
        np.savez(file, **arrays)

    @classmethod
    def read(cls, file: Path, key: str) -> FloorDrive | None:
        """Return the drive in a file of the cache; None where it is of something else."""
        if not file.is_file():
            return None
        with np.load(file) as arrays:
            facts = json.loads(arrays['facts'].tobytes())
            if facts['key'] != key:
                return None
            scored = arrays['scored'].tolist()
            columns = (arrays[name] for name in _TRUTH)
            truths = dict(zip(scored, map(Truth, *columns), strict=True))
            left, moving = arrays['left'], {}
            for index, bits in zip(arrays['moved'].tolist(), arrays['moving'], strict=True):
                mask = np.unpackbits(bits, count=left[0].size).reshape(left[0].shape)
                moving[index] = mask * np.uint8(255)
            rows = zip(
                arrays['index'].tolist(), left, arrays['right'], arrays['T_map_base'], strict=True
            )
            frames = [
                FloorFrame(i, a, b, T if np.isfinite(T).all() else None, moving.get(i))
                for i, a, b, T in rows
            ]
        frames = [dataclasses.replace(one, truth=truths.get(one.index)) for one in frames]
        return cls(StereoCamera(**facts['camera']), Mount(**facts['mount']), frames)


_TRUTH = tuple(field.name for field in dataclasses.fields(Truth))


def floor_drive(bench: BenchDrive, cache: Path, fresh: bool, announce: Announce) -> FloorDrive:
    """Return a drive from the cache, made first where it is not there. Raises InputError, MapError
    or RenderingError.
    """
    file = cache / 'inputs' / f'{bench.name}.npz'
    found = None if fresh else FloorDrive.read(file, bench.key)
    if found is None:
        found = make_drive(bench, cache, announce)
        found.save(file, bench.key)
    return found


def make_drive(bench: BenchDrive, cache: Path, announce: Announce) -> FloorDrive:
    """Render a scene where there is none, draw its truth, and run SLAM over it."""
    recording = bench.source
    if isinstance(recording, Scene):
        recording = _rendered(bench, recording, cache, announce)
    camera = {'input': str(recording)}
    configuration = resolve(None, (), stereo_camera=camera, stereo_slam=bench.slam)
    source = open_recording(recording, configuration)
    truths = dict(_truths(bench, recording, source.camera))
    wanted = {i for scored in truths for i in range(scored - bench.lead_in, scored + 1)}
    mount, frames = slam_inputs(recording, configuration, wanted, announce)
    known = [dataclasses.replace(one, truth=truths.get(one.index)) for one in frames]
    return FloorDrive(source.camera, mount, known)


def slam_inputs(
    recording: Path, configuration: Configuration, wanted: set[int], announce: Announce
) -> tuple[Mount, list[FloorFrame]]:
    """Return the mount and some frames of a recording as SLAM hands them to floor segmentation.
    Raises MapError where no mount was found.
    """
    source = open_recording(recording, configuration)
    kept: dict[int, StereoFrame] = {}
    found: dict[int, FloorFrame] = {}
    report = announce(f'tracking {recording.name}', source.frame_count or 0)
    with contextlib.closing(make_slam(source.camera, configuration.stereo_slam)) as slam:

        def note(results: list[FrameResult]) -> None:
            for result in results:
                if result.index in kept:  # once more where the mount has changed
                    frame = slam.rig_check.corrected(kept[result.index])
                    found[result.index] = _frame(frame, result)

        for step in drive(slam, after_sensors(slam, source.sensors, source.frames()), report):
            if step.frame.index in wanted:
                kept[step.frame.index] = step.frame
            note(list(step.results))
        note(list(slam.finish()) if slam.mount is not None else [])
        if slam.mount is None:
            raise MapError(f'{recording}: SLAM found no mount')
        return slam.mount, [found[index] for index in sorted(found)]


def _frame(frame: StereoFrame, result: FrameResult) -> FloorFrame:
    key = result.keyframe
    if key is not None:
        return FloorFrame(frame.index, key.left, key.right, key.T_map_base, key.moving)
    T_map_base = result.T_map_odom @ result.T_odom_base if result.tracked else None
    return FloorFrame(frame.index, frame.left, frame.right, T_map_base, None)


def _rendered(bench: BenchDrive, scene: Scene, cache: Path, announce: Announce) -> Path:
    """Return the folder of a rendered drive with the truth of some of its frames."""
    count = len(plan_drive(scene.path, scene.camera.rate_hz).times_s)
    options = RecordingOptions(-(-count // RENDERED_FRAMES), disparity=True, labels=True)
    recording = cache / 'drives' / bench.name
    recording.parent.mkdir(parents=True, exist_ok=True)
    render_once(scene, recording, options, lambda total: announce(f'rendering {bench.name}', total))
    return recording


def _truths(
    bench: BenchDrive, recording: Path, camera: StereoCamera
) -> Iterator[tuple[int, Truth]]:
    """Yield the truth of frames by their index."""
    if bench.outlines.is_file():
        for index, outline in read_outlines(bench.outlines).items():
            yield index, outlined_truth(outline, (camera.height, camera.width))
        return
    files = sorted((recording / 'floor').glob('*.png'))
    if not files:
        raise InputError(f'{recording}: neither outlines nor floor/')
    for file in files:
        floor, index = read_mask(file), int(file.stem)
        if not isinstance(bench.source, Scene):
            yield index, Truth(_labelled(floor, None), _lower_half(floor.shape), 0 * floor)
            continue
        scaled, labels = (
            np.asarray(cv2.imread(str(recording / what / file.name), cv2.IMREAD_UNCHANGED))
            for what in ('disparity', 'labels')
        )
        depth_m = camera.disparity_times_depth / np.maximum(scaled / DISPARITY_SCALE, 1e-3)
        height_cm = _heights_cm(bench, bench.source, camera, depth_m, index)
        label = _labelled(floor, labels)
        height_cm[label != OBSTACLE] = 0
        yield index, Truth(label, (depth_m < NEAR_M).astype(np.uint8), height_cm)


def outlined_truth(outline: dict[str, Any], shape: tuple[int, int]) -> Truth:
    """Return the truth of an image (H, W) with polygons drawn by hand."""
    drawn = draw_outline(outline, shape)
    label = np.full(shape, OBSTACLE, np.uint8)
    label[drawn == FLOOR], label[drawn == NO_EVIDENCE] = TRUE_FLOOR, UNKNOWN
    return Truth(label, _lower_half(shape), np.zeros(shape, np.uint8))


def _lower_half(shape: tuple[int, ...]) -> Mask:
    return np.repeat(np.arange(shape[0]) >= shape[0] / 2, shape[1]).reshape(shape).astype(np.uint8)


def _labelled(floor: Mask, classes: Mask | None) -> Mask:
    """Return the labels of a true mask (H, W); classes: of its pixels, as in `CLASSES`, where they
    are known. A pixel to either side of the floor's border does not count.
    """
    is_obstacle = np.ones(floor.shape, bool) if classes is None else np.isin(classes, STANDING)
    label = np.where(is_obstacle, np.uint8(OBSTACLE), np.uint8(OTHER))
    label[floor > 0] = TRUE_FLOOR
    around = np.ones((3, 3), np.uint8)
    label[cv2.dilate(floor, around) != cv2.erode(floor, around)] = UNKNOWN
    return label


def _heights_cm(
    bench: BenchDrive, scene: Scene, camera: StereoCamera, depth_m: Array, index: int
) -> Mask:
    """Return the height of the low thing that each pixel (H, W) shows, 0 for none."""
    height_cm = np.zeros(depth_m.shape, np.uint8)
    if not bench.things:
        return height_cm
    planned = plan_drive(scene.path, scene.camera.rate_hz)
    motion = RigMotion(scene, planned, floors(scene))
    T_world_left = motion.T_world_left(float(planned.times_s[index]))
    v, u = np.indices(depth_m.shape, np.float64)
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    points = camera.back_project(uv, np.minimum(depth_m, 1e3).ravel())
    ground = transform_points(T_world_left, points)[:, :2]
    away_m = np.stack([thing.distance_m(ground) for thing in bench.things])
    nearest = away_m.argmin(axis=0)
    heights = np.array([thing.height_cm for thing in bench.things], np.uint8)[nearest]
    return np.where(away_m.min(axis=0) < SURROUND_M, heights, np.uint8(0)).reshape(depth_m.shape)
