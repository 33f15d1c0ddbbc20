"""People and cars that move through a scene."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from segfloor_ros.geometry import Array, make_transform
from segfloor_ros.simulation.scene import Car, Person
from segfloor_ros.simulation.solids import Prism, block, cylinder

Mover = Person | Car

MOVING_WITHIN_S = 0.2
"""What changes its place within this time around a moment moves."""

# Of a person of 1.75 m, in metres: the joints and how long the limbs are between them.
REFERENCE_HEIGHT_M = 1.75
HIP_M, SHOULDER_M = 0.88, 1.42
THIGH_M, SHIN_M = 0.44, 0.42
SOLE_M = 0.02
STRIDE_RAD = 0.42
"""Largest swing of a thigh; with it the length of a step follows, so that feet do not slide."""

KNEE_RAD = 0.9
"""Bend of the knee while the foot swings forward."""

ARM_RAD = 0.45
ELBOW_RAD = 0.35
SIDES = (1, -1)


def part_solids(mover: Mover) -> list[list[Prism]]:
    """Return the solids of each part of a mover, in the frame of the part's joint."""
    if isinstance(mover, Car):
        return [_car_solids(mover)]
    scale, cloth, trousers = mover.height_m / REFERENCE_HEIGHT_M, mover.texture, 'cloth:7'
    torso = [
        block((0.0, 0.0), (0.22, 0.36, 0.54), cloth, bottom_m=0.0),
        cylinder((0.0, 0.0), 0.06, 0.12, 'concrete', 0.54),
        cylinder((0.01, 0.0), 0.1, 0.24, 'concrete', 0.63),
    ]
    thigh = [cylinder((0.0, 0.0), 0.085, THIGH_M + 0.05, trousers, -THIGH_M)]
    shin = [
        cylinder((0.0, 0.0), 0.06, SHIN_M + 0.03, trousers, -SHIN_M),
        block((0.07, 0.0), (0.27, 0.1, 0.08), 'granite', bottom_m=-SHIN_M - SOLE_M),
    ]
    upper_arm = [cylinder((0.0, 0.0), 0.055, 0.32, cloth, -0.29)]
    forearm = [cylinder((0.0, 0.0), 0.045, 0.27, 'concrete', -0.26)]
    parts = [torso, *([thigh, shin, upper_arm, forearm] * 2)]
    return [[_scaled(prism, scale) for prism in part] for part in parts]


def part_poses(mover: Mover, time_s: float) -> Array:
    """Return where the joint of each part is at a time: T_world_part (P, 4, 4)."""
    walked_m = _walked_m(mover, time_s)
    x, y, yaw = place(mover, time_s)
    T_world_mover = make_transform(Rotation.from_euler('Z', yaw).as_matrix(), np.array([x, y, 0]))
    if isinstance(mover, Car):
        return T_world_mover[None]
    return T_world_mover @ _limbs(walked_m, mover.height_m / REFERENCE_HEIGHT_M)


def is_moving(mover: Mover, time_s: float) -> bool:
    """Return whether a mover changes its place around a time."""
    before, after = (_walked_m(mover, time_s + d) for d in (-MOVING_WITHIN_S, MOVING_WITHIN_S))
    return before != after


def _limbs(walked_m: float, scale: float) -> Array:
    """Return the joints (9, 4, 4) of someone who has walked so far from standing at the origin.

    The leg on the floor is straight, which gives the height of the hip, and its foot stays where it
    is; the other knee bends, so that its foot clears the floor. Arms swing against the legs.
    """
    step_m = 2 * (THIGH_M + SHIN_M) * scale * np.sin(STRIDE_RAD)
    phase = np.pi * walked_m / step_m
    # Whole steps between standing and standing: the swing grows over the first one.
    swing = min(1.0, walked_m / step_m)
    of_leg = swing * np.sin(STRIDE_RAD) * np.arcsin(np.sin(phase)) / (np.pi / 2)
    angles = [float(np.arcsin(of_leg)), -float(np.arcsin(of_leg))]
    dip = (THIGH_M + SHIN_M) * (1 - np.cos(angles[0]))
    hip = _joint(0.0, 0.0, HIP_M - dip, 0.0)
    poses = [hip]
    for side, angle, forward in zip(SIDES, angles, (np.cos(phase), -np.cos(phase)), strict=True):
        thigh = hip @ _joint(0.0, 0.1 * side, 0.0, -angle)
        shin = thigh @ _joint(0.0, 0.0, -THIGH_M, swing * KNEE_RAD * max(0.0, forward))
        reach = -angle / STRIDE_RAD * ARM_RAD
        upper_arm = hip @ _joint(0.0, 0.235 * side, SHOULDER_M - HIP_M - 0.04, -reach)
        forearm = upper_arm @ _joint(0.0, 0.0, -0.28, -ELBOW_RAD)
        poses += [thigh, shin, upper_arm, forearm]
    scaled = np.array(poses)
    scaled[:, :3, 3] *= scale
    return scaled


def _joint(x: float, y: float, z: float, pitch_rad: float) -> Array:
    """Return a joint at a place; a positive pitch swings what hangs from it backwards."""
    return make_transform(Rotation.from_euler('Y', pitch_rad).as_matrix(), np.array([x, y, z]))


def _scaled(prism: Prism, scale: float) -> Prism:
    footprint, bottom_m, top_m = (scale * a for a in (prism.footprint, prism.bottom_m, prism.top_m))
    return Prism(footprint, bottom_m, top_m, prism.texture, smooth=prism.smooth)


def _car_solids(car: Car) -> list[Prism]:
    """Return body, cabin and wheels of a car whose middle is over the origin."""
    length, width, height = car.size
    wheels = [
        block((0.3 * length * end, 0.42 * width * side), (0.62, 0.22, 0.6), 'granite')
        for end in SIDES
        for side in SIDES
    ]
    body = block((0.0, 0.0), (length, width, 0.55 * height - 0.2), car.texture, bottom_m=0.2)
    cabin_size = (0.55 * length, 0.88 * width, 0.45 * height)
    cabin = block((-0.06 * length, 0.0), cabin_size, 'panels', bottom_m=0.55 * height)
    return [body, cabin, *wheels]


def _walked_m(mover: Mover, time_s: float) -> float:
    walked = max(0.0, time_s - mover.start_s) * mover.speed_m_s
    return walked if mover.returns else min(walked, _lengths_m(mover).sum())


def _lengths_m(mover: Mover) -> Array:
    return np.hypot(*np.diff(np.array(mover.points), axis=0).T)


def place(mover: Mover, time_s: float) -> tuple[float, float, float]:
    """Return x, y, yaw at a time, on the way to and fro along the mover's points."""
    walked_m = _walked_m(mover, time_s)
    points, lengths = np.array(mover.points), _lengths_m(mover)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    round_trip = walked_m % (2 * along[-1])
    back = round_trip > along[-1]
    reached = 2 * along[-1] - round_trip if back else round_trip
    stretch = int(np.clip(np.searchsorted(along, reached, side='right') - 1, 0, len(lengths) - 1))
    direction = (points[stretch + 1] - points[stretch]) / lengths[stretch]
    x, y = points[stretch] + direction * (reached - along[stretch])
    heading = -direction if back else direction
    return float(x), float(y), float(np.arctan2(heading[1], heading[0]))
