"""Places that are seen again: loops, a camera that was carried away, a second drive.

    python -m tools.places loops DRIVE…          what SLAM takes for a loop, and what becomes of it
    python -m tools.places kidnap DRIVE…         frames are cut out: how soon it knows where it is
    python -m tools.places again FIRST SECOND    a second drive is localized in the map of the first
    python -m tools.places cost                  of query and closing, by the number of keyframes

Drives have a true path (poses.txt). `again` and `kidnap` also need base_poses.txt.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer

from segfloor_ros.apps.evaluation.trajectory import TrajectoryScore, match, score_trajectory
from segfloor_ros.apps.trajectory import TrackedPose, corrected_trajectory, read_trajectory
from segfloor_ros.core.contracts import FrameResult, KeyframePath, StereoFrame
from segfloor_ros.core.files.results import from_bytes, to_bytes
from segfloor_ros.core.geometry import Array, invert, rotation_angle
from segfloor_ros.core.memory import rss_mb
from segfloor_ros.core.plugins.assembly import make_slam
from segfloor_ros.core.plugins.maps.saved_slam import load_slam, save_slam
from segfloor_ros.core.slam.places.loops import Candidate
from segfloor_ros.core.slam.stereo_slam import StereoSlam
from segfloor_ros.nodes.configuration import resolve
from tools.driving import open_recording

FALSE_M, FALSE_RAD = 0.25, 0.1
"""A match that is further from the truth than this is of another place."""

app = typer.Typer(help=__doc__)


@app.callback()
def _several() -> None:
    pass


Drives = Annotated[list[Path], typer.Argument(help='Recordings with poses.txt.')]
Params = Annotated[list[str] | None, typer.Option('--set', help='stage.name=value')]
Every = Annotated[int, typer.Option(help='Take every Nth frame.')]
Noise = Annotated[float, typer.Option(help='Noise added to the images, grey levels.')]
Seed = Annotated[int, typer.Option(help='Of the noise.')]


class Followed:
    """SLAM along a drive, and what came of it."""

    def __init__(self, slam: StereoSlam) -> None:
        self.slam = slam
        self.results: list[FrameResult] = []
        self.path: KeyframePath | None = None
        self.frame_s: list[float] = []

    def process(self, frames: Iterable[StereoFrame]) -> None:
        """Put frames through SLAM."""
        for frame in frames:
            start_s = time.thread_time()
            results = self.slam.process(frame)
            self.frame_s.append(time.thread_time() - start_s)
            for result in results:
                if result.keyframe is not None:
                    self.path = result.keyframe.path
                self.results.append(dataclasses.replace(result, keyframe=None))

    def score(self, recording: Path) -> TrajectoryScore:
        """Return the error of the camera's path, every frame carried along by its keyframe."""
        assert self.path is not None and self.slam.mount is not None
        path = corrected_trajectory(tracked_poses(self.results), self.path).seen_from(
            self.slam.mount.T_base_left
        )
        estimate = 1e-9 * path.stamp_ns, path.poses
        return score_trajectory(
            match(estimate, read_trajectory(recording / 'poses.txt'), len(self.results))
        )


def tracked_poses(results: Iterable[FrameResult]) -> list[TrackedPose]:
    """Return the poses of the frames that were tracked."""
    return [
        TrackedPose(r.stamp_ns, r.T_odom_base, r.reference_keyframe_ns)
        for r in results
        if r.tracked
    ]


def is_false(slam: StereoSlam, truth: Array, candidate: Candidate) -> bool:
    """Whether a keyframe that saw a place truly (N, 4, 4) stood somewhere else."""
    now, then = (
        truth[slam.map.keyframes[k].frame_index] for k in (candidate.keyframe, candidate.place)
    )
    error = invert(invert(now) @ then) @ candidate.T_keyframe_place
    return bool(np.linalg.norm(error[:3, 3]) > FALSE_M or rotation_angle(error[:3, :3]) > FALSE_RAD)


def worse(
    frames: Iterable[StereoFrame], every: int, noise: float, seed: int
) -> Iterator[StereoFrame]:
    """Leave frames out and add noise."""
    rng = np.random.default_rng(seed)
    for number, frame in enumerate(frames):
        if number % every:
            continue
        if noise:
            left, right = (
                np.clip(rng.normal(0, noise, i.shape) + i, 0, 255).astype(np.uint8)
                for i in (frame.left, frame.right)
            )
            frame = dataclasses.replace(frame, left=left, right=right)
        yield frame


@app.command()
def loops(
    drives: Drives, assignments: Params = None, every: Every = 1, noise: Noise = 0.0, seed: Seed = 1
) -> None:
    """For each drive: the error of the path, the loops closed, and for every verdict on a place
    that was recognised, how many keyframes were truly there and how many were not.
    """
    configuration = resolve(None, assignments or ())
    for drive in drives:
        source = open_recording(drive, configuration)
        slam = make_slam(source.camera, configuration.stereo_slam)
        followed = Followed(slam)
        with contextlib.closing(slam):
            followed.process(worse(source.frames(), every, noise, seed))
        _, truth = read_trajectory(drive / 'poses.txt')
        verdicts: Counter[str] = Counter()
        for candidate in slam.back_end.loops.candidates:
            wrong = is_false(slam, truth, candidate)
            verdicts[f'{candidate.verdict}: {"FALSE" if wrong else "true"}'] += 1
        score = followed.score(drive)
        print(
            f'{drive.name}: {score.path_length_m:.0f} m, {len(slam.map.keyframes)} keyframes, '
            f'tracked {sum(r.tracked for r in followed.results)} of {len(followed.results)}, '
            f'RMSE {score.ate_rmse_m:.4f} m, end {score.end_error_m:.3f} m, '
            f'loops {slam.back_end.loop_count}; {dict(sorted(verdicts.items()))}',
            flush=True,
        )


@app.command()
def kidnap(
    drive: Annotated[Path, typer.Argument(help='A recording that comes back to places.')],
    first: Annotated[int, typer.Option(help='Frame before which nothing is cut out.')] = 200,
    cases: Annotated[int, typer.Option(help='Cuts, evenly spaced.')] = 40,
    cut_s: Annotated[float, typer.Option(help='What is cut out.')] = 10.0,
) -> None:
    """Cut a drive at many places, and see how long after the cut the camera is found."""
    configuration = resolve()
    source = open_recording(drive, configuration)
    frames = list(source.frames())
    times, truth = read_trajectory(drive / 'poses.txt')
    last = int(np.searchsorted(times, times[-1] - cut_s - 3.0))
    cuts = set(np.linspace(first, last, cases).astype(int).tolist())
    cv2.setNumThreads(1)  # a copy of the process has no other threads
    slam = make_slam(source.camera, configuration.stereo_slam)
    took_s: list[float] = []
    false = 0
    for number, frame in enumerate(frames):
        slam.process(frame)
        if number in cuts:
            found_s, wrong_m = _in_a_copy(
                partial(_recover, slam, frames, times, truth, number, cut_s)
            )
            took_s.append(found_s)
            false += wrong_m > FALSE_M
    took = np.array(took_s)
    print(
        f'{drive.name}: {len(took)} cuts of {cut_s:g} s, back within 1 s: '
        f'{(took <= 1.0).sum()}, median {np.median(took):.2f} s, 95th percentile '
        f'{np.percentile(took, 95):.2f} s, at a wrong place: {false}'
    )


def _in_a_copy(work: Callable[[], tuple[float, float]]) -> tuple[float, float]:
    """Return what work returns in a copy of this process: it changes nothing here."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.write(writing, json.dumps(work()).encode())
        os._exit(0)
    os.close(writing)
    with open(reading, 'rb') as file:
        answer = file.read()
    os.waitpid(child, 0)
    found_s, wrong_m = json.loads(answer)
    return float(found_s), float(wrong_m)


def _recover(
    slam: StereoSlam, frames: list[StereoFrame], times: Array, truth: Array, cut: int, cut_s: float
) -> tuple[float, float]:
    """Return how long it took to be tracked after a cut (s), and how far off it was then (m)."""
    assert slam.mount is not None
    T_map_left = slam.mount.T_base_left
    start = int(np.searchsorted(times, times[cut] + cut_s))
    for k in range(start, len(frames)):
        results = slam.process(frames[k])  # none of a submap, until it is merged
        if results and results[-1].tracked:
            result = results[-1]
            T_world_left = invert(T_map_left) @ result.T_map_odom @ result.T_odom_base @ T_map_left
            wrong_m = float(np.linalg.norm((invert(truth[k]) @ T_world_left)[:3, 3]))
            return float(times[k] - times[start]), wrong_m
    return math.inf, 0.0


@app.command()
def again(
    first: Annotated[Path, typer.Argument(help='The drive that makes the map.')],
    second: Annotated[Path, typer.Argument(help='A drive in the same scene.')],
    map_on: Annotated[bool, typer.Option(help='Map on instead of localizing.')] = False,
) -> None:
    """Save the map of one drive, load it, and follow another drive in it."""
    configuration = resolve()
    source = open_recording(first, configuration)
    made = Followed(make_slam(source.camera, configuration.stereo_slam))
    made.process(source.frames())
    data = to_bytes(save_slam(made.slam, source.camera))
    slam = make_slam(source.camera, configuration.stereo_slam)
    load_slam(slam, source.camera, from_bytes(data, 'map'), 'map', localize=not map_on)
    followed, start_mb = Followed(slam), rss_mb()
    followed.process(open_recording(second, configuration).frames())
    keyframes = len(made.slam.map.keyframes)
    print(
        f'map of {first.name}: {keyframes} keyframes, {len(data) / keyframes / 1e3:.1f} kB each; '
        f'frame {1e3 * np.median(made.frame_s):.1f} ms in the median, '
        f'{1e3 * np.mean(made.frame_s):.1f} on average'
    )
    errors = _errors_in_map(followed.results, first, second)
    tracked = np.isfinite(errors)
    print(
        f'{second.name}: tracked {tracked.sum()} of {len(errors)}, first at frame '
        f'{int(np.argmax(tracked))}, error {np.nanmedian(errors):.4f} m in the median, '
        f'{np.nanpercentile(errors, 95):.4f} m 95th percentile, {np.nanmax(errors):.3f} m at most; '
        f'frame {1e3 * np.median(followed.frame_s):.1f} ms in the median, '
        f'{1e3 * np.mean(followed.frame_s):.1f} on average; keyframes {len(slam.map.keyframes)}, '
        f'loops {slam.back_end.loop_count}, memory {start_mb:.0f} to {rss_mb():.0f} MB'
    )
    again_data = to_bytes(save_slam(slam, source.camera))
    print(f'saved again: {len(again_data) / 1e6:.2f} MB, before {len(data) / 1e6:.2f} MB')


def _errors_in_map(results: list[FrameResult], first: Path, second: Path) -> Array:
    """Return the distance (N,) of the base from where it truly is in the map, NaN where lost."""
    start, truth = (_base_poses(drive) for drive in (first, second))
    T_map_base = invert(start[0]) @ truth
    errors = np.full(len(results), np.nan)
    for k, result in enumerate(results):
        if result.tracked:
            found = result.T_map_odom @ result.T_odom_base
            errors[k] = np.linalg.norm((invert(T_map_base[result.index]) @ found)[:2, 3])
    return errors


def _base_poses(drive: Path) -> Array:
    """Return the true poses T_world_base (N, 4, 4)."""
    x, y, yaw = np.loadtxt(drive / 'base_poses.txt')[:, 1:4].T
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(yaw)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    poses[:, 0, 3], poses[:, 1, 3] = x, y
    return poses


if __name__ == '__main__':
    app()
