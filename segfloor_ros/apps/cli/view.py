"""What a drive looks like, in a window of rerun: while it is mapped, and afterwards.

Showing changes no result, and what would slow a drive down is left out.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.apps.cli.printing import SUFFIX, console
from segfloor_ros.apps.cli.terminal import progress_bar
from segfloor_ros.apps.label_files import class_colours, draw_labels
from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.ply import read_ply
from segfloor_ros.apps.recordings import StereoSource, open_source
from segfloor_ros.apps.results_folder import (
    MAP,
    MOUNT_FIGURES,
    POINT_LABELS,
    SEMANTIC,
    RunResult,
    read_summary,
    summary_rows,
)
from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.contracts import (
    POINT_FLOOR,
    POINT_OBSTACLE,
    FloorObservation,
    FrameResult,
    Keyframe,
    KeyframePath,
    LabelledPoints,
    Mount,
    MovingPoints,
    StereoFrame,
)
from segfloor_ros.core.errors import InputError, SettingsError
from segfloor_ros.core.files.images import jpeg_bytes, read_mask, read_picture
from segfloor_ros.core.files.whole import read_text
from segfloor_ros.core.files.writing import VIEW, check_output
from segfloor_ros.core.floor.pictures import MASK_COLOURS, mask_overlay
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.grid.occupancy import UNKNOWN_PIXEL, OccupancyGrid
from segfloor_ros.core.pipeline import Pipeline
from segfloor_ros.core.plugins.semantics.outputs import UNLABELLED
from segfloor_ros.nodes.configuration import resolve

LOCALHOST, WEB_PORT = '127.0.0.1', 9090
"""Where the page for the browser is served."""

SHARE = 0.015
"""Of the time of a drive that showing its frames may take, and as much its keyframes."""

WIDTH_PX = 480
"""Of the images that are shown."""

PATH_M, POINT_M, CAMERA_M = 0.02, 0.015, 0.3
"""Radii of path and points, and how far ahead of the camera its image is drawn."""

HIGH_M = 2.0
"""Obstacles are coloured by their height up to this."""

PATH_RGB, KEYFRAME_RGB, LOOP_RGB = (31, 119, 180), (255, 127, 14), (214, 39, 40)
FLOOR_RGB, MOVING_RGB = (MASK_COLOURS[name][::-1] for name in ('floor', 'moving'))

BASE = 'world/base'
CAMERA = f'{BASE}/camera'
KEYFRAME, RIGHT, CLASSES = 'keyframe', 'right', 'classes'
TIMES, TEXT, ABOUT = 'ms', 'log', 'about'


@contextmanager
def open_view(
    target: str | None, inputs: Iterable[Path | str | None] = ()
) -> Iterator[View | None]:
    """Open a window, or a file where `target` names one, which is none of the inputs; None: show
    nothing. A window stays open after the block. Raises SettingsError where rerun is not installed.
    """
    if target is None:
        yield None
        return
    try:
        import rerun
    except ImportError:
        raise SettingsError(
            "to view needs rerun, which is not installed: pip install 'segfloor_ros[view]'"
        ) from None
    stream = rerun.RecordingStream('segfloor')
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    if target:
        if not target.endswith(SUFFIX):
            raise SettingsError(f'{target}: the file of a view ends in {SUFFIX}')
        check_output(Path(target), VIEW, inputs, '--view')
        stream.save(target)
        with _flushed(stream):
            yield View(Canvas(stream, rerun))
        console.print(f'view: {target}, for the command rerun', highlight=False, soft_wrap=True)
        return
    with _viewer() as (server, address, is_page):
        stream.connect_grpc(address)
        with _flushed(stream):
            yield View(Canvas(stream, rerun))
        if is_page:
            console.print('the view is there until Ctrl-C')
            with suppress(KeyboardInterrupt):
                server.wait()


@contextmanager
def _flushed(stream: Any) -> Iterator[None]:
    try:
        yield
    finally:
        stream.flush()


@contextmanager
def _viewer() -> Iterator[tuple[subprocess.Popen[bytes], str, bool]]:
    """Start the viewer of rerun: a window, or without a display a page for the browser, which ends
    with the block. It listens on this machine alone; what rerun starts by itself listens on all
    networks. Yields its process, where it takes a stream, and whether it is a page.
    """
    is_page = not (os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY'))
    words = [sys.executable, '-m', 'rerun_cli', '--bind', LOCALHOST]
    port = _free_port()
    words += ['--port', str(port)]
    address = f'rerun+http://{LOCALHOST}:{port}/proxy'
    if is_page:
        web_port = _free_port(WEB_PORT)
        words += ['--serve-web', '--web-viewer-port', str(web_port)]
        page = f'http://{LOCALHOST}:{web_port}?url={quote(address, safe="")}'
        console.print(f'view: {page}', highlight=False, soft_wrap=True)
    # A session of its own: Ctrl-C ends the command, which ends the page; a window stays.
    nowhere = subprocess.DEVNULL
    server = subprocess.Popen(
        words, stdin=nowhere, stdout=nowhere, stderr=nowhere, start_new_session=True
    )
    try:
        yield server, address, is_page
    finally:
        if is_page:
            with suppress(ProcessLookupError):
                os.killpg(server.pid, signal.SIGTERM)  # rerun_cli starts the viewer as its child
            server.wait()


def _free_port(wanted: int = 0) -> int:
    """Return a port of this machine that is free: the wanted one, or any where that is in use."""
    with socket.socket() as probe:
        try:
            probe.bind((LOCALHOST, wanted))
        except OSError:
            probe.bind((LOCALHOST, 0))
        return int(probe.getsockname()[1])


class Canvas:
    """A stream of rerun, below an entity `root`, by the time since its first stamp."""

    def __init__(self, stream: Any, rerun: ModuleType, root: str = '') -> None:
        self.rerun = rerun
        self._stream, self._root = stream, root
        self._start_ns: int | None = None
        self._tabs: list[str] = []
        self.log(None, 'world', rerun.ViewCoordinates.RIGHT_HAND_Z_UP)
        if not root:
            self._lay_out()

    def below(self, root: str) -> Canvas:
        """Return a canvas behind a tab of its own."""
        self._tabs.append(root)
        self._lay_out()
        return Canvas(self._stream, self.rerun, root)

    def log(self, stamp_ns: int | None, entity: str, what: Any) -> None:
        """Log something at a stamp, or for all of the drive."""
        if stamp_ns is not None:
            self._start_ns = stamp_ns if self._start_ns is None else self._start_ns
            self._stream.set_time('time', duration=1e-9 * (stamp_ns - self._start_ns))
        self._stream.log(f'{self._root}/{entity}', what, static=stamp_ns is None)

    def picture(self, stamp_ns: int, entity: str, picture: NDArray[np.uint8]) -> None:
        """Log a picture (H, W) or (H, W, 3) BGR."""
        height = round(WIDTH_PX / picture.shape[1] * picture.shape[0])
        small = cv2.resize(picture, (WIDTH_PX, height), interpolation=cv2.INTER_LINEAR)
        image = self.rerun.EncodedImage(contents=jpeg_bytes(small), media_type='image/jpeg')
        self.log(stamp_ns, entity, image)

    def text(self, stamp_ns: int, words: str, level: str = 'INFO') -> None:
        """Log a line of words."""
        self.log(stamp_ns, TEXT, self.rerun.TextLog(words, level=level))

    def _lay_out(self) -> None:
        """Lay the panes out: those of every drive behind a tab of its name."""
        import rerun.blueprint as rrb

        tabs = [_panes(rrb, root) for root in self._tabs or ['']]
        everything = rrb.Tabs(*tabs) if self._tabs else tabs[0]
        time_panel = rrb.TimePanel(timeline='time', state='collapsed')
        sides = rrb.BlueprintPanel(state='collapsed'), rrb.SelectionPanel(state='collapsed')
        self._stream.send_blueprint(rrb.Blueprint(everything, *sides, time_panel))


class View:
    """Shows a drive on a canvas of rerun."""

    def __init__(self, canvas: Canvas) -> None:
        self.canvas, self._rr = canvas, canvas.rerun
        self._next_s: dict[str, float] = {}
        self._state = ''
        self._loops_ns: list[int] = []

    def on_frame(
        self, frame: StereoFrame, results: Sequence[FrameResult], pipeline: Pipeline
    ) -> None:
        """Show a frame of a run and the results that came with it."""
        self.paced(CAMERA, lambda: self.image(frame.stamp_ns, frame.left))
        for result in results:
            self.state(result.stamp_ns, result.state)
        if results:
            self.paced(BASE, partial(_show_newest, self, results[-1]))
        self.loops(frame.stamp_ns, pipeline.slam.back_end.loop_count)

    def on_keyframe(self, keyframe: Keyframe, floor: FloorObservation, pipeline: Pipeline) -> None:
        """Show a keyframe of a run that has come to the map."""
        self.paced(KEYFRAME, lambda: self._keyframe(keyframe, floor, pipeline))

    def _keyframe(self, keyframe: Keyframe, floor: FloorObservation, pipeline: Pipeline) -> None:
        stamp_ns, stages = keyframe.stamp_ns, pipeline.keyframe_stages
        assert pipeline.mount is not None
        camera = pipeline.slam.rig.camera
        self.camera(camera.K, (camera.width, camera.height), pipeline.mount.T_base_left)
        self.overlay(stamp_ns, mask_overlay(keyframe.left, floor.mask, keyframe.moving))
        self.path(stamp_ns, keyframe.path)
        self.cloud(stamp_ns, stages.labelled)
        self.grid(stamp_ns, stages.grid())
        for stage, durations_s in pipeline.times.durations_s.items():
            self.duration(stamp_ns, stage, durations_s[-1])

    def on_result(self, result: RunResult) -> None:
        """Show what came of a drive, all of it."""
        stamp_ns, path = int(result.trajectory.stamp_ns[-1]), result.keyframes
        self.path(stamp_ns, KeyframePath(path.stamp_ns, path.poses))
        self.cloud(stamp_ns, result.labelled)
        self.grid(stamp_ns, result.grid)
        labels = result.labels
        if labels is not None:
            if labels.points is not None:
                names = [*labels.classes, *[''] * (UNLABELLED + 1 - len(labels.classes))]
                self.classes(stamp_ns, result.labelled, [names[i] for i in labels.points])
            if result.grid is not None:
                self.canvas.picture(stamp_ns, CLASSES, draw_labels(result.grid, labels))
        self.about('Result', summary_rows(result.summary))

    def paced(self, what: str, show: Callable[[], None]) -> None:
        """Show something, unless the last of its kind took too long for that."""
        start_s = time.perf_counter()
        if start_s >= self._next_s.get(what, 0.0):
            show()
            end_s = time.perf_counter()
            self._next_s[what] = end_s + (end_s - start_s) / SHARE

    def image(self, stamp_ns: int, left: NDArray[np.uint8]) -> None:
        """Show the rectified left image (H, W) of a frame."""
        self.canvas.picture(stamp_ns, CAMERA, left)

    def pair(self, frame: StereoFrame) -> None:
        """Show both images of a frame; a disparity as grey levels."""
        self.image(frame.stamp_ns, frame.left)
        levels = cv2.normalize(frame.right.astype(np.float32), None, 0, 255, cv2.NORM_MINMAX)
        right = frame.right if frame.right.dtype == np.uint8 else levels.astype(np.uint8)
        self.canvas.picture(frame.stamp_ns, RIGHT, right)

    def overlay(self, stamp_ns: int, picture: NDArray[np.uint8]) -> None:
        """Show a keyframe (H, W, 3) BGR tinted by its floor and what moves."""
        self.canvas.picture(stamp_ns, KEYFRAME, picture)

    def camera(self, K: Array, size: tuple[int, int], T_base_left: Array) -> None:
        """Show a camera of intrinsics (3, 3) and size (width, height) where it is on the base."""
        scale = WIDTH_PX / size[0]
        pinhole = self._rr.Pinhole(
            image_from_camera=np.diag([scale, scale, 1.0]) @ K,
            resolution=(WIDTH_PX, round(scale * size[1])),
            image_plane_distance=CAMERA_M,
        )
        self.canvas.log(None, CAMERA, pinhole)
        self.canvas.log(None, CAMERA, _transform(self._rr, T_base_left))

    def pose(self, stamp_ns: int, T_map_base: Array) -> None:
        """Show where the base (4, 4) is."""
        self.canvas.log(stamp_ns, BASE, _transform(self._rr, T_map_base))

    def path(self, stamp_ns: int, path: KeyframePath) -> None:
        """Show the keyframes as they are now, and where loops were closed."""
        rr, xyz = self._rr, path.T_map_base[:, :3, 3]
        self.canvas.log(
            stamp_ns, 'world/path', rr.LineStrips3D([xyz], colors=PATH_RGB, radii=PATH_M)
        )
        dots = rr.Points3D(xyz, colors=KEYFRAME_RGB, radii=2 * PATH_M)
        self.canvas.log(stamp_ns, 'world/keyframes', dots)
        closed = np.searchsorted(path.stamp_ns, self._loops_ns).clip(max=len(xyz) - 1)
        dots = rr.Points3D(xyz[closed.astype(int)], colors=LOOP_RGB, radii=5 * PATH_M)
        self.canvas.log(stamp_ns, 'world/loops', dots)

    def loops(self, stamp_ns: int, count: int) -> None:
        """Note how many loops are closed."""
        if count > len(self._loops_ns):
            self._loops_ns += [stamp_ns] * (count - len(self._loops_ns))
            self.canvas.text(stamp_ns, f'loop {count} closed: the path is corrected')

    def cloud(self, stamp_ns: int, points: LabelledPoints | None) -> None:
        """Show the labelled cloud: floor green, obstacles by height, others grey."""
        if points is None:
            return
        levels = np.clip(255 / HIGH_M * points.xyz_map[:, 2], 0, 255).astype(np.uint8)
        rgb = cv2.applyColorMap(levels, cv2.COLORMAP_PLASMA).reshape(-1, 3)[:, ::-1].copy()
        rgb[points.label != POINT_OBSTACLE] = UNKNOWN_PIXEL
        rgb[points.label == POINT_FLOOR] = FLOOR_RGB
        cloud = self._rr.Points3D(points.xyz_map, colors=rgb, radii=POINT_M)
        self.canvas.log(stamp_ns, 'world/cloud', cloud)

    def classes(self, stamp_ns: int, points: LabelledPoints, names: Sequence[str]) -> None:
        """Show the points by the names of their classes (N,), '' for none."""
        known = sorted({*names} - {''})
        of = np.array([known.index(name) if name else UNLABELLED for name in names], np.intp)
        for i, (name, bgr) in enumerate(zip(known, class_colours(len(known)), strict=True)):
            dots = self._rr.Points3D(
                points.xyz_map[of == i], colors=bgr[::-1], radii=POINT_M, labels=name
            )
            self.canvas.log(stamp_ns, f'world/{CLASSES}/{name.replace(" ", "_")}', dots)

    def moving_points(self, stamp_ns: int, moving: MovingPoints) -> None:
        """Show what moves, with the way it moves in a second."""
        way = np.nan_to_num(moving.velocity_m_s)
        arrows = self._rr.Arrows3D(origins=moving.xyz_map, vectors=way, colors=MOVING_RGB)
        self.canvas.log(stamp_ns, 'world/moving', arrows)

    def grid(self, stamp_ns: int, grid: OccupancyGrid | None) -> None:
        """Show the map on the ground."""
        if grid is None:
            return
        rows, columns = grid.cells.shape
        form = self._rr.components.ImageFormat(
            width=columns, height=rows, color_model='L', channel_datatype='U8'
        )
        drawn = self._rr.GridMap(
            data=grid.picture.tobytes(),
            format=form,
            colormap=self._rr.components.Colormap.Grayscale,
            cell_size=grid.resolution_m,
            translation=[*grid.origin_xy_m, 0.0],
        )
        self.canvas.log(stamp_ns, 'world/map', drawn)

    def duration(self, stamp_ns: int, stage: str, duration_s: float) -> None:
        """Show how long a stage has taken."""
        self.canvas.log(stamp_ns, f'{TIMES}/{stage}', self._rr.Scalars(1e3 * duration_s))

    def state(self, stamp_ns: int, words: str) -> None:
        """Show the state of tracking where it changes."""
        if words != self._state:
            self._state = words
            self.canvas.text(stamp_ns, words, 'WARN' if words.startswith('lost') else 'INFO')

    def about(self, title: str, rows: Sequence[tuple[str, str]]) -> None:
        """Show what is known of all of the drive."""
        lines = [f'# {title}', '', '| | |', '|---|---|', *(f'| {a} | {b} |' for a, b in rows)]
        document = self._rr.TextDocument('\n'.join(lines), media_type='text/markdown')
        self.canvas.log(None, ABOUT, document)


def show_recording(view: View, source: StereoSource) -> None:
    """Show the images of a recording."""
    sensors = [(sensor.name, f'{sensor.messages} messages') for sensor in source.sensors]
    size = f'{source.camera.width} x {source.camera.height}, {source.rate_hz:.1f} Hz'
    view.about(Path(source.name).name, [('images', size), *sensors])
    with progress_bar('reading', source.frame_count) as progress:
        for done, frame in enumerate(source.frames(), 1):
            view.pair(frame)
            progress(done)


@dataclass(frozen=True)
class Results:
    """What a run has left in a folder. trajectory, keyframes: times (N,) in s and T_map_base
    (N, 4, 4).
    """

    folder: Path
    summary: dict[str, Any]
    trajectory: tuple[Array, Array]
    keyframes: tuple[Array, Array]
    cloud: LabelledPoints


def read_results(folder: Path) -> Results:
    """Read what a run has left in a folder. Raises InputError."""
    return Results(
        folder,
        read_summary(folder / 'summary.json'),
        read_trajectory(folder / 'trajectory.txt'),
        read_trajectory(folder / 'keyframes.txt', may_be_empty=True),
        read_ply(folder / 'labelled_cloud.ply'),
    )


def show_results(view: View, results: Results, tab: str = '') -> None:
    """Show what a run has left, behind a tab if it gets one, with the images of its recording where
    that is still there. Raises InputError.
    """
    view = View(view.canvas.below(tab)) if tab else view
    folder, summary = results.folder, results.summary
    (times_s, T_map_base), (keyframe_s, T_map_keyframe) = results.trajectory, results.keyframes
    stamps_ns, keyframe_ns = (np.rint(1e9 * t).astype(np.int64) for t in (times_s, keyframe_s))
    first_ns = int(stamps_ns[0])
    figures = ('frames', 'tracked_frames', 'lost_intervals', 'keyframes', 'loops')
    rows = [(figure.replace('_', ' '), str(summary[figure])) for figure in figures]
    stages = summary['stages'].items()
    rows += [(stage, f'{times["p50_ms"]:.1f} ms, median') for stage, times in stages]
    view.about(folder.name, rows)
    view.state(first_ns, f'{summary["tracked_frames"]} of {summary["frames"]} frames tracked')
    for count, at_s in enumerate(summary.get('loop_times_s', []), 1):
        view.loops(round(1e9 * at_s), count)
    view.path(first_ns, KeyframePath(keyframe_ns, T_map_keyframe))
    view.cloud(first_ns, results.cloud)
    if (folder / POINT_LABELS).is_file():
        lines = read_text(folder / POINT_LABELS).splitlines()[1:]
        view.classes(first_ns, results.cloud, [line.partition(',')[2] for line in lines])
    if (folder / SEMANTIC).is_file():
        view.canvas.picture(first_ns, CLASSES, read_picture(folder / SEMANTIC))
    if (folder / MAP).is_file():
        view.grid(first_ns, load_map(folder / MAP))
    for stamp_ns, T in zip(stamps_ns, T_map_base, strict=True):
        view.pose(int(stamp_ns), T)
    try:
        source = open_source(resolve(folder / 'settings.yaml').stereo_camera)
    except InputError as error:
        return view.canvas.text(first_ns, f'without images: {error}', 'WARN')
    camera = source.camera
    mount = Mount(*(summary[name] or 0.0 for name in MOUNT_FIGURES))
    view.camera(camera.K, (camera.width, camera.height), mount.T_base_left)
    with progress_bar('reading', source.frame_count) as progress:
        for done, frame in enumerate(source.frames(), 1):
            view.image(frame.stamp_ns, frame.left)
            mask, moving = (
                folder / masks / f'{frame.index:06d}.png'
                for masks in ('floor_masks', 'moving_masks')
            )
            if mask.is_file():
                found = read_mask(moving) if moving.is_file() else None
                tinted = mask_overlay(frame.left, read_mask(mask), found)
                view.overlay(frame.stamp_ns, tinted)
            progress(done)


def _show_newest(view: View, result: FrameResult) -> None:
    if result.tracked:
        view.pose(result.stamp_ns, result.T_map_odom @ result.T_odom_base)
    if result.moving is not None:
        view.moving_points(result.stamp_ns, result.moving)


def _transform(rerun: ModuleType, T: Array) -> Any:
    return rerun.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])


def _panes(rrb: ModuleType, root: str) -> Any:
    """Return the panes of a drive: the map, and beside it what the camera sees."""
    pictures = rrb.Tabs(
        rrb.Spatial2DView(origin=f'{root}/{KEYFRAME}', name='Floor of the keyframe'),
        rrb.Spatial2DView(origin=f'{root}/{RIGHT}', name='Right'),
        rrb.Spatial2DView(origin=f'{root}/{CLASSES}', name='Classes'),
        active_tab=0,
    )
    words = rrb.Tabs(
        rrb.TextLogView(origin=f'{root}/{TEXT}', name='State'),
        rrb.TimeSeriesView(origin=f'{root}/{TIMES}', name='Time per stage [ms]'),
        rrb.TextDocumentView(origin=f'{root}/{ABOUT}', name='About'),
    )
    return rrb.Horizontal(
        rrb.Spatial3DView(origin=f'{root}/world', name='Map'),
        rrb.Vertical(rrb.Spatial2DView(origin=f'{root}/{CAMERA}', name='Camera'), pictures, words),
        column_shares=[2, 1],
        name=root,
    )
