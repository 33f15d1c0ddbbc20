"""Local bundle adjustment: keyframes and points move together until the features fit best.

Huber cost, minimised by Levenberg-Marquardt. One pose per stereo pair: the baseline is fixed.

Bundle adjustment of the whole map, after a loop was closed.

It is solved on a copy while tracking and mapping go on; what is mapped meanwhile moves along with
the keyframes it hangs on (Mur-Artal and Tardos, ORB-SLAM2, IEEE T-RO 2017, section III-C).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import Up
from segfloor_ros.core.geometry import Array, invert, make_transform, transform_points
from segfloor_ros.core.least_squares import SMALLEST, minimise
from segfloor_ros.core.slam.mapping.normal_equations import (
    Factors,
    Linearisation,
    System,
    cost,
    factors_of,
    loop_factors,
    normal_equations,
    with_factors,
)
from segfloor_ros.core.slam.rig import (
    LOCAL_KEYFRAMES,
    MIN_DEPTH_M,
    DisparityOffset,
    Observations,
    OffsetEstimate,
    huber_cost,
    huber_weights,
    residuals,
    squared_norms,
)
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, LoopEdge, SparseMap
from segfloor_ros.core.slam.thresholds import ENOUGH, NEARLY_ALL, POINTS_PER_KEYFRAME
from segfloor_ros.core.twists import se3_exp, without_drift

CONVERGED = 2e-3
"""Stop at this relative decrease of the cost; the next keyframe goes on from there."""

STEPS = 6
"""An adjustment mostly converges in three."""


@dataclass(frozen=True)
class BundleProblem:
    """A bundle adjustment problem.

    T_camera_world: (K, 4, 4), the first `num_free` of them move. points_world: (P, 3).
    Observation i (N in total) is of point `point[i]` in keyframe `keyframe[i]`; a pair occurs at
    most once. factors: what wheels and an accelerometer measured of keyframes. offset: of what the
    adjustment shows how far it is off, None where that is not wanted.
    """

    T_camera_world: Array
    num_free: int
    points_world: Array
    keyframe: NDArray[np.intp]
    point: NDArray[np.intp]
    observations: Observations
    factors: tuple[Factors, ...] = ()
    offset: DisparityOffset | None = None


@dataclass(frozen=True)
class BundleResult:
    """Adjusted poses (K, 4, 4) and points (P, 3), which observations (N,) fit, the cost before
    and after, and how far the offset of the disparities is off, where that was asked for.
    """

    T_camera_world: Array
    points_world: Array
    inliers: NDArray[np.bool_]
    cost_before: float
    cost_after: float
    offset: OffsetEstimate | None


def adjust(
    camera: StereoCamera,
    problem: BundleProblem,
    iterations: int = STEPS,
    is_wanted: Callable[[], bool] = lambda: True,
) -> BundleResult:
    """Minimise the Huber cost over free poses and points; damping by the gain ratio (Madsen et
    al., Methods for Non-Linear Least Squares Problems, 2004, algorithm 3.16). A point whose step
    leads through a camera that sees it waits: one that is far away would spoil the step of all. It
    ends early when the result is no longer wanted.
    """
    order = np.argsort(problem.keyframe, kind='stable')
    in_order = replace(
        problem,
        keyframe=problem.keyframe[order],
        point=problem.point[order],
        observations=problem.observations.take(order),
    )
    start = _State.at(camera, in_order)
    end = minimise(start, iterations, CONVERGED, is_wanted=is_wanted)
    adjusted = end.problem
    inliers = np.empty(len(order), bool)
    inliers[order] = end.front & (end.chi2 <= adjusted.observations.chi2_limit)
    poses, points = adjusted.T_camera_world, adjusted.points_world
    return BundleResult(poses, points, inliers, start.cost, end.cost, end.offset())


@dataclass(frozen=True)
class _State:
    """A problem on trial, with its residuals and cost. Observations are in the order of their
    keyframes.
    """

    camera: StereoCamera
    problem: BundleProblem
    points_camera: Array
    residual: Array
    chi2: Array
    front: NDArray[np.bool_]
    cost: float

    @staticmethod
    def at(camera: StereoCamera, problem: BundleProblem) -> _State:
        """Evaluate a problem."""
        points = problem.points_world[problem.point]
        starts = np.searchsorted(problem.keyframe, np.arange(len(problem.T_camera_world) + 1))
        for k, T in enumerate(problem.T_camera_world):
            mine = slice(starts[k], starts[k + 1])
            points[mine] = transform_points(T, points[mine])
        front = points[:, 2] > MIN_DEPTH_M
        points[:, 2] = np.maximum(points[:, 2], MIN_DEPTH_M)
        residual = residuals(camera, points, problem.observations)
        chi2 = squared_norms(residual, problem.observations.information)
        total = huber_cost(chi2, problem.observations.chi2_limit)
        total += sum(cost(factors, problem.T_camera_world) for factors in problem.factors)
        return _State(camera, problem, points, residual, chi2, front, total)

    def linearised(self) -> Callable[[float], tuple[_State, float]]:
        """Return what solves the normal equations for a damping."""
        problem, system = self.problem, self._system(self.problem.num_free, None)

        def stepped(damping: float) -> tuple[_State, float]:
            step = system.solve(damping)
            poses = problem.T_camera_world.copy()
            poses[: problem.num_free] = se3_exp(step.twists) @ poses[: problem.num_free]
            candidate = replace(
                problem, T_camera_world=poses, points_world=problem.points_world + step.shifts
            )
            trial = _State.at(self.camera, candidate)
            through = problem.point[self.front & ~trial.front]
            if len(through):
                candidate.points_world[through] = problem.points_world[through]
                trial = _State.at(self.camera, candidate)
            predicted = system.predicted_decrease(step, damping)
            gain = (self.cost - trial.cost) / max(predicted, SMALLEST)
            return trial, max(1 / 3, 1 - (2 * gain - 1) ** 3)

        return stepped

    def offset(self) -> OffsetEstimate | None:
        """Return how far the offset of the disparities is off. All keyframes are free for it: those
        that held the others were placed by earlier disparities, with the same error; were they
        taken for true, each adjustment would confirm those before.
        """
        free, asked = len(self.problem.T_camera_world) - 1, self.problem.offset
        return None if asked is None else self._system(free, asked).solve(0.0).offset

    def _system(self, num_free: int, offset: DisparityOffset | None) -> System:
        problem, observations = self.problem, self.problem.observations
        robust = huber_weights(self.chi2, observations.chi2_limit) * self.front
        weight = observations.information * robust[:, None]
        parts = offset.parts_of(observations.uvd_px).T if offset else np.zeros((0, len(weight)))
        at = Linearisation(
            problem.T_camera_world, num_free, len(problem.points_world), problem.keyframe,
            problem.point, self.points_camera, self.residual, weight, parts,
        )  # fmt: skip
        system = normal_equations(self.camera, at)
        return with_factors(system, problem.T_camera_world, problem.factors)


UNMOVED_M = 1e-6
"""What rounding may move a point by, in a keyframe that has been moved."""


@dataclass(frozen=True)
class MapCopy:
    """The map as it was. T_camera_world: (K, 4, 4), and first_poses, as they came into the map.
    xyz_world, stable_ids: (P,). point, keyframe, row: (N,) observations. features: (K,) of the
    keyframes as measured.
    """

    T_camera_world: Array
    first_poses: list[Array]
    xyz_world: Array
    stable_ids: NDArray[np.int32]
    observer_count: NDArray[np.int32]
    point: NDArray[np.int32]
    keyframe: NDArray[np.int32]
    row: NDArray[np.int32]
    features: list[Observations]
    records: list[KeyframeRecord]
    loops: list[LoopEdge]
    offset: DisparityOffset
    up_world: Up | None


@dataclass(frozen=True)
class GlobalResult:
    """An adjusted copy. chosen: (K,) indices of its keyframes, those that move first. ids,
    stable_ids: (P,) of its points.
    """

    planned: BundleProblem
    adjusted: BundleResult
    chosen: NDArray[np.intp]
    ids: NDArray[np.integer]
    stable_ids: NDArray[np.int32]


def copy_map(sparse_map: SparseMap, up_world: Up | None) -> MapCopy:
    """Copy what an adjustment needs out of the map: little time between two frames."""
    keyframes = list(sparse_map.keyframes)
    return MapCopy(
        np.stack([k.T_camera_world for k in keyframes]),
        list(sparse_map.first_poses),
        sparse_map.xyz_world.copy(),
        sparse_map.stable_id.copy(),
        sparse_map.observer_count.copy(),
        *sparse_map.edges.to(sparse_map.alive),
        [k.observations for k in keyframes],
        keyframes,
        list(sparse_map.loops),
        copy(sparse_map.rig.offset),
        up_world,
    )


def solve_global(
    camera: StereoCamera, copied: MapCopy, is_wanted: Callable[[], bool]
) -> GlobalResult | None:
    """Adjust the copy; safe on another thread. It ends early when it is no longer wanted. None for
    a map of one view. What was seen says nothing of where the map as a whole is: it stays where its
    first ten keyframes that take part came into it, on average, weighted by what they show.
    """
    keyframe, point, row = _known_best(copied)
    count = np.bincount(keyframe, minlength=len(copied.records))
    enough = count >= ENOUGH
    # The one that is held is where all others begin: not one of which little is known.
    early = np.flatnonzero(enough)[:LOCAL_KEYFRAMES]
    held = int(np.argmax(count >= NEARLY_ALL * count[early].max(initial=0)))
    enough[held] = True
    kept = enough[keyframe]
    kept &= np.bincount(point[kept], minlength=len(copied.stable_ids))[point] > 1
    keyframe, point, row = keyframe[kept], point[kept], row[kept]
    ids = np.unique(point)
    free = np.setdiff1d(np.flatnonzero(enough), held)
    if len(ids) == 0 or len(free) == 0:
        return None
    chosen = np.append(free, held)
    slot = np.full(len(enough), -1)
    slot[chosen] = np.arange(len(chosen))
    problem = BundleProblem(
        copied.T_camera_world[chosen],
        len(free),
        copied.xyz_world[ids],
        slot[keyframe],
        np.searchsorted(ids, point),
        gather(copied.features, keyframe, row).without_offset(copied.offset),
        factors_of(copied.records, slot, copied.up_world) + loop_factors(copied.loops, slot),
    )
    adjusted = adjust(camera, problem, is_wanted=is_wanted)
    T_before = np.stack([copied.first_poses[k] for k in early])
    shown = count[early].astype(np.float64)
    M = _brought_back(adjusted.T_camera_world[slot[early]], T_before, shown, copied.up_world)
    adjusted = replace(
        adjusted,
        T_camera_world=adjusted.T_camera_world @ invert(M),
        points_world=transform_points(M, adjusted.points_world),
    )
    return GlobalResult(problem, adjusted, chosen, ids, copied.stable_ids[ids])


def _brought_back(T_after: Array, T_before: Array, weights: Array, up_world: Up | None) -> Array:
    """Return the motion (4, 4) of the world that brings cameras (N, 4, 4) back to where they were,
    on average; where up is known, it turns about that alone.
    """
    world_after, world_before = invert(T_after), invert(T_before)
    turns = Rotation.from_matrix(world_before[:, :3, :3] @ T_after[:, :3, :3])
    turn = turns.mean(weights).as_rotvec()
    if up_world is not None:
        turn = turn @ up_world.direction * up_world.direction
    R = Rotation.from_rotvec(turn).as_matrix()
    off_m = world_before[:, :3, 3] - world_after[:, :3, 3] @ R.T
    return make_transform(R, np.average(off_m, axis=0, weights=weights))


def _known_best(copied: MapCopy) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Return the observations, keyframe by keyframe, of points that are among those of some
    keyframe that most others see.
    """
    order = np.lexsort((copied.point, -copied.observer_count[copied.point], copied.keyframe))
    keyframe, point, row = copied.keyframe[order], copied.point[order], copied.row[order]
    rank = np.arange(len(keyframe)) - np.searchsorted(keyframe, keyframe)
    known = np.zeros(len(copied.stable_ids), bool)
    known[point[rank < POINTS_PER_KEYFRAME]] = True
    chosen = (known & (copied.observer_count > 1))[point]
    return keyframe[chosen], point[chosen], row[chosen]


def gather(
    observations: Sequence[Observations], keyframe: NDArray[np.int32], row: NDArray[np.int32]
) -> Observations:
    """Return the observations (N,) of features `row` (N,) of keyframes (N,), of which each has
    observations.
    """
    uvd, sigma = np.empty((len(row), 3)), np.empty((len(row), 3))
    order = np.argsort(keyframe, kind='stable')
    for mine in np.split(order, np.flatnonzero(np.diff(keyframe[order])) + 1):
        if len(mine):
            seen = observations[keyframe[mine[0]]]
            uvd[mine], sigma[mine] = seen.uvd_px[row[mine]], seen.sigma_px[row[mine]]
    return Observations(uvd, sigma)


def apply_global(sparse_map: SparseMap, result: GlobalResult | None) -> None:
    """Bring an adjusted copy into the map, which may have grown and moved since. A point goes to
    where it was adjusted to in the last keyframe that saw it, unless it has moved there since.
    """
    if result is None or not result.adjusted.cost_after < result.adjusted.cost_before:
        return
    planned, adjusted, ids = result.planned, result.adjusted, result.ids
    correction = invert(planned.T_camera_world) @ adjusted.T_camera_world
    order = np.argsort(result.chosen)
    holder = np.searchsorted(
        result.chosen[order], np.arange(len(sparse_map.keyframes)), side='right'
    )
    in_order = np.argsort(result.chosen[planned.keyframe], kind='stable')
    seen_by: NDArray[np.intp] = np.zeros(len(ids), np.intp)
    seen_by[planned.point[in_order]] = planned.keyframe[in_order]
    now = np.stack([k.T_camera_world for k in sparse_map.keyframes])
    same = sparse_map.alive[ids] & (sparse_map.stable_id[ids] == result.stable_ids)
    before = _each(planned.T_camera_world[seen_by], planned.points_world)
    here = _each(now[result.chosen[seen_by]], sparse_map.xyz_world[ids])
    same &= np.abs(here - before).max(axis=1, initial=0.0) < UNMOVED_M
    move_keyframes(sparse_map, now @ correction[order[np.maximum(holder - 1, 0)]])
    T_world_camera = np.stack([sparse_map.keyframes[k].T_world_camera for k in result.chosen])
    here = _each(adjusted.T_camera_world[seen_by], adjusted.points_world)
    sparse_map.xyz_world[ids[same]] = _each(T_world_camera[seen_by], here)[same]


def _each(T: Array, points: Array) -> Array:
    """Return points (N, 3), each carried by a transform of its own (N, 4, 4)."""
    return np.asarray((T[:, :3, :3] @ points[:, :, None])[:, :, 0] + T[:, :3, 3])


def move_keyframes(sparse_map: SparseMap, T_camera_world: Array) -> None:
    """Move keyframes to poses (K, 4, 4); every point goes along with the last one that sees it."""
    T_camera_world = without_drift(T_camera_world)
    point, keyframe, _ = sparse_map.edges.to(sparse_map.alive)
    last: NDArray[np.intp] = np.zeros(len(sparse_map.alive), np.intp)
    last[point] = keyframe
    before = np.stack([k.T_camera_world for k in sparse_map.keyframes])
    motion = (invert(T_camera_world) @ before)[last]
    sparse_map.xyz_world[:] = _each(motion, sparse_map.xyz_world)
    direction = sparse_map.viewing_direction
    direction[:] = (motion[:, :3, :3] @ direction[:, :, None])[:, :, 0]
    for record, pose in zip(sparse_map.keyframes, T_camera_world, strict=True):
        record.T_camera_world = pose.copy()  # not a part of an array of all
    sparse_map.follow()
