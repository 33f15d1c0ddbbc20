"""Whether the covariance of a pose is true: `python -m tools.consistency [RECORDING...]`.

Over drives with a known path, poses and covariances are taken as SLAM publishes them, without later
corrections. The motion over a window of time is held against the true one. Its error is a twist e,
and e^T C^-1 e is a chi-square of 6 degrees of freedom where the covariance C is true.

C = A P_a A^T + P_b + D, of twists of the camera after the window, where A is the adjoint of the
motion back, P the covariance of each pose in the map around it, and D that of the drift of `odom`
in between.

The truth errs itself: C has its covariance, too, once for each end. Windows begin at every frame,
so they overlap; those in which a frame is lost are left out.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Optional

import numpy as np
import typer
from rich.table import Table
from scipy.stats import chi2, norm

import segfloor_ros
from segfloor_ros.apps.cli.main import run_command
from segfloor_ros.apps.cli.printing import PlainConsole, console
from segfloor_ros.apps.cli.terminal import Announce, announcing, figure_table
from segfloor_ros.apps.simulation.scene_file import open_scene, shipped
from segfloor_ros.apps.simulation.simulation import render_once
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import FrameResult, Mount
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.whole import read_json
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.twists import adjoint, se3_logs
from segfloor_ros.nodes.configuration import resolve
from tools.plain_pnp import DATA, WIDTH, arrow
from tools.recorded_frames import CACHE, Recorded, true_poses
from tools.tracked_frames import track_frames

WINDOWS_S = 0.1, 1.0, 5.0
REACH, CUT = 0.35, 0.05
"""A window may be longer or shorter than it should be by the one share, as the frames have it; at
the end of the drive shorter by the other."""

RECORDINGS = 'corridor', 'freiburg3_cabinet', 'kitchen', 'kitti06', 'euroc_tiny', 'tumvi'
SCENES = 'corridor1', 'corridor2', 'ramp', 'rolling'
DEPTH_M = 5.0
"""Range of the depth sensor of rendered drives: disparities with noise, over 5 cm."""

LIMITS = {sigmas: float(chi2.isf(2 * norm.sf(sigmas), 6)) for sigmas in (3, 6)}
"""Of e^T C^-1 e: as improbable as 3 and 6 standard deviations of one figure, 20.1 and 51.9."""

MEDIAN_OF_3 = float(chi2.median(3)) / 3
"""What the median of the errors per degree of freedom should be, 0.79."""

LEAST = 1e-12
"""Added to variances, m² and rad²: a micrometre."""

TRUTH_SIGMA: dict[str, tuple[float, float]] = {
    # Motion capture: 1-2 mm and 0.1-0.3 deg (Sturm et al., IROS 2012; Schubert et al., IROS 2018).
    'freiburg3_cabinet': (0.002, 0.2),
    'tumvi': (0.001, 0.1),
    # RTK-GPS with inertial sensors: 2 cm, 0.1 deg (OXTS RT3003, Geiger et al., IJRR 2013).
    'kitti06': (0.02, 0.1),
    # KinectFusion (Shotton et al., CVPR 2013), whose accuracy is not published: taken for this.
    'kitchen': (0.005, 0.3),
}
"""Standard deviations of the true poses of recordings, in m and degrees; others are exact."""

INTERPOLATED = {'kitti06': 12}
"""How many first true poses were not measured: up to there the true path turns evenly, 0.057 deg a
frame about one axis, and PnP on SIFT features (frame 0 to 5) differs from it by 0.55 deg, from
SLAM by 0.03."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One drive and window. beyond_3, beyond_6: share of the windows that err by more than
    so many sigma. translation, rotation: median of the normalised squared errors per degree of
    freedom. error_m, error_deg: medians of the errors; sigma_m, sigma_deg: of what is claimed.
    """

    drive: str
    window_s: float
    windows: int
    beyond_3: float
    beyond_6: float
    translation: float
    rotation: float
    error_m: float
    sigma_m: float
    error_deg: float
    sigma_deg: float

    @property
    def key(self) -> tuple[str, float]:
        """What tells a row from the others."""
        return self.drive, self.window_s


@dataclasses.dataclass(frozen=True)
class Published:
    """Poses of the camera T_odom_left (N, 4, 4), NaN where lost, and the covariance (N, 6, 6) of a
    twist that is multiplied from the right, in the axes of the camera. drift: (N, 6, 13), of odom.
    """

    stamp_ns: Array
    T_odom_left: Array
    covariance: Array
    drift: Array


def consistency(
    recordings: Annotated[
        Optional[list[str]],  # noqa: UP045  typer evaluates it, also on Python 3.10
        typer.Argument(
            help='Folders or names of recordings, and scenes to render, which are driven once as '
            f'stereo and once with depth. [default: {" ".join((*RECORDINGS, *SCENES))}]'
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help='Of the rendered drives.')] = 1,
    exact_truth: Annotated[
        bool, typer.Option('--exact-truth', help='Take the truth of recordings for exact.')
    ] = False,
    exact_camera: Annotated[
        bool,
        typer.Option(
            '--exact-camera',
            help='Take the calibration for exact, as that of rendered drives is: errors of it have '
            'no part in the drift.',
        ),
    ] = False,
    assignments: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            '--set', help='One parameter, e.g. stereo_slam.num_features=2000; repeatable.'
        ),
    ] = None,
    data: Annotated[Path, typer.Option(help='Folder of the recordings.')] = DATA,
    cache: Annotated[Path, typer.Option(help='Folder for renderings and frames.')] = CACHE,
    limit: Annotated[int, typer.Option(min=0, help='At most so many frames; 0: all.')] = 0,
    json_file: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option('--json', help='File for the figures.'),
    ] = None,
    compare: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help='Figures of an earlier --json: they stand before the arrows.'),
    ] = None,
) -> None:
    """Print a row for each drive and window."""
    before = read_rows(compare) if compare else {}
    configuration, start_s = resolve(None, assignments or ()), time.perf_counter()
    rows: list[Row] = []
    with announcing() as announce:
        for name in recordings or (*RECORDINGS, *SCENES):
            for recorded in drives(name, data, cache, seed, limit, announce):
                rows += measure(recorded, configuration, exact_truth, exact_camera, announce)
                if json_file:
                    document = {'rows': [dataclasses.asdict(row) for row in rows]}
                    json_file.write_text(json.dumps(document, indent=1))
    PlainConsole(width=max(console.width, WIDTH)).print(table_of(rows, before))
    took_s = time.perf_counter() - start_s
    console.print(f'{took_s:.0f} s, with {Path(segfloor_ros.__file__).parent}', highlight=False)


def drives(
    name: str, data: Path, cache: Path, seed: int, limit: int, announce: Announce
) -> Iterator[Recorded]:
    """Yield a recording, or a rendered scene as stereo and with depth."""
    path = Path(name) if Path(name).is_dir() else data / name
    if path.is_dir():
        yield Recorded(path, cache, limit=limit)
        return
    if name not in shipped('scenes'):
        raise InputError(f'{name}: neither a recording nor a scene')
    scene = open_scene(name, (f'sensors.depth.max_m={DEPTH_M}',))
    path = cache.expanduser() / 'drives' / f'{name}-{seed}'
    path.parent.mkdir(parents=True, exist_ok=True)
    on_start = partial(announce, f'rendering {path.name}')
    render_once(dataclasses.replace(scene, seed=seed), path, on_start=on_start)
    yield Recorded(path, cache, limit=limit)
    yield Recorded(path, cache, limit=limit, depth=True)


def measure(
    recorded: Recorded,
    configuration: Configuration,
    exact_truth: bool,
    exact_camera: bool,
    announce: Announce,
) -> list[Row]:
    """Drive a recording and return its rows. Raises InputError where its truth is not known."""
    frames = recorded.frames()
    true = true_poses(recorded, [frame.stamp_ns for frame in frames])
    if true is None:
        raise InputError(f'{recorded.path}: its true path is not known')
    true[: INTERPOLATED.get(recorded.path.name, 0)] = np.nan
    report = announce(recorded.name, len(frames))
    tracked = track_frames(
        recorded.camera, frames, recorded.source.sensors, configuration, on_progress=report
    )
    sigma_m, sigma_deg = TRUTH_SIGMA.get(recorded.path.name, (0.0, 0.0))
    noise = np.repeat((sigma_m, math.radians(sigma_deg)), 3) ** 2 * (not exact_truth)
    published = as_published(tracked.results, tracked.drift, tracked.mount)
    rows = []
    for window_s in WINDOWS_S:
        pairs = windows(published, window_s)
        if len(pairs):
            e, C = errors(published, true, pairs, np.diag(noise), exact_camera)
            rows += [summary(recorded.name, window_s, e, C)] if len(e) else []
    return rows


def as_published(results: Sequence[FrameResult], drift: Array, mount: Mount) -> Published:
    """Return poses and covariances of the camera from those of the base. drift: (N, 6, 13).

    The covariance of the base has the axes of `odom` at the base: turned to those of the base it is
    that of a twist from the right, and the adjoint of the mount brings it to the camera.
    """
    T_odom_base = np.array([result.T_odom_base for result in results])
    T_odom_base[[not result.tracked for result in results]] = np.nan
    turns = np.zeros((len(results), 6, 6))
    turns[:, :3, :3] = turns[:, 3:, 3:] = np.swapaxes(T_odom_base[:, :3, :3], 1, 2)
    B = adjoint(invert(mount.T_base_left)) @ turns
    P = np.array([result.covariance for result in results])
    stamps = np.array([result.stamp_ns for result in results])
    return Published(stamps, T_odom_base @ mount.T_base_left, B @ P @ np.swapaxes(B, 1, 2), drift)


def windows(published: Published, window_s: float) -> Array:
    """Return frames before and after (M, 2) of windows of about so long, without a lost frame."""
    times_s = (published.stamp_ns - published.stamp_ns[0]) * 1e-9
    lost = np.concatenate([[0], np.cumsum(~np.isfinite(published.T_odom_left[:, 0, 0]))])
    pairs = []
    for a, time_s in enumerate(times_s):
        longer_s = times_s - time_s - window_s
        b = int(np.argmin(np.abs(longer_s)))
        is_cut = b == len(times_s) - 1 and longer_s[b] < -CUT * window_s
        is_long = abs(longer_s[b]) <= REACH * window_s and not is_cut
        if b > a and is_long and lost[b + 1] == lost[a]:
            pairs.append((a, b))
    return np.array(pairs, int).reshape(-1, 2)


def errors(
    published: Published, true: Array, pairs: Array, truth_noise: Array, exact_camera: bool = False
) -> tuple[Array, Array]:
    """Return the errors (M, 6) of motions as twists of the later camera, and the covariance (M, 6,
    6) that is claimed for them; without those whose true motion is not known. true: (N, 4, 4).
    truth_noise: (6, 6), of each true pose. exact_camera: whether the calibration does not err.
    """
    a, b = pairs.T
    known = np.isfinite(true[a, 0, 0] + true[b, 0, 0])
    a, b = a[known], b[known]
    T_a_b = invert(published.T_odom_left[a]) @ published.T_odom_left[b]
    e = se3_logs(invert(invert(true[a]) @ true[b]) @ T_a_b)
    A = adjoint(invert(T_a_b))
    At = np.swapaxes(A, 1, 2)
    C = A @ (published.covariance[a] + truth_noise) @ At + published.covariance[b] + truth_noise
    drift = published.drift[b] - published.drift[a]
    drift[:, :, 6:] *= not exact_camera
    # Twists before a pose, as those behind it.
    drift = adjoint(invert(published.T_odom_left[b])) @ drift
    steps, calibration = np.split(drift, [6], axis=2)
    C = C + steps @ np.swapaxes(adjoint(invert(published.T_odom_left[b])), 1, 2)
    return e, C + calibration @ np.swapaxes(calibration, 1, 2) + LEAST * np.eye(6)


def normalised(e: Array, C: Array) -> Array:
    """Return e^T C^-1 e (M,) of errors (M, D) and covariances (M, D, D)."""
    return np.asarray(np.einsum('mi,mi->m', e, np.linalg.solve(C, e[:, :, None])[:, :, 0]))


def summary(drive: str, window_s: float, e: Array, C: Array) -> Row:
    """Return the row of errors (M, 6) with their covariances (M, 6, 6)."""
    squared = normalised(e, C)
    sigmas = np.sqrt([np.trace(C[:, :3, :3], axis1=1, axis2=2),
                      np.trace(C[:, 3:, 3:], axis1=1, axis2=2)])  # fmt: skip
    figures = (
        np.mean(squared > LIMITS[3]),
        np.mean(squared > LIMITS[6]),
        np.median(normalised(e[:, :3], C[:, :3, :3])) / 3,
        np.median(normalised(e[:, 3:], C[:, 3:, 3:])) / 3,
        np.median(np.linalg.norm(e[:, :3], axis=1)),
        np.median(sigmas[0]),
        np.degrees(np.median(np.linalg.norm(e[:, 3:], axis=1))),
        np.degrees(np.median(sigmas[1])),
    )
    return Row(drive, window_s, len(e), *(round(float(value), 6) for value in figures))


def read_rows(file: Path) -> dict[tuple[str, float], Row]:
    """Return the rows of a file of --json."""
    rows = [Row(**fields) for fields in read_json(file, 'figures of tools.consistency')['rows']]
    return {row.key: row for row in rows}


def table_of(rows: Sequence[Row], before: dict[tuple[str, float], Row]) -> Table:
    """Return a line for each row; figures of before stand before arrows."""
    heads = (
        'windows', '> 3 σ %', '> 6 σ %', 'translation', 'rotation', 'error mm', 'σ mm', 'error °',
        'σ °',
    )  # fmt: skip
    table = figure_table('drive, window', *heads)
    for row in rows:
        then = _figures(before[row.key]) if row.key in before else [''] * len(heads)
        name = f'{row.drive}, {row.window_s:g} s'
        table.add_row(name, *map(arrow, then, _figures(row)))
    table.caption = (
        'of true covariances 0.27 % of the windows are beyond 3 σ and none beyond 6; translation, '
        'rotation: median of the normalised squared error per degree of freedom, '
        f'{MEDIAN_OF_3:.2f} where true; the others: medians of errors and of what is claimed'
    )
    return table


def _figures(row: Row) -> list[str]:
    return [
        str(row.windows),
        f'{100 * row.beyond_3:.1f}',
        f'{100 * row.beyond_6:.1f}',
        f'{row.translation:.2f}',
        f'{row.rotation:.2f}',
        f'{1000 * row.error_m:.1f}',
        f'{1000 * row.sigma_m:.1f}',
        f'{row.error_deg:.3f}',
        f'{row.sigma_deg:.3f}',
    ]


if __name__ == '__main__':
    run_command(consistency)
