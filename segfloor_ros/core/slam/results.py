"""What stereo SLAM hands to the next stages: one result per frame, one bundle of data per
keyframe, a copy of the map among it; and what tracking hands to mapping.

Tracking and mapping work in optical axes from the first camera pose. Frame `map` lies on the
floor, so it is known only when the mount is, and a submap is in it only once it is merged: until
then results are held back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import Mount, StereoFrame, WheelPose
from segfloor_ros.core.geometry import Array, adjoint, invert, transform_points
from segfloor_ros.core.settings import StageSettings, setting

if TYPE_CHECKING:  # the nodes behind SLAM do without SciPy
    from segfloor_ros.core.camera.images import Region
    from segfloor_ros.core.slam.rig import Observations
    from segfloor_ros.core.slam.sparse_map import KeyframeRecord, SparseMap
    from segfloor_ros.core.slam.tracking.images import Features
    from segfloor_ros.core.slam.tracking.pose import PoseEstimate

NOT_RECOGNISED = 'mapped, but no place of the map was recognised'

UNKNOWN_COVARIANCE = 1e6
NO_POINT = -1
"""Id of a feature that has no map point."""

ENOUGH = 20
"""Fewest points that must agree for a pose, or for two views of one place, to be believed; half as
many for a first guess. Chance gives five or six."""

SAME = 0.5, 0.3
"""Two poses further apart than this, in m and rad, are two places."""

MAJORITY = 0.5
"""Share that must agree: a wrong pose has followers too, but not most."""

CHANCE_SHARE = 0.1
"""Share of the points of a view of which no more may be found by chance: far ones alone fit many
places."""

MOST = 0.6
"""Share of what is expected at a pose that must be found there: what looks alike shows less."""

NEARLY_ALL = 0.9
"""Share of a keyframe's points that others must see as well, or of a view that they must cover, for
it to add nothing (Mur-Artal et al., ORB-SLAM, IEEE T-RO 2015, section VI-E); and what counts as
much as the best."""

POINTS_PER_KEYFRAME = 300
"""Points of a keyframe that hold the map together where it is adjusted as a whole, those that most
others see, and corners of its floor; the rest moves along."""

PROOF = 3
"""Keyframes that must show something for it to be believed: that a point stands still, or is gone,
that a view adds nothing, that a place is seen again; and corners of a thing that moves. By chance
hardly two agree."""

MOST_LOOKED_BACK = 100
"""Of the frames of a camera that is looked for, so many may turn out to have seen where it was."""

MAX_HELD_KEYFRAMES = 50
"""Keyframes that wait with their images; of more, every second one goes without."""


@dataclass(frozen=True)
class KeyframeFeatures:
    """The features of one keyframe. uv_px: (N, 2) float32, position in the rectified left
    image. point_id: (N,) int32, stable for the life of the map, `NO_POINT` where the feature
    has no map point. xyz_map: (N, 3) float32 in metres, NaN where unknown.
    """

    uv_px: NDArray[np.float32]
    point_id: NDArray[np.int32]
    xyz_map: Array


@dataclass(frozen=True)
class SparseCloud:
    """The whole sparse map: ids (N,) int32 ascending, positions (N, 3) float32 in frame `map`,
    metres.
    """

    point_id: NDArray[np.int32]
    xyz_map: Array


@dataclass(frozen=True)
class KeyframePath:
    """All keyframes as now optimised: stamps (K,) int64 ascending and base poses (K, 4, 4) in
    frame `map`.
    """

    stamp_ns: NDArray[np.int64]
    T_map_base: Array


@dataclass(frozen=True)
class MovingPoints:
    """Points of what moves: positions (N, 3) in frame `map`, m, and velocities (N, 3), m/s, NaN
    where they are not known.
    """

    xyz_map: NDArray[np.floating]
    velocity_m_s: NDArray[np.floating]


@dataclass(frozen=True)
class Keyframe:
    """Everything published about one keyframe. All parts share its stamp. moving: mask (H, W)
    uint8 of the left image, 255 where something moves.
    """

    stamp_ns: int
    frame_index: int
    T_map_base: Array
    left: NDArray[np.uint8]
    right: NDArray[Any]
    features: KeyframeFeatures
    path: KeyframePath
    cloud: SparseCloud
    moving: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class LastPose:
    """Where a drive was broken off: the last pose T_camera_world (4, 4) with its covariance (6, 6)
    and velocity (6,), the correction of the odometry T_world_odom (4, 4), and what wheels measured.
    """

    stamp_ns: int
    T_camera_world: Array
    T_world_odom: Array
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    velocity: Array = field(default_factory=lambda: np.zeros(6))
    wheels: tuple[WheelPose, ...] = ()


@dataclass(frozen=True)
class FrameResult:
    """The outcome of one frame. tracked: whether there is a pose. T_odom_base: the base in the
    continuous `odom` frame; T_map_odom: the present correction, so that T_map_odom @
    T_odom_base is the base in `map` (REP-105). Both are the last known ones while lost.
    covariance: (6, 6) of the base pose, order x y z roll pitch yaw (m², rad²), in the odom
    frame. reference_keyframe: stamp of the keyframe the pose is expressed against, for
    correcting it later. state: words for people ('tracking', or why not). blind: whether the pose
    is that of wheels or a gyroscope alone. keyframe: set when
    this frame became one. moving: what moves, where this frame was searched for it. in_submap:
    whether it was mapped in a submap beside the map: `tracked` where it was merged later. repeated:
    whether the left image is the one before, bit for bit. outside: whether `map` is a frame of its
    own, for the map that was loaded is not recognised yet.
    """

    index: int
    stamp_ns: int
    tracked: bool
    T_odom_base: Array
    T_map_odom: Array
    covariance: Array
    num_matches: int
    state: str
    reference_keyframe_ns: int
    keyframe: Keyframe | None = None
    moving: MovingPoints | None = None
    blind: bool = False
    in_submap: bool = False
    repeated: bool = False
    outside: bool = False

    @property
    def covariance_in_map(self) -> Array:
        """The covariance (6, 6) in the axes of `map`; outside of a loaded one the place in it is
        not known.
        """
        if self.outside:
            return np.eye(6) * UNKNOWN_COVARIANCE
        axes = np.kron(np.eye(2), self.T_map_odom[:3, :3])
        return np.asarray(axes @ self.covariance @ axes.T)


@dataclass(frozen=True)
class ObservedFeatures:
    """The features (F) of a frame as measured. observations: (F, 3) px, with a disparity where one
    was measured. point_id: (F,) int32, the row of each feature's map point or `NO_POINT`.
    """

    features: Features
    observations: Observations
    point_id: NDArray[np.int32]

    def take(self, rows: NDArray[np.intp]) -> ObservedFeatures:
        """Return the chosen rows."""
        return ObservedFeatures(
            self.features.take(rows), self.observations.take(rows), self.point_id[rows]
        )


@dataclass(frozen=True)
class Track:
    """A frame with a pose.

    point_ids: (N,) the map points that were found and agree, and observations (N) of them as
    measured. visible_ids: those that were looked for. observed: set when the pose was found by
    features. is_poor: whether few points of many support the pose. sigma_m: how uncertain the image
    leaves the place on the axis where it is most, 0 where it shows plenty. prior: the pose that
    wheels measured, where the image does not contradict it; is_prior_better: in some direction.
    """

    estimate: PoseEstimate
    point_ids: NDArray[np.int32]
    observations: Observations
    visible_ids: NDArray[np.int32]
    observed: ObservedFeatures | None = None
    is_poor: bool = False
    sigma_m: float = 0.0
    prior: PoseEstimate | None = None
    is_prior_better: bool = False

    @property
    def T_camera_world(self) -> Array:
        """The pose (4, 4)."""
        return self.estimate.T_camera_world

    @property
    def uv_px(self) -> Array:
        """Where the points are in the image, (N, 2)."""
        return self.observations.uvd_px[:, :2]

    @property
    def covariance(self) -> Array:
        """The covariance (6, 6) of the pose's twist."""
        return self.estimate.covariance


def lost_frame(frame: StereoFrame) -> FrameResult:
    """Return the outcome of a frame that nothing came of."""
    nowhere = np.eye(4)
    unknown = np.eye(6) * UNKNOWN_COVARIANCE
    return FrameResult(
        frame.index, frame.stamp_ns, False, nowhere, nowhere, unknown, 0, 'lost: failed', 0
    )


def recognised(result: FrameResult, track: Track, T_world_odom: Array) -> FrameResult:
    """Return the outcome, in optical axes, of a frame that was lost but saw the place where the
    camera was found soon after. T_world_odom: (4, 4), the correction since.
    """
    return replace(
        result,
        tracked=True,
        T_odom_base=invert(track.T_camera_world @ T_world_odom),
        T_map_odom=T_world_odom,
        covariance=track.covariance,
        num_matches=len(track.point_ids),
        state='tracking: the place was recognised by later frames',
    )


def left_out(result: FrameResult) -> FrameResult:
    """Return what is left of a frame of a submap that was not recognised in the map by the end, or
    of a map that a larger submap was not recognised in.
    """
    return replace(
        result,
        tracked=False,
        covariance=np.eye(6) * UNKNOWN_COVARIANCE,
        state=f'lost: {NOT_RECOGNISED}',
        keyframe=None,
        moving=None,
        blind=False,
        in_submap=result.in_submap or result.tracked,
    )


def turned(points: MovingPoints, T: Array) -> MovingPoints:
    """Return points and velocities in another frame, T (4, 4)."""
    return MovingPoints(
        transform_points(T, points.xyz_map).astype(np.float32),
        (points.velocity_m_s @ T[:3, :3].T).astype(np.float32),
    )


def take_snapshot(
    sparse_map: SparseMap, keyframe: KeyframeRecord, frame: StereoFrame, moving: Region | None
) -> Keyframe:
    """Copy the map as it is at a keyframe made of `frame`, in optical axes: the camera stands for
    the base and frame `world` for `map` until `in_map` turns them.
    """
    point_id = keyframe.point_id.copy()
    xyz = np.full((len(point_id), 3), np.nan)
    known = point_id != NO_POINT
    xyz[known] = sparse_map.xyz_world[point_id[known]]
    point_id[known] = sparse_map.stable_id[point_id[known]]
    return Keyframe(
        frame.stamp_ns,
        frame.index,
        keyframe.T_world_camera,
        frame.left,
        frame.right,
        KeyframeFeatures(keyframe.observations.uvd_px[:, :2].astype(np.float32), point_id, xyz),
        _path(sparse_map.keyframes),
        _cloud(sparse_map),
        moving,
    )


def in_merged_map(
    sparse_map: SparseMap, T_world_odom: Array
) -> Callable[[FrameResult], FrameResult]:
    """Return what brings a result of a submap, in optical axes, up to date, now that it is merged
    with the map. T_world_odom: (4, 4), the correction since.
    """
    return partial(_in_merged_map, sparse_map.keyframes, _cloud(sparse_map), T_world_odom)


def _in_merged_map(
    keyframes: Sequence[KeyframeRecord],
    cloud: SparseCloud,
    T_world_odom: Array,
    result: FrameResult,
) -> FrameResult:
    keyframe = result.keyframe
    if keyframe is not None:
        path = _path([k for k in keyframes if k.stamp_ns <= keyframe.stamp_ns])
        features = keyframe.features
        row = np.searchsorted(cloud.point_id, features.point_id)
        row = np.minimum(row, len(cloud.point_id) - 1)
        there = cloud.point_id[row] == features.point_id
        xyz = np.where(there[:, None], cloud.xyz_map[row], np.nan)
        ids = np.where(there, features.point_id, np.int32(NO_POINT))
        keyframe = replace(
            keyframe,
            T_map_base=path.T_map_base[-1],
            features=replace(features, point_id=ids, xyz_map=xyz),
            path=path,
            cloud=cloud,
        )
    return replace(result, T_map_odom=T_world_odom, keyframe=keyframe)


def _path(keyframes: Sequence[KeyframeRecord]) -> KeyframePath:
    return KeyframePath(
        np.array([k.stamp_ns for k in keyframes], np.int64),
        np.stack([k.T_world_camera for k in keyframes]),
    )


def _cloud(sparse_map: SparseMap) -> SparseCloud:
    alive = np.flatnonzero(sparse_map.alive)
    alive = alive[np.argsort(sparse_map.stable_id[alive])]
    return SparseCloud(sparse_map.stable_id[alive], sparse_map.xyz_world[alive])


class HeldResults:
    """Holds results in optical axes back, then turns all of them into ROS frames."""

    def __init__(self) -> None:
        self._held: list[FrameResult] = []
        self._released: list[FrameResult] = []
        self._lost: list[FrameResult] = []
        self._keeps = False

    @property
    def is_empty(self) -> bool:
        """Whether nothing is held back."""
        return not self._held

    def take(self, result: FrameResult, mount: Mount | None) -> list[FrameResult]:
        """Take in the next result and return what is ready: nothing while it is of a submap."""
        self._held.append(result)
        self._lost = [] if result.tracked else [*self._lost[-MOST_LOOKED_BACK:], result]
        self._thin_out()
        return [] if result.in_submap else self.release(mount)

    def change(self, change: Callable[[FrameResult], FrameResult]) -> None:
        """Change the results that are held of a submap; those that are lost then may be recognised
        later.
        """
        self._held = [change(result) if result.in_submap else result for result in self._held]
        self._lost = [result for result in self._held if not result.tracked][-MOST_LOOKED_BACK:]

    def recognise(self, proof: Mapping[int, Track], T_world_odom: Array) -> None:
        """Release the frames once more that were lost when the camera was looked for, from the
        first on that saw the place where it was found. proof: those that did, by stamp.
        T_world_odom: (4, 4), the correction since.
        """
        if not proof:
            return
        again = [
            recognised(result, proof[result.stamp_ns], T_world_odom)
            if result.stamp_ns in proof
            else result
            for result in self._lost
            if result.stamp_ns >= min(proof)
        ]
        if again:
            self._held = [*_before(self._held, again[0]), *again]
            self._released = _before(self._released, again[0])

    def keep_submap(self, in_its_map: Callable[[FrameResult], FrameResult]) -> None:
        """Make the submap the map: what was held before it is in none. in_its_map: brings a result
        of the submap up to date.
        """
        self._held = [
            replace(in_its_map(held), in_submap=False) if held.in_submap else left_out(held)
            for held in self._held
        ]

    def release(self, mount: Mount | None) -> list[FrameResult]:
        """Return the results in ROS frames, oldest first; none while the mount is unknown."""
        if mount is None:
            return []
        ready, self._held = self._held, []
        self._released += ready if self._keeps else []
        return [in_map(held, mount.T_base_left) for held in ready]

    def keep(self, keeps: bool) -> None:
        """Keep what is released from now on, as long as the mount may turn out to be another."""
        self._keeps = keeps
        if not keeps:
            self._released.clear()

    def take_back(self) -> None:
        """Hold all results back again: they are released once more, the first ones first."""
        self._held, self._released = [*self._released, *self._held], []

    def newest(self, mount: Mount) -> FrameResult | None:
        """Return the pose of the newest result that is held, as seen from a mount."""
        if not self._held:
            return None
        return in_map(replace(self._held[-1], keyframe=None, moving=None), mount.T_base_left)

    def _thin_out(self) -> None:
        """Keep the images of so many keyframes only: a camera that never sees the floor must not
        fill the memory. The poses of all frames are kept.
        """
        for kept in (self._held, self._released):
            holders = [i for i, held in enumerate(kept) if held.keyframe is not None]
            for i in holders[1::2] if len(holders) > MAX_HELD_KEYFRAMES else []:
                kept[i] = replace(kept[i], keyframe=None)


def _before(results: list[FrameResult], first: FrameResult) -> list[FrameResult]:
    return [result for result in results if result.index < first.index]


def in_map(result: FrameResult, T_map_world: Array) -> FrameResult:
    """Turn a result in optical axes into ROS frames; `map` is the base at the first pose, so
    T_map_world = T_base_left.
    """
    T_left_base = invert(T_map_world)
    return replace(
        result,
        T_odom_base=T_map_world @ result.T_odom_base @ T_left_base,
        T_map_odom=T_map_world @ result.T_map_odom @ T_left_base,
        covariance=_covariance_of_base(result, T_map_world),
        keyframe=_keyframe_in_map(result.keyframe, T_map_world) if result.keyframe else None,
        moving=turned(result.moving, T_map_world) if result.moving else None,
    )


def _covariance_of_base(result: FrameResult, T_base_left: Array) -> Array:
    """Carry the covariance of the camera twist to the base, in odom axes."""
    T_odom_base = T_base_left @ result.T_odom_base @ invert(T_base_left)
    axes = np.zeros((6, 6))
    axes[:3, :3] = axes[3:, 3:] = T_odom_base[:3, :3]
    A = axes @ adjoint(T_base_left)
    return A @ result.covariance @ A.T


def _keyframe_in_map(keyframe: Keyframe, T_map_world: Array) -> Keyframe:
    T_left_base = invert(T_map_world)
    features, path, cloud = keyframe.features, keyframe.path, keyframe.cloud
    features_xyz, cloud_xyz = (
        transform_points(T_map_world, part.xyz_map).astype(np.float32) for part in (features, cloud)
    )
    return replace(
        keyframe,
        T_map_base=T_map_world @ keyframe.T_map_base @ T_left_base,
        features=replace(features, xyz_map=features_xyz),
        path=replace(path, T_map_base=T_map_world @ path.T_map_base @ T_left_base),
        cloud=replace(cloud, xyz_map=cloud_xyz),
    )


NAN = float('nan')


@dataclass(frozen=True)
class StereoSlamSettings(StageSettings):
    """Features, tracking, keyframes, bundle adjustment and the camera's mount."""

    camera_height_m: float = setting(
        NAN,
        'Height of the left camera above the floor; not a number: measured from the floor seen.',
        within=(0.02, 10.0),
    )
    camera_pitch_rad: float = setting(
        NAN,
        'Pitch of the camera, positive looks down; not a number: measured from the floor seen.',
        within=(-1.4, 1.4),
    )
    camera_roll_rad: float = setting(
        NAN,
        'Roll of the camera, positive to its right; not a number: measured from the floor seen.',
        within=(-0.8, 0.8),
    )
    camera_forward_m: float = setting(0.0, 'Left camera ahead of the base.', within=(-10.0, 10.0))
    camera_left_m: float = setting(
        0.0, 'Left camera to the left of the middle of the base.', within=(-10.0, 10.0)
    )
    num_features: int = setting(1000, 'Features per image, spread over it.', within=(200, 10000))
    fast_threshold: int = setting(
        7,
        'Contrast of the weakest corner; low, so that plain floors get their share.',
        unit='grey levels',
        within=(2, 60),
    )
    max_speed_mps: float = setting(
        40.0, 'A motion faster than this is implausible and ends tracking.', within=(0.1, 100.0)
    )
    detect_moving: bool = setting(True, 'Leave out what moves, as far as the stereo pairs show it.')
    mask_dilation_px: int = setting(
        5,
        'A mask of moving things (`dynamic_mask`, `--masks`) is widened by this much.',
        within=(0, 100),
    )
    keyframe_max_frames: int = setting(
        30, 'A new keyframe is due after this many frames (condition A1).', within=(1, 1000)
    )

    @property
    def has_mount(self) -> bool:
        """Whether height, pitch and roll of the camera are all given."""
        given = (self.camera_height_m, self.camera_pitch_rad, self.camera_roll_rad)
        return not any(math.isnan(value) for value in given)
