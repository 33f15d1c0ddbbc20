"""The error of an estimated trajectory against the true one, computed by evo, and its picture."""

from __future__ import annotations

import io
import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from evo.core import metrics, sync
from evo.core.filters import FilterException
from evo.core.trajectory import PoseTrajectory3D
from scipy.spatial.transform import Rotation

from segfloor_ros.apps.recordings.calibration_files import read_body_pose
from segfloor_ros.apps.recordings.image_folders import TUM_TOLERANCE_S
from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.whole import number, read_json, read_lines, whole_nanoseconds
from segfloor_ros.core.files.writing import MARK, PLOTS, check_output, marked_png, write_output
from segfloor_ros.core.geometry import Array, invert, make_transform

STEP_M = 1.0
"""Of path: errors are those of such steps, and the first one of a plot says what is ahead."""

MIN_MATCHES = 3

OTHER_AXES = 0.3
"""Radians: axes that are turned by more are others, not those of a path that drifts; and the share
of a step by which motions may differ in axes that are the same."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrajectoryScore:
    """ATE: RMSE and maximum of the distances after the best rigid alignment (no scale). RPE: RMSE
    of the motion over one metre (per metre where frames are further apart), NaN for shorter paths.
    end_error_m: distance at the last common pose when the first common poses are laid on each
    other. tracked: share of the true poses that have an estimate. path_length_m,
    estimate_length_m: of the true and the estimated path, the sum of its steps between the common
    poses.
    """

    tracked: float
    matched: int
    frames: int
    path_length_m: float
    estimate_length_m: float
    ate_rmse_m: float
    ate_max_m: float
    rpe_translation_m: float
    rpe_rotation_rad: float
    end_error_m: float


@dataclass(frozen=True)
class MatchedTrajectories:
    """Poses (N, 4, 4) at common times (N,) in seconds, the estimate as it came and laid on the
    truth, and the number of frames there should be.
    """

    times_s: Array
    truth: Array
    estimate: Array
    aligned: Array
    frames: int


def match_files(estimate: Path, truth: Path, frames: int | None = None) -> MatchedTrajectories:
    """Read two trajectories and match them by time. frames: how many the recording has; without
    it, as summary.json of a run says, or one per true pose, or fewer where the truth is denser
    than the estimate.

    A folder stands for its camera_trajectory.txt (a run) or poses.txt (a recording). Raises
    InputError when fewer than three poses match.
    """
    estimate_file = _file_in(estimate, 'camera_trajectory.txt')
    truth_file = _file_in(truth, 'poses.txt')
    estimated, true = read_trajectory(estimate_file), read_truth(truth_file)
    frames = frames or _frames_of_run(estimate) or _expected_frames(estimated[0], true[0])
    return match(estimated, true, frames)


def read_truth(path: Path) -> tuple[Array, Array]:
    """Return times (N,) in seconds and poses (N, 4, 4) of a true path: a TUM or KITTI file, or the
    data.csv of an EuRoC folder, whose body is brought to the left camera. Raises InputError.
    """
    if path.suffix != '.csv':
        return read_trajectory(path)
    times_s, poses = [], []
    for where, line in read_lines(path):
        stamp, *words = (word.strip() for word in line.split(','))
        try:
            x, y, z, qw, *q_xyz = (number(word) for word in words[:7])
            rotation = Rotation.from_quat([*q_xyz, qw]).as_matrix()
            times_s.append(whole_nanoseconds(stamp) / 1e9)
        except ValueError as error:
            raise InputError(f'{where}: expected ns, x, y, z, qw, qx, qy, qz ({error})') from None
        poses.append(make_transform(rotation, np.array([x, y, z])))
    T_body_left = read_body_pose(path.parents[1] / 'cam0' / 'sensor.yaml')
    return np.array(times_s), np.array(poses).reshape(-1, 4, 4) @ T_body_left


def match(
    estimated: tuple[Array, Array], true: tuple[Array, Array], frames: int
) -> MatchedTrajectories:
    """Match two trajectories (times (N,), poses (N, 4, 4)) by time and align them rigidly."""
    evo_truth, evo_estimate = (
        PoseTrajectory3D(poses_se3=list(poses), timestamps=times)
        for times, poses in (true, estimated)
    )
    try:
        evo_truth, evo_estimate = sync.associate_trajectories(
            evo_truth, evo_estimate, max_diff=TUM_TOLERANCE_S
        )
    except sync.SyncException:
        evo_truth.reduce_to_ids([])
    if evo_truth.num_poses < MIN_MATCHES:
        raise InputError(
            f'only {evo_truth.num_poses} poses of the two trajectories are within '
            f'{TUM_TOLERANCE_S} s of each other: are both of the same recording?'
        )
    matched_truth, matched_estimate = (
        np.array(evo_truth.poses_se3),
        np.array(evo_estimate.poses_se3),
    )
    R_truth_estimate = axes_between(matched_truth, matched_estimate)
    if R_truth_estimate is not None:
        turn_deg = np.degrees(Rotation.from_matrix(R_truth_estimate).magnitude())
        logger.warning(
            'the axes of the estimate are turned by %.0f degrees against those of the truth, as '
            'optical axes are against those of a base; both are evaluated in those of the truth',
            turn_deg,
        )
        matched_estimate[:, :3, :3] = matched_estimate[:, :3, :3] @ R_truth_estimate.T
    T_truth_estimate = rigid_alignment(matched_estimate[:, :3, 3], matched_truth[:, :3, 3])
    return MatchedTrajectories(
        np.asarray(evo_truth.timestamps),
        matched_truth,
        matched_estimate,
        T_truth_estimate @ matched_estimate,
        frames,
    )


def axes_between(truth: Array, estimate: Array) -> Array | None:
    """Return the rotation (3, 3) from the axes of an estimate (N, 4, 4) to those of the truth
    (N, 4, 4), by what both say of the same motions in their own axes; None where they are the same
    or it is not clear.
    """
    along_m = np.concatenate([[0.0], np.cumsum(_steps_m(truth))])
    step_m = min(STEP_M, along_m[-1] / 4)
    last = np.searchsorted(along_m, along_m + step_m)
    first = np.flatnonzero(last < len(along_m))
    if step_m <= 0 or len(first) < MIN_MATCHES:
        return None
    motions = (invert(poses[first]) @ poses[last[first]] for poses in (truth, estimate))
    true, estimated = (
        np.concatenate([m[:, :3, 3], Rotation.from_matrix(m[:, :3, :3]).as_rotvec()])
        for m in motions
    )
    U, _, Vt = np.linalg.svd(true.T @ estimated)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    as_they_are, turned = (
        float(np.median(np.linalg.norm(true - one, axis=1)[: len(first)]))
        for one in (estimated, estimated @ R.T)
    )
    is_clear = turned < min(as_they_are / 2, step_m * OTHER_AXES)
    # Ahead is x in those of a base, and across x, which is to the right, in optical ones.
    ahead = (np.abs(one[: len(first)].mean(axis=0)) for one in (true, estimated))
    least, most = sorted(float(one[0] / max(np.linalg.norm(one), 1e-9)) for one in ahead)
    are_optical = least < np.sin(OTHER_AXES) and most > np.cos(OTHER_AXES)
    return R if is_clear and are_optical else None


def _steps_m(poses: Array) -> Array:
    steps_m: Array = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return steps_m


def rigid_alignment(points_a: Array, points_b: Array) -> Array:
    """Return the `T_b_a` (4, 4) that brings points (N, 3) nearest to others (N, 3) in the sense of
    least squares. On a straight path, where the roll about it is free, it is one of the best.

    Umeyama, Least-squares estimation of transformation parameters, PAMI 1991, eq. 40-41, no scale.
    """
    mean_a, mean_b = points_a.mean(axis=0), points_b.mean(axis=0)
    U, _, Vt = np.linalg.svd((points_b - mean_b).T @ (points_a - mean_a))
    handedness = np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)])
    rotation = U @ handedness @ Vt
    return make_transform(rotation, mean_b - rotation @ mean_a)


def score_trajectory(matched: MatchedTrajectories) -> TrajectoryScore:
    """Score matched trajectories."""
    distances = np.linalg.norm(matched.aligned[:, :3, 3] - matched.truth[:, :3, 3], axis=1)
    ate = _statistics(metrics.APE(metrics.PoseRelation.translation_part), matched)
    count = len(matched.truth)
    return TrajectoryScore(
        tracked=min(1.0, count / matched.frames),
        matched=count,
        frames=matched.frames,
        path_length_m=_path_length(matched.truth),
        estimate_length_m=_path_length(matched.estimate),
        ate_rmse_m=ate,
        ate_max_m=float(distances.max()),
        rpe_translation_m=_relative(metrics.PoseRelation.translation_part, matched),
        rpe_rotation_rad=_relative(metrics.PoseRelation.rotation_angle_rad, matched),
        end_error_m=_end_error(matched),
    )


def _relative(relation: metrics.PoseRelation, matched: MatchedTrajectories) -> float:
    metric = metrics.RPE(relation, STEP_M, metrics.Unit.meters, all_pairs=True)
    try:
        return _statistics(metric, matched)
    except (metrics.MetricsException, FilterException):
        return _relative_of_sparse(relation, matched)


def _relative_of_sparse(relation: metrics.PoseRelation, matched: MatchedTrajectories) -> float:
    """Return the error per metre over pairs of frames: each one and the first that is at least
    `STEP_M` further along the path.
    """
    along_m = np.concatenate([[0.0], np.cumsum(_steps_m(matched.truth))])
    last = np.searchsorted(along_m, along_m + STEP_M - 1e-9)
    first = np.flatnonzero(last < len(along_m))
    if len(first) == 0:
        return float('nan')
    last = last[first]
    true, estimated = (
        invert(poses[first]) @ poses[last] for poses in (matched.truth, matched.aligned)
    )
    error = invert(true) @ estimated
    if relation == metrics.PoseRelation.translation_part:
        size = np.linalg.norm(error[:, :3, 3], axis=1)
    else:
        size = Rotation.from_matrix(error[:, :3, :3]).magnitude()
    return float(np.sqrt(np.mean((size / (along_m[last] - along_m[first])) ** 2)))


def _statistics(metric: metrics.PE, matched: MatchedTrajectories) -> float:
    pair = tuple(
        PoseTrajectory3D(poses_se3=list(poses), timestamps=matched.times_s)
        for poses in (matched.truth, matched.aligned)
    )
    metric.process_data(pair)
    return float(metric.get_statistic(metrics.StatisticsType.rmse))


def _end_error(matched: MatchedTrajectories) -> float:
    ends = [invert(poses[0]) @ poses[-1] for poses in (matched.truth, matched.estimate)]
    return float(np.linalg.norm(ends[0][:3, 3] - ends[1][:3, 3]))


def _path_length(poses: Array) -> float:
    return float(_steps_m(poses).sum())


def _expected_frames(estimated_s: Array, true_s: Array) -> int:
    if len(estimated_s) < 2 or len(true_s) < 2:
        return len(true_s)
    period_s = float(np.median(np.diff(estimated_s)))
    if float(np.median(np.diff(true_s))) > 0.75 * period_s:
        return len(true_s)
    return round(float(true_s[-1] - true_s[0]) / period_s) + 1


def _frames_of_run(folder: Path) -> int:
    """Return how many frames a run had by its summary.json, 0 where there is none."""
    path = folder / 'summary.json'
    if not path.is_file():
        return 0
    frames = read_json(path, 'the summary of a run').get('frames')
    if type(frames) is not int or not 0 < frames < 1 << 32:
        raise InputError(f'{path}: does not say how many frames there were')
    return frames


def _file_in(path: Path, name: str) -> Path:
    return path / name if path.is_dir() else path


def check_plot(path: Path, inputs: Iterable[Path | str | None] = ()) -> None:
    """Raise InputError unless a plot can be written to a file: a PNG, SVG or PDF."""
    suffix = path.suffix.lower() or '.png'
    if suffix not in PLOTS:
        raise InputError(f'--plot {path}: a plot is a file {", ".join(PLOTS)}')
    check_output(path, PLOTS[suffix], inputs, '--plot')


def save_trajectory_plot(estimates: Mapping[str, MatchedTrajectories], path: Path) -> None:
    """Write a plot of estimated paths, by name, on the true one from above, and of their errors
    over time. Raises InputError.

    Paths are drawn on the plane in which the true path extends most, its first stretch to the
    right; the true path is the longest that an estimate has poses of.
    """
    # Imported here: Matplotlib takes a second that scores should not wait for.
    from matplotlib.figure import Figure

    longest = max(estimates.values(), key=lambda one: len(one.truth))
    truth, start_s = longest.truth[:, :3, 3], min(m.times_s[0] for m in estimates.values())
    axes = plane_axes(truth)
    figure = Figure(figsize=(11, 5), layout='constrained')
    above, error = figure.subplots(1, 2)
    above.plot(*((truth - truth[0]) @ axes.T).T, 'k--', label='truth')
    for place, (name, matched) in enumerate(estimates.items()):
        is_alone = len(estimates) == 1
        aligned = matched.aligned[:, :3, 3]
        distances_cm = 100 * np.linalg.norm(aligned - matched.truth[:, :3, 3], axis=1)
        label = 'estimate, aligned' if is_alone else name
        colours = ('tab:blue', 'tab:red') if is_alone else (f'C{place}',) * 2
        above.plot(*((aligned - truth[0]) @ axes.T).T, color=colours[0], label=label)
        error.plot(matched.times_s - start_s, distances_cm, color=colours[1], label=label)
    above.plot(0, 0, 'ko', label='start')
    above.set(xlabel='ahead of the start [m]', ylabel='to its left [m]')
    above.set_aspect('equal', adjustable='datalim')
    above.legend()
    above.grid(alpha=0.3)
    error.set(xlabel='time [s]', ylabel='position error [cm]', ylim=(0, None))
    error.grid(alpha=0.3)
    picture = io.BytesIO()
    suffix = path.suffix.lower() or '.png'
    about = None if suffix == '.png' else {'Creator': MARK}
    figure.savefig(picture, dpi=110, format=suffix[1:], metadata=about)
    content = picture.getvalue()
    write_output(path, PLOTS[suffix], marked_png(content) if suffix == '.png' else content)


def plane_axes(path: Array) -> Array:
    """Return the axes ahead and to the left (2, 3) of the start of a path (N, 3), in the plane in
    which it extends most. Up is +z or, in optical frames, -y.
    """
    up = np.linalg.svd(path - path.mean(axis=0), full_matrices=True)[2][2]
    largest = int(np.argmax(np.abs(up)))
    up = up * np.sign(up[largest]) * (-1 if largest == 1 else 1)
    moved = np.linalg.norm(path - path[0], axis=1)
    ahead = path[int(np.argmax(moved >= min(STEP_M, moved.max() / 2)))] - path[0]
    ahead = ahead - (ahead @ up) * up
    length = float(np.linalg.norm(ahead))
    if length == 0:
        return np.eye(3)[:2]
    return np.array([ahead / length, np.cross(up, ahead / length)])
