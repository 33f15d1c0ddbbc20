"""The normal equations of a bundle adjustment, and their solution by the Schur complement on the
cameras (Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000, section 6.1).

The last axis of the arrays here is the observation or the point: NumPy works on long rows many
times faster than on many small matrices.

Most keyframes share no point: the complement is a sparse matrix (Konolige, Sparse Sparse Bundle
Adjustment, BMVC 2010). Its factor fills up as the map grows, so a large map is solved by conjugate
gradients, without the complement itself (Agarwal et al., Bundle Adjustment in the Large, ECCV
2010). They are slow to bend a long path as a whole; that is solved beside, on stretches of the path
that move rigidly (a two-level preconditioner: Nicolaides, Deflation of Conjugate Gradients, 1987).

What wheels and an accelerometer measure of keyframes is added. With e = log(T_now T_before^-1 Z^-1)
for a measured motion Z, twists of both poses change it, to first order, by d_now - Ad(T_now
T_before^-1) d_before (Barfoot 2017, section 8.3.2). With e = u x z for up in the camera as its pose
has it, u, and as it was measured, z, a turn d of the pose changes it by (d x u) x z. The cost is
Huber's: wheels that slip lie by much more than they are taken to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.linalg import splu

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import RelativeMotion, Up
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.least_squares import SMALLEST
from segfloor_ros.core.slam.rig import (
    LOCAL_KEYFRAMES,
    OffsetEstimate,
    chi2_limit,
    huber_cost,
    huber_weights,
    weighted_jacobian,
    with_moment,
)
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, LoopEdge
from segfloor_ros.core.slam.tracking.motion import joined_motion
from segfloor_ros.core.twists import adjoint, se3_logs

MANY, LEFT = 300, 0.01
"""From so many cameras on, gradients are faster than a factor; they end where less than this share
of what they began with is left: the next step begins where the cost is another one."""

FLOOR_SIGMA = np.array([1e-3] * 3 + [1e-4] * 3)
"""No motion is measured better: the base shakes on its way."""


@dataclass(frozen=True)
class Step:
    """A solution: twists (K, 6) of the cameras, shifts (P, 3) of the points, and the offset of all
    disparities that it leaves, in the parts that were asked for.
    """

    twists: Array
    shifts: Array
    offset: OffsetEstimate


@dataclass(frozen=True)
class System:
    """The normal equations by blocks: cameras U (K, 6, 6), points V (3, 3, P), and W (6, 3, M) of
    each pair (keyframe, point[m]) that an observation ties together, those of camera k from
    starts[k] to starts[k + 1]; right-hand sides. shared: of the offset of all disparities, in S = 0
    or 3 parts, the products with cameras (K, 6, S), points (S, 3, P), themselves. between: two
    cameras and the block (6, 6) that ties them without points. adjoints (K, 6, 6): of the poses of
    the cameras.
    """

    U: Array
    V: Array
    W: Array
    starts: NDArray[np.intp]
    point: NDArray[np.intp]
    camera_rhs: Array
    point_rhs: Array
    shared_camera: Array
    shared_point: Array
    shared_shared: Array
    shared_rhs: Array
    adjoints: Array
    between: tuple[tuple[int, int, Array], ...] = ()

    def solve(self, damping: float) -> Step:
        """Solve the damped system by the Schur complement on the cameras, which is sparse: most
        keyframes of a large map share no point.

        With V = L L^T by blocks and Y = W L^-T, the complement is U - Y Y^T.

        What the disparities share is not moved by the step, but shown.
        """
        diagonal = np.einsum('aap->ap', self.V)
        L_inverse = inverse_cholesky(self.V + np.eye(3)[:, :, None] * (damping * diagonal + 1e-9))
        diagonal = np.einsum('kaa->ka', self.U)
        U = self.U + np.eye(6) * (damping * diagonal + 1e-9)[:, None]
        y = [_times_lower(L_inverse, v) for v in (self.point_rhs, *self.shared_point)]
        complement = Complement(
            U,
            np.ascontiguousarray(self._blocks(L_inverse).transpose(2, 0, 1)),
            self.starts,
            self.point,
            self.V.shape[2],
            self.between,
        )
        of_points = np.stack(y, axis=-1).swapaxes(0, 1).reshape(-1, len(y))
        of_cameras = np.concatenate([self.camera_rhs[:, :, None], self.shared_camera], axis=2)
        rhs = of_cameras.reshape(-1, len(y)) - complement.Y @ of_points
        x = complement.solve(rhs, self.adjoints)
        back = (of_points[:, 0] - complement.Y.T @ x[:, 0]).reshape(-1, 3)
        shifts = np.einsum('bap,pb->pa', L_inverse, back)
        taken = (of_points.T @ of_points + rhs.T @ x)[1:]
        information = self.shared_shared - taken[:, 1:] + SMALLEST * np.eye(len(taken))
        offset_px = np.linalg.solve(information, self.shared_rhs - taken[:, 0])
        return Step(x[:, 0].reshape(-1, 6), shifts, OffsetEstimate(offset_px, information))

    def _blocks(self, L_inverse: Array) -> Array:
        """Return the blocks (6, 3, M) of Y."""
        of_observation = L_inverse[:, :, self.point]
        blocks = _times_lower(of_observation[:, :, None], np.swapaxes(self.W, 0, 1))
        return np.swapaxes(blocks, 0, 1)

    def predicted_decrease(self, step: Step, damping: float) -> float:
        """Return how much the cost falls by the quadratic model."""
        diagonal_U = np.einsum('kaa->ka', self.U)
        diagonal_V = np.einsum('aap->pa', self.V)
        return float(
            (step.twists * (damping * diagonal_U * step.twists + self.camera_rhs)).sum()
            + (step.shifts * (damping * diagonal_V * step.shifts + self.point_rhs.T)).sum()
        )


def inverse_cholesky(A: Array) -> Array:
    """Return the inverses (3, 3, N) of the lower Cholesky factors of symmetric positive matrices
    (3, 3, N).
    """
    inverse = np.zeros_like(A)
    a = 1.0 / np.sqrt(np.maximum(A[0, 0], SMALLEST))
    l10, l20 = A[1, 0] * a, A[2, 0] * a
    b = 1.0 / np.sqrt(np.maximum(A[1, 1] - l10**2, SMALLEST))
    l21 = (A[2, 1] - l20 * l10) * b
    c = 1.0 / np.sqrt(np.maximum(A[2, 2] - l20**2 - l21**2, SMALLEST))
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = a, b, c
    inverse[1, 0] = -l10 * a * b
    inverse[2, 1] = -l21 * b * c
    inverse[2, 0] = (l21 * l10 * b - l20) * a * c
    return inverse


def _times_lower(L: Array, v: Array) -> Array:
    """Return the products (3, ...) of lower triangular matrices (3, 3, ...) and v (3, ...)."""
    return np.stack(
        [
            L[0, 0] * v[0],
            L[1, 0] * v[0] + L[1, 1] * v[1],
            L[2, 0] * v[0] + L[2, 1] * v[1] + L[2, 2] * v[2],
        ]
    )


@dataclass(frozen=True)
class Linearisation:
    """Where the cost is made quadratic. T_camera_world: (K, 4, 4), the first `num_free` move.
    keyframe, point: (N,) of each observation, the keyframes ascending. points_camera, residual,
    weight: (N, 3). offset_parts: (S, N), see `DisparityOffset`, S = 0 where it is not wanted.
    """

    T_camera_world: Array
    num_free: int
    num_points: int
    keyframe: NDArray[np.intp]
    point: NDArray[np.intp]
    points_camera: Array
    residual: Array
    weight: Array
    offset_parts: Array


def normal_equations(camera: StereoCamera, at: Linearisation) -> System:
    """Return the undamped system.

    In camera axes an observation adds M = J^T W J and g = J^T W r with the sparse J = d(u, v, d) /
    d(point); everything else is these, turned into world axes by A = M R, and moved to the camera's
    twist by (I, p x) (Barfoot 2017, eq. 7.183).
    """
    J, M, vectors = _in_camera_axes(camera, at)
    starts = np.searchsorted(at.keyframe, np.arange(len(at.T_camera_world) + 1))
    A, V, in_world = np.empty_like(M), np.empty_like(M), np.empty_like(vectors)
    for k, T in enumerate(at.T_camera_world):
        mine, R = slice(starts[k], starts[k + 1]), T[:3, :3]
        A[:, :, mine] = R.T @ M[:, :, mine]
        V[:, :, mine] = R.T @ np.swapaxes(A[:, :, mine], 0, 1)
        in_world[:, :, mine] = R.T @ vectors[:, :, mine]
    edges, free = starts[: at.num_free + 1], slice(0, starts[at.num_free])
    p = at.points_camera[free].T
    J = with_moment(p, J[:, :, free])
    U = [J[..., a:b].reshape(6, -1) for a, b in pairwise(edges)]
    moments = with_moment(p, np.swapaxes(vectors[:, :, free], 0, 1))
    of_camera = np.stack([moments[..., a:b].sum(axis=-1) for a, b in pairwise(edges)])
    of_point = _sum_by(at.point, in_world, at.num_points)
    return System(
        np.stack([J_k @ J_k.T for J_k in U]),
        _sum_by(at.point, V, at.num_points),
        with_moment(p, A[:, :, free]),
        edges,
        at.point[free],
        -of_camera[:, :, 0],
        -of_point[0],
        of_camera[:, :, 1:],
        of_point[1:],
        (at.offset_parts * at.weight[:, 2]) @ at.offset_parts.T,
        -at.offset_parts @ (at.weight[:, 2] * at.residual[:, 2]),
        adjoint(at.T_camera_world[: at.num_free]),
    )


def _in_camera_axes(camera: StereoCamera, at: Linearisation) -> tuple[Array, Array, Array]:
    """Return with J = d(u, v, d) / d(point): J^T W^0.5 (3, 3, N), J^T W J (3, 3, N), J^T W of the
    residuals and of what the offset changes (1 + S, 3, N).
    """
    root = np.sqrt(at.weight.T)
    J = weighted_jacobian(camera, at.points_camera, root)
    M = np.zeros_like(J)
    M[0, 0], M[1, 1] = J[0, 0] ** 2, J[1, 1] ** 2
    M[0, 2] = M[2, 0] = J[0, 0] * J[2, 0]
    M[1, 2] = M[2, 1] = J[1, 1] * J[2, 1]
    M[2, 2] = J[2, 0] ** 2 + J[2, 1] ** 2 + J[2, 2] ** 2
    ru, rv, rd = at.residual.T * root
    vectors = np.zeros((1 + len(at.offset_parts), *J.shape[1:]))
    vectors[0] = J[0, 0] * ru, J[1, 1] * rv, J[2, 0] * ru + J[2, 1] * rv + J[2, 2] * rd
    vectors[1:, 2] = at.offset_parts * root[2] * J[2, 2]
    return J, M, vectors


def _sum_by(index: NDArray[np.intp], values: Array, size: int) -> Array:
    """Sum values (..., N) into `size` groups (..., size)."""
    flat = values.reshape(-1, len(index))
    sums = np.stack([np.bincount(index, row, size) for row in flat])
    return np.asarray(sums.reshape(*values.shape[:-1], size), np.float64)


class Complement:
    """The complement U - Y Y^T of cameras.

    U: (K, 6, 6), Y: (M, 6, 3) by blocks, those of camera k from starts[k] to starts[k + 1], point:
    (M,) their columns, of num_points. between: further blocks off the diagonal.
    """

    def __init__(
        self,
        U: Array,
        Y: Array,
        starts: NDArray[np.intp],
        point: NDArray[np.intp],
        num_points: int,
        between: tuple[tuple[int, int, Array], ...],
    ) -> None:
        self._count, size = len(U), 6 * len(U)
        self._diagonal, self._runs = U, (Y, starts[1:-1])
        self.Y = sparse.bsr_array((Y, point, starts), shape=(size, 3 * num_points))
        self._U = _block_diagonal(U)
        if between:
            j, k = (np.array([link[side] for link in between]) for side in (0, 1))
            tied = np.stack([link[2] for link in between])
            rows = (6 * j[:, None, None] + np.arange(6)[:, None] + np.zeros(6, int)).ravel()
            columns = (6 * k[:, None, None] + np.zeros((6, 1), int) + np.arange(6)).ravel()
            off = sparse.coo_array((tied.ravel(), (rows, columns)), shape=(size, size))
            self._U = self._U + off + off.T

    def solve(self, b: Array, adjoints: Array) -> Array:
        """Return x (6 K, R) for right-hand sides b (6 K, R), of cameras whose poses have these
        adjoints (K, 6, 6): where they are many, up to a small share of what it is good for.
        """
        if self._count < MANY:
            return solve_symmetric((self._U - self.Y @ self.Y.T).tocsc(), b)
        Y_T, approximate = self.Y.T, self._approximate_inverse(adjoints)
        x, r = np.zeros_like(b), b
        z = p = approximate(r)
        left = all_of_it = (r * z).sum(axis=0)
        for _ in range(len(b)):
            q = self._U @ p - self.Y @ (Y_T @ p)
            step = left / np.maximum((p * q).sum(axis=0), SMALLEST)
            x, r = x + step * p, r - step * q
            z = approximate(r)
            before, left = left, (r * z).sum(axis=0)
            if (left <= LEFT * all_of_it).all():
                break
            p = z + left / np.maximum(before, SMALLEST) * p
        return x

    def _approximate_inverse(self, adjoints: Array) -> Callable[[Array], Array]:
        """Return what solves each camera by itself, and each stretch of some in a row as a rigid
        body: the sum of both.
        """
        of_camera = [Y_k.transpose(1, 0, 2).reshape(6, -1) for Y_k in np.split(*self._runs)]
        alone = self._diagonal - np.stack([Y_k @ Y_k.T for Y_k in of_camera])
        inverse = _block_diagonal(np.linalg.inv(alone))
        stretch = np.arange(self._count) // LOCAL_KEYFRAMES
        moved = (adjoints, stretch, np.arange(self._count + 1))
        as_one = sparse.bsr_array(moved, shape=(6 * self._count, 6 * (stretch[-1] + 1)))
        Y = as_one.T @ self.Y
        factor = cho_factor((as_one.T @ (self._U @ as_one) - Y @ Y.T).toarray())
        return lambda r: inverse @ r + as_one @ cho_solve(factor, as_one.T @ r)


def _block_diagonal(blocks: Array) -> sparse.bsr_array:
    """Return the matrix with blocks (K, 6, 6) on its diagonal."""
    count = len(blocks)
    shape = (6 * count, 6 * count)
    return sparse.bsr_array((blocks, np.arange(count), np.arange(count + 1)), shape=shape)


def solve_symmetric(A: sparse.csc_array, b: Array) -> Array:
    """Return x of A x = b, for a symmetric positive definite matrix: its structure alone says in
    which order it fills up least, and no pivots are looked for (Li, An Overview of SuperLU, 2005).
    """
    factors = splu(
        A, permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0, options={'SymmetricMode': True}
    )
    return np.asarray(factors.solve(b))


class Factors(Protocol):
    """What is measured alike M times, of one or two keyframes each."""

    @property
    def keyframes(self) -> NDArray[np.intp]:
        """The keyframes (M, 1) or (M, 2) by their place in the problem."""

    @property
    def information(self) -> Array:
        """The inverse covariances (M, D, D) of the errors."""

    def errors(self, T_camera_world: Array) -> Array:
        """Return the errors (M, D) of poses (K, 4, 4)."""

    def jacobians(self, T_camera_world: Array) -> Array:
        """Return the derivatives (M, 1 or 2, D, 6) of the errors by the twist of each keyframe."""


@dataclass(frozen=True)
class Links:
    """The motion T_now_before (M, 4, 4) of the camera from one keyframe to another."""

    keyframes: NDArray[np.intp]
    T_now_before: Array
    information: Array

    @staticmethod
    def of(ends: Sequence[tuple[int, int, RelativeMotion]]) -> tuple[Links, ...]:
        """Return motions, each with the keyframe before and the one now."""
        if not ends:
            return ()
        before, now, motions = zip(*ends, strict=True)
        covariance = np.stack([motion.covariance for motion in motions])
        return (
            Links(
                np.column_stack([before, now]),
                np.stack([motion.T_now_before for motion in motions]),
                np.linalg.inv(covariance + np.diag(FLOOR_SIGMA**2)),
            ),
        )

    def errors(self, T_camera_world: Array) -> Array:
        """Return the twists (M, 6) by which poses (K, 4, 4) miss the measured motions."""
        return se3_logs(self._moved(T_camera_world) @ invert(self.T_now_before))

    def jacobians(self, T_camera_world: Array) -> Array:
        """Return the derivatives (M, 2, 6, 6) of the errors by the twist of each keyframe."""
        of_before = -adjoint(self._moved(T_camera_world))
        return np.stack([of_before, np.broadcast_to(np.eye(6), of_before.shape)], axis=1)

    def _moved(self, T_camera_world: Array) -> Array:
        before, now = self.keyframes.T
        return np.asarray(T_camera_world[now] @ invert(T_camera_world[before]))


@dataclass(frozen=True)
class Levels:
    """Up in the camera of a keyframe as it was measured (M, 3), and up_world (3,), as it is in the
    world.
    """

    keyframes: NDArray[np.intp]
    measured: Array
    information: Array
    up_world: Array

    @staticmethod
    def of(measured: Sequence[tuple[int, Up]], up_world: Array) -> tuple[Levels, ...]:
        """Return what was measured, each with its keyframe."""
        if not measured:
            return ()
        keyframes, ups = zip(*measured, strict=True)
        variance = np.array([up.sigma_rad**2 for up in ups])
        return (
            Levels(
                np.array(keyframes)[:, None],
                np.stack([up.direction for up in ups]),
                np.eye(3) / variance[:, None, None],
                up_world,
            ),
        )

    def errors(self, T_camera_world: Array) -> Array:
        """Return the tilts (M, 3) in radians, about the axes of the camera."""
        return np.cross(self._up(T_camera_world), self.measured)

    def jacobians(self, T_camera_world: Array) -> Array:
        """Return the derivatives (M, 1, 3, 6) of the errors by the twist of the keyframe."""
        up = self._up(T_camera_world)
        jacobians: Array = np.zeros((len(up), 1, 3, 6))
        along = np.einsum('mi,mi->m', up, self.measured)[:, None, None] * np.eye(3)
        jacobians[:, 0, :, 3:] = up[:, :, None] * self.measured[:, None] - along
        return jacobians

    def _up(self, T_camera_world: Array) -> Array:
        return np.asarray(T_camera_world[self.keyframes[:, 0], :3, :3] @ self.up_world)


def motion_before(
    keyframes: Sequence[KeyframeRecord], index: int
) -> tuple[int, RelativeMotion | None]:
    """Return the keyframe before one, by index, that is not retired, and the motion from there;
    None where it was not measured all the way.
    """
    before, motion = index - 1, keyframes[index].motion
    while motion is not None and before > 0 and keyframes[before].retired is not None:
        earlier = keyframes[before].motion
        motion = None if earlier is None else joined_motion(earlier, motion)
        before -= 1
    return before, motion if before >= 0 else None


def factors_of(
    keyframes: Sequence[KeyframeRecord], slot: NDArray[np.intp], up_world: Up | None
) -> tuple[Factors, ...]:
    """Return what is measured of the keyframes of a problem; slot: (K,) their place in it, -1 for
    others.
    """
    ends, ups = [], []
    for k in np.flatnonzero(slot >= 0).tolist():
        (before, motion), measured = motion_before(keyframes, k), keyframes[k].up
        if motion is not None and slot[before] >= 0:
            ends.append((int(slot[before]), int(slot[k]), motion))
        if measured is not None and up_world is not None:
            ups.append((int(slot[k]), measured))
    levels = () if up_world is None else Levels.of(ups, up_world.direction)
    return (*Links.of(ends), *levels)


def loop_factors(loops: Sequence[LoopEdge], slot: NDArray[np.intp]) -> tuple[Factors, ...]:
    """Return the loops that were closed by the floor alone: no points hold them together."""
    ends = ((int(slot[loop.j]), int(slot[loop.i]), loop) for loop in loops if loop.by_floor)
    return Links.of(
        [
            (j, i, RelativeMotion(loop.T_i_j, np.diag(loop.sigma**2)))
            for j, i, loop in ends
            if min(i, j) >= 0
        ]
    )


def squared_errors(factors: Factors, T_camera_world: Array) -> Array:
    """Return the squared, normalised errors (M,)."""
    errors = factors.errors(T_camera_world)
    return np.asarray(np.einsum('mi,mij,mj->m', errors, factors.information, errors))


def cost(factors: Factors, T_camera_world: Array) -> float:
    """Return the Huber cost of the errors."""
    return huber_cost(squared_errors(factors, T_camera_world), np.array(chi2_limit(6)))


def with_factors(system: System, T_camera_world: Array, measured: Sequence[Factors]) -> System:
    """Return normal equations with what is measured of keyframes, where those that move come
    first.
    """
    if not measured:
        return system
    U, rhs, between = system.U.copy(), system.camera_rhs.copy(), []
    for factors in measured:
        J, errors = factors.jacobians(T_camera_world), factors.errors(T_camera_world)
        weight = huber_weights(squared_errors(factors, T_camera_world), np.array(chi2_limit(6)))
        weighted = np.swapaxes(J, 2, 3) @ (weight[:, None, None] * factors.information)[:, None]
        moves = factors.keyframes < len(U)
        np.add.at(U, factors.keyframes[moves], (weighted @ J)[moves])
        slope = (weighted @ errors[:, None, :, None])[..., 0]
        np.subtract.at(rhs, factors.keyframes[moves], slope[moves])
        if J.shape[1] > 1:
            tied = moves.all(axis=1)
            blocks = (weighted[:, 0] @ J[:, 1])[tied]
            between += list(zip(*factors.keyframes[tied].T.tolist(), blocks, strict=True))
    return replace(system, U=U, camera_rhs=rhs, between=tuple(between))
