"""What wheels and an IMU bring where a camera alone fails: `python -m tools.sensor_table`.

Rendered drives with something that a camera cannot follow, each with and without each sensor.
"""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Optional

import numpy as np
import typer
from numpy.typing import NDArray

from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.cli.terminal import announcing, figure_table
from segfloor_ros.apps.evaluation.map_score import score_map
from segfloor_ros.apps.evaluation.maps import load_truth
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.simulation import render_once
from segfloor_ros.apps.trajectory import TrackedPose, corrected_trajectory
from segfloor_ros.core.contracts import FrameResult, KeyframePath
from segfloor_ros.core.plugins.assembly import make_pipeline, make_slam
from segfloor_ros.nodes.configuration import resolve
from tools.driving import after_sensors, open_recording

SENSORS = ('sensors.wheel_odometry.rate_hz=50', 'sensors.imu.rate_hz=200')
LOOP = (
    'path.waypoints=[[-2.7,-1.8],[2.7,-1.7],[2.8,1.7],[-1.5,1.7]]',
    'path.speed_m_s=0.6',
    'path.smoothing_m=0.15',
    *SENSORS,
)
"""Half a lap of the hall: nothing of it is seen twice."""

DRIVES: dict[str, tuple[str, tuple[str, ...]]] = {
    'blank wall, turn, dark': ('blind_corridor', ()),
    'blank wall 5 m': ('blind_corridor', ('lighting.levels=[]', 'path.turn_rate_deg_s=35')),
    'turn 180 deg/s': ('hall', (*LOOP, 'path.turn_rate_deg_s=180', 'path.smoothing_m=0.03')),
    'covered 5 s': ('hall', (*LOOP, 'camera.covered=[[6,11]]')),
    'dark 5 s': ('hall', (*LOOP, 'lighting.levels=[[0,1],[6,1],[6.1,0.02],[11,0.02],[11.1,1]]')),
    'slip 2 s': ('hall', (*LOOP, 'sensors.wheel_odometry.slips=[[7,9,1.6,1.2]]')),
    'scale 5 %': ('hall', (*LOOP, 'sensors.wheel_odometry.scale=1.05')),
}
"""Name, scene and what is changed in it."""

LEFT_OUT = {
    'stereo': 'wheel_odometry,imu',
    '+ wheels': 'imu',
    '+ IMU': 'wheel_odometry',
    '+ both': '',
}
NEW_ROW_AFTER = '+ both'


@dataclasses.dataclass(frozen=True)
class Measured:
    """One drive with some sensors. tracked: share of the frames; path_m, end_m: RMSE and last error
    of the path from its first pose on; blind_share: the worst error at the end of a stretch without
    images that it adds, as a share of the stretch; precision, recall: of the map, NaN without one.
    """

    tracked: float
    path_m: float
    end_m: float
    blind_share: float
    precision: float
    recall: float
    remarks: tuple[str, ...]


def sensor_table(
    drives: Annotated[
        Optional[list[str]],  # noqa: UP045  typer evaluates it, also on Python 3.10
        typer.Argument(help='Some of: ' + '; '.join(DRIVES) + '. [default: all]'),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help='Drives of each kind, seeds 1, 2, ...')] = 3,
    maps: Annotated[bool, typer.Option(help='Score maps, too: all stages run.')] = False,
    only: Annotated[str, typer.Option(help='Only these sensors, e.g. "+ both".')] = '',
    workdir: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help='Keep renderings here; what is there is used again.'),
    ] = None,
) -> None:
    """Print a row for each drive and each set of sensors, the median and the worst of the seeds."""
    names = ('tracked', 'worst', 'path m', 'worst', 'end m', 'blind %', 'worst')
    table = figure_table('drive', 'sensors', *names, 'precision', 'recall')
    with tempfile.TemporaryDirectory(prefix='segfloor-') as temporary, announcing() as announce:
        for drive in drives or DRIVES:
            scene_name, changes = DRIVES[drive]
            recordings = []
            for seed in range(1, seeds + 1):
                scene = dataclasses.replace(open_scene(scene_name, changes), seed=seed)
                folder = (workdir or Path(temporary)) / f'{drive} {seed}'.replace(' ', '_')
                render_once(scene, folder, on_start=partial(announce, f'rendering {folder.name}'))
                recordings.append(folder)
            for sensors, ignored in LEFT_OUT.items():
                if only and sensors != only:
                    continue
                found = []
                for folder in recordings:
                    report = announce(f'{folder.name} {sensors}', len(list(folder.glob('*_0/*'))))
                    found.append(measure(folder, ignored, maps, report))
                    console.print(folder.name, sensors, found[-1], highlight=False)
                table.add_row(drive, sensors, *_figures(found))
    table.caption = (
        'path: RMSE from the first pose on; blind: what a stretch on sensors alone adds, of its way'
    )
    console.print(table)


def measure(
    recording: Path, ignored: str, with_map: bool, on_progress: Callable[[int], None]
) -> Measured:
    """Drive a recording without some of its sensors."""
    configuration = resolve(stereo_camera={'input': str(recording), 'ignore': ignored})
    source = open_recording(recording, configuration)
    pipeline = make_pipeline(source.camera, configuration) if with_map else None
    slam = pipeline.slam if pipeline else make_slam(source.camera, configuration.stereo_slam)
    results: list[FrameResult] = []
    path: KeyframePath | None = None
    with contextlib.closing(pipeline or slam):
        frames = after_sensors(slam, source.sensors, source.frames())
        for done, frame in enumerate(frames, start=1):
            for result in (pipeline or slam).process(frame):
                path = result.keyframe.path if result.keyframe is not None else path
                results.append(dataclasses.replace(result, keyframe=None))
            on_progress(done)
        results += [dataclasses.replace(result, keyframe=None) for result in slam.finish()]
        grid = pipeline.finish() if pipeline else None
    truth = load_truth(recording)
    score = score_map(grid, truth) if grid else None
    assert path is not None
    errors_m = _errors_m(results, path, recording)
    return Measured(
        float(np.mean([result.tracked for result in results])),
        float(np.sqrt(np.nanmean(errors_m**2))),
        float(errors_m[np.isfinite(errors_m)][-1]),
        _blind_share(results, recording),
        score.raw.precision.mean if score else np.nan,
        score.raw.recall.mean if score else np.nan,
        tuple(slam.sensors.remarks.values()),
    )


def _true_xy(recording: Path) -> NDArray[np.floating]:
    """Return where the base was (N, 2) in its first frame."""
    x, y, yaw = (poses := np.loadtxt(recording / 'base_poses.txt')[:, 1:])[0]
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.asarray((poses[:, :2] - [x, y]) @ np.array([[cos, -sin], [sin, cos]]))


def _errors_m(
    results: list[FrameResult], path: KeyframePath, recording: Path
) -> NDArray[np.floating]:
    """Return the error (N,) of every frame, carried along by its keyframe; NaN where lost."""
    tracked = [result for result in results if result.tracked]
    poses = [TrackedPose(r.stamp_ns, r.T_odom_base, r.reference_keyframe_ns) for r in tracked]
    found = corrected_trajectory(poses, path).poses[:, :2, 3]
    errors_m = np.full(len(results), np.nan)
    index = [result.index for result in tracked]
    errors_m[index] = np.linalg.norm(found - _true_xy(recording)[index], axis=1)
    return errors_m


def _blind_share(results: list[FrameResult], recording: Path) -> float:
    """Return what stretches on sensors alone add to the error, as a share of their way: the worst
    of those of half a metre and more.
    """
    true_xy = _true_xy(recording)
    here = np.array([(r.T_map_odom @ r.T_odom_base)[:2, 3] for r in results])
    blind = np.array([result.blind for result in results])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], blind, [False]]).astype(int)))
    shares = []
    for start, end in edges.reshape(-1, 2):
        before, last = max(start - 1, 0), end - 1
        way_m = np.linalg.norm(np.diff(true_xy[before : last + 1], axis=0), axis=1).sum()
        added = (here[last] - true_xy[last]) - (here[before] - true_xy[before])
        if way_m >= 0.5:
            shares.append(float(np.linalg.norm(added) / way_m))
    return max(shares, default=np.nan)


def _figures(found: list[Measured]) -> list[str]:
    tracked, path, end, blind, precision, recall = (
        np.array([getattr(one, name) for one in found])
        for name in ('tracked', 'path_m', 'end_m', 'blind_share', 'precision', 'recall')
    )
    return [
        f'{100 * np.median(tracked):.0f} %',
        f'{100 * tracked.min():.0f} %',
        f'{np.median(path):.4f}',
        f'{path.max():.4f}',
        f'{np.median(end):.4f}',
        f'{100 * np.median(blind):.2f}',
        f'{100 * blind.max():.2f}',
        f'{100 * np.median(precision):.1f} %',
        f'{100 * np.median(recall):.1f} %',
    ]


if __name__ == '__main__':
    run_command(sensor_table)
