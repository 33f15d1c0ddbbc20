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
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from segfloor_ros.camera.model import StereoFrame
from segfloor_ros.configuration import resolve
from segfloor_ros.evaluation.trajectory import TrajectoryScore, match, score_trajectory
from segfloor_ros.evaluation.trajectory_files import read_trajectory
from segfloor_ros.geometry import invert, rotation_angle
from segfloor_ros.slam.results import FrameResult, KeyframePath
from segfloor_ros.slam.stereo_slam import StereoSlam
from segfloor_ros.stages import make_slam
from segfloor_ros.trajectory import TrackedPose, corrected_trajectory
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
        poses = [
            TrackedPose(r.stamp_ns, r.T_odom_base, r.reference_keyframe_ns)
            for r in self.results
            if r.tracked
        ]
        path = corrected_trajectory(poses, self.path).seen_from(self.slam.mount.T_base_left)
        estimate = 1e-9 * path.stamp_ns, path.poses
        return score_trajectory(
            match(estimate, read_trajectory(recording / 'poses.txt'), len(self.results))
        )


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
        for candidate in slam.loop_candidates:
            now, then = (
                truth[slam.map.keyframes[k].frame_index]
                for k in (candidate.keyframe, candidate.place)
            )
            error = invert(invert(now) @ then) @ candidate.T_keyframe_place
            wrong = (
                np.linalg.norm(error[:3, 3]) > FALSE_M or rotation_angle(error[:3, :3]) > FALSE_RAD
            )
            verdicts[f'{candidate.verdict}: {"FALSE" if wrong else "true"}'] += 1
        score = followed.score(drive)
        print(
            f'{drive.name}: {score.path_length_m:.0f} m, {len(slam.map.keyframes)} keyframes, '
            f'tracked {sum(r.tracked for r in followed.results)} of {len(followed.results)}, '
            f'RMSE {score.ate_rmse_m:.4f} m, end {score.end_error_m:.3f} m, '
            f'loops {slam.loop_count}; {dict(sorted(verdicts.items()))}',
            flush=True,
        )


if __name__ == '__main__':
    app()
