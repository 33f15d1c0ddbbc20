"""A robot that drives through a scene: a differential drive in MuJoCo, with mass, wheels that may
slip and walls to run into, and what its wheels, its IMU and its bumper measure.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from segfloor_ros.apps.simulation.camera import rectified_camera
from segfloor_ros.apps.simulation.motion import plan_drive
from segfloor_ros.apps.simulation.scene import Car, Imu, Mover, MovingBox, Person, Scene
from segfloor_ros.apps.simulation.scene_file import EXPECTED, shipped
from segfloor_ros.apps.simulation.solids import Prism, floor_height_m, floors, obstacles, place
from segfloor_ros.apps.simulation.world import import_mujoco
from segfloor_ros.core.contracts import ImuSample, Mount, WheelPose
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import (
    Array,
    invert,
    make_transform,
    rotation_from_angles,
    transform_points,
)
from segfloor_ros.core.quaternions import quaternion_xyzw, transform_from_quaternion
from segfloor_ros.core.settings import suggestion
from segfloor_ros.nodes.yaml_files import read_yaml

STEPS_PER_S, STEPS_A_MEASUREMENT = 500, 5
"""Of the physics; wheels and IMU measure means over so many, and so often others take a step."""

REMEMBERED_S = 1.0
"""So far back the poses are known, for pictures of moments that are past."""

SETTLING_S = 0.5
"""So long the robot sinks into its tyres before the time begins."""

BREAK_S = 1.0
"""Contacts with shorter breaks between them are one bump."""

ACCELERATION_M_S2 = 1.0
"""At which the motors' controller lets the wheels take up another speed, ahead and in a turn."""

TYRE_FRICTION, WALL_FRICTION = 0.9, 0.3
"""Coulomb friction of rubber on a dry floor, of plastic on plaster."""

PERSON_RADIUS_M = 0.25

PERSONAL_M = 0.45
"""People come no nearer to where the robot turns: personal space begins there (Hall, 1966)."""

CARRIED_M_S, CARRIED_AT_M = 10.0, 10.0
"""What is faster stands for something that somebody puts down: until then it is out of the way."""

WAITING_S = 5.0
"""So long somebody waits for the robot, then turns round."""


@dataclass(frozen=True)
class Robot:
    """A robot as published. size_m: length, width, height. middle_m: of the length, ahead of the
    base. wheel_base_m: between the axles of four wheels, 0: two wheels and casters. skid: how many
    times faster the wheels run in a turn than without slip.
    """

    size_m: tuple[float, float, float]
    mass_kg: float
    wheel_separation_m: float
    wheel_radius_m: float
    speed_m_s: float
    turn_rate_rad_s: float
    wheel_base_m: float = 0.0
    skid: float = 1.0
    middle_m: float = 0.0

    @property
    def radius_m(self) -> float:
        """Of the circle around the base within which the robot turns."""
        length, width, _ = self.size_m
        return float(np.hypot(abs(self.middle_m) + length / 2, width / 2))

    def rim_speeds(self, forward_m_s: float, turn_rad_s: float) -> Array:
        """Return the speeds (2,) of the left and the right wheels, at their rims."""
        forward = np.clip(forward_m_s, -self.speed_m_s, self.speed_m_s)
        turn = np.clip(turn_rad_s, -self.turn_rate_rad_s, self.turn_rate_rad_s)
        return forward + np.array([-0.5, 0.5]) * turn * self.wheel_separation_m * self.skid

    def odometry_step(self, rims_m: Array) -> Array:
        """Return the arc (4, 4) that the ways (2,) of the left and the right rims stand for."""
        turn = float(rims_m[1] - rims_m[0]) / (self.wheel_separation_m * self.skid)
        way = float(rims_m.mean())
        along = np.array([way * np.cos(turn / 2), way * np.sin(turn / 2), 0.0])
        return make_transform(rotation_from_angles(turn, 0.0, 0.0), along)


def open_robot(name: str) -> tuple[Robot, list[str]]:
    """Return a shipped robot, and where its camera sits as assignments of a scene's values.

    Raises InputError for a robot that there is not.
    """
    robots = shipped('robots')
    if name not in robots:
        raise InputError(f'{name}: no such robot{suggestion(name, list(robots))}')
    values = read_yaml(robots[name], EXPECTED)
    camera = [f'camera.{key}={value}' for key, value in values['camera'].items()]
    return Robot(**values['robot']), camera


class DrivenRobot:
    """A robot that starts where the drive of a scene does, at time 0."""

    def __init__(self, scene: Scene, robot: Robot) -> None:
        rig = scene.camera
        pitch, roll = np.radians((rig.pitch_deg, rig.roll_deg))
        # Both eyes sit within the robot: one beside it would be in a wall that it drives along.
        middle_m = rig.baseline_m / 2
        self.mount = Mount(rig.height_m, float(pitch), float(roll), rig.forward_m, middle_m)
        self._robot, self._scene = robot, scene
        start = plan_drive(scene.path, rig.rate_hz).xy_yaw[0]
        mujoco = import_mujoco()
        self._model = mujoco.MjModel.from_xml_string(_document(scene, robot, self.mount, start))
        self._data, self._step = mujoco.MjData(self._model), mujoco.mj_step
        names = [self._model.geom(i).name for i in range(self._model.ngeom)]
        self._is_robot = np.array([name.startswith('robot') for name in names])
        self._is_obstacle = np.array([name.startswith('obstacle') for name in names])
        self._rng = np.random.default_rng([scene.seed, 8])
        axes = self._rng.normal(size=(2, 3))
        self._imu_axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        self._wanted_m_s: Array = np.zeros(2)
        self._rims_m_s: Array = np.zeros(2)
        self._places: deque[Array] = deque(maxlen=round(REMEMBERED_S * STEPS_PER_S))
        self._mover_steps = [0] * len(scene.movers)
        self._mover_signs, self._waited = [1] * len(scene.movers), [0] * len(scene.movers)
        self._mover_times: deque[list[float]] = deque(maxlen=self._places.maxlen)
        self._steps = -round(SETTLING_S * STEPS_PER_S)
        self._felt: list[Array] = []
        self._touched_s = -np.inf
        self._T_odom_base = np.eye(4)
        self.wheels: list[WheelPose] = []
        """What the wheels have measured since `forget_measurements`, as `imu` and `bumps`."""
        self.imu: list[ImuSample] = []
        self.bumps: list[tuple[float, Array]] = []
        """When the robot ran into something, in seconds, and where (3,) in its base."""
        self._rims_m = self._rim_positions()
        self.advance(0.0)

    def nearest_floor_m(self, scene: Scene) -> float:
        """Return how far ahead of the base the camera sees the nearest floor."""
        camera = rectified_camera(scene.camera)
        steepest = self.mount.pitch_rad + np.arctan(camera.height / 2 / camera.fy)
        return self.mount.forward_m + self.mount.height_m / float(np.tan(steepest))

    def drive(self, forward_m_s: float, turn_rad_s: float) -> None:
        """Drive at these speeds from now on, as far as the robot can."""
        self._wanted_m_s = self._robot.rim_speeds(forward_m_s, turn_rad_s)

    def advance(self, time_s: float) -> None:
        """Let the time go on to a moment."""
        while self._steps < round(time_s * STEPS_PER_S):
            self._follow_command()
            if self._steps % STEPS_A_MEASUREMENT == 0:
                self._place_movers()
            self._step(self._model, self._data)
            self._steps += 1
            self._places.append(self._data.qpos[:7].copy())
            self._mover_times.append([steps / STEPS_PER_S for steps in self._mover_steps])
            self._felt.append(self._data.sensordata.copy())
            if self._steps % STEPS_A_MEASUREMENT == 0:
                self._measure()
            self._look_for_bumps()

    def forget_measurements(self) -> None:
        """Forget what was measured so far."""
        self.wheels, self.imu, self.bumps = [], [], []

    @property
    def time_s(self) -> float:
        """The time that has been reached."""
        return self._steps / STEPS_PER_S

    def T_world_base(self, time_s: float) -> Array:
        """Return the true pose (4, 4) of the base at a time not long past."""
        x, y, z, *quat_wxyz = self._places[self._index(time_s)]
        return transform_from_quaternion(np.array([x, y, z]), np.roll(quat_wxyz, -1))

    def mover_times_s(self, time_s: float) -> list[float]:
        """Return the time of each mover at a time not long past: people wait for the robot."""
        return self._mover_times[self._index(time_s)]

    def _index(self, time_s: float) -> int:
        """Return where a time not long past is among what is remembered."""
        back = self._steps - round(time_s * STEPS_PER_S)
        return max(len(self._places) - 1 - max(back, 0), 0)

    def T_world_left(self, time_s: float) -> Array:
        """Return the true pose (4, 4) of the rectified left optical frame at a time not long
        past.
        """
        return self.T_world_base(time_s) @ self.mount.T_base_left

    def _follow_command(self) -> None:
        """Let the controller of the motors turn the wheels, at its own pace."""
        most = ACCELERATION_M_S2 / STEPS_PER_S
        change = self._wanted_m_s - self._rims_m_s
        ahead = change.sum() / 2
        self._rims_m_s += np.clip(ahead, -most, most) + np.clip(change - ahead, -most, most)
        turning = self._rims_m_s / self._robot.wheel_radius_m
        self._data.ctrl.reshape(-1, 2)[:] = turning

    def _place_movers(self) -> None:
        for index, mover in enumerate(self._scene.movers):
            if self._steps >= 0:
                self._mover_steps[index] += self._stride(mover, index)
            x, y, yaw = place(mover, self._mover_steps[index] / STEPS_PER_S)
            is_carried = mover.speed_m_s > CARRIED_M_S and not any(
                np.allclose(end, (x, y)) for end in (mover.points[0], mover.points[-1])
            )
            self._data.mocap_pos[index] = x, y, CARRIED_AT_M * is_carried
            self._data.mocap_quat[index] = np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)

    def _stride(self, mover: Mover, index: int) -> int:
        """Return by how much the time of a mover goes on. Somebody waits where the next step would
        lead too near to the robot, and then turns round; he goes back before a robot that comes
        too near.
        """
        if not isinstance(mover, Person):
            return STEPS_A_MEASUREMENT
        steps = self._mover_steps[index]
        if steps < STEPS_A_MEASUREMENT:
            self._mover_signs[index] = 1
        stride = self._mover_signs[index] * STEPS_A_MEASUREMENT
        ways = [place(mover, (steps + by) / STEPS_PER_S)[:2] for by in (0, stride, -stride)]
        now_m, ahead_m, back_m = np.hypot(*(np.array(ways) - self._data.qpos[:2]).T)
        near_m = self._robot.radius_m + PERSON_RADIUS_M + PERSONAL_M
        if ahead_m >= min(now_m, near_m):
            self._waited[index] = 0
            return stride
        if steps >= stride and back_m > now_m and now_m < near_m:
            self._waited[index] = 0
            return -stride
        self._waited[index] += STEPS_A_MEASUREMENT
        if self._waited[index] > WAITING_S * STEPS_PER_S:
            self._mover_signs[index] *= -1
            self._waited[index] = 0
        return 0

    def _rim_positions(self) -> Array:
        """Return how far the rims of the left and the right wheels have run (2,), the mean of
        either side.
        """
        return self._data.qpos[7:].reshape(-1, 2).mean(axis=0) * self._robot.wheel_radius_m

    def _measure(self) -> None:
        rims_m = self._rim_positions()
        self._T_odom_base = self._T_odom_base @ self._robot.odometry_step(rims_m - self._rims_m)
        self._rims_m = rims_m
        accel, gyro = np.mean(self._felt, axis=0).reshape(2, 3)
        self._felt.clear()
        if self._steps < 0:
            return
        noise = self._rng.standard_normal((2, 3))
        gyro += np.radians(
            Imu.gyro_bias_deg_s * self._imu_axes[0] + Imu.gyro_noise_deg_s * noise[0]
        )
        accel += Imu.accel_bias_m_s2 * self._imu_axes[1] + Imu.accel_noise_m_s2 * noise[1]
        stamp_ns = self._steps * (10**9 // STEPS_PER_S)
        self.wheels.append(WheelPose(stamp_ns, self._T_odom_base))
        self.imu.append(ImuSample(stamp_ns, gyro, accel))

    def _look_for_bumps(self) -> None:
        pairs = self._data.contact.geom
        hits = (self._is_robot[pairs] | self._is_obstacle[pairs]).all(axis=1)
        hits &= self._is_obstacle[pairs].any(axis=1)
        if not hits.any():
            return
        if self._steps >= 0 and self.time_s > self._touched_s + BREAK_S:
            T_base_world = invert(self.T_world_base(self.time_s))
            self.bumps.append(
                (self.time_s, transform_points(T_base_world, self._data.contact.pos[hits])[0])
            )
        self._touched_s = self.time_s


def _document(scene: Scene, robot: Robot, mount: Mount, start: Array) -> str:
    """Return the MuJoCo model of the robot, its base at x, y, yaw, among the scene's solids."""
    ground = floors(dataclasses.replace(scene, floor_patches=()))
    solids = [prism for prism in obstacles(scene) if not prism.is_sheet]
    named = [('floor', ground), ('obstacle', solids)]
    meshes = [
        (f'{kind}_{i}', _corners(prism)) for kind, some in named for i, prism in enumerate(some)
    ]
    x, y, yaw = start
    z = floor_height_m(ground, np.array([[x, y]]))[0]
    template = Path(__file__).with_name('robot.xml').read_text()
    return template.format(
        step_s=1 / STEPS_PER_S,
        wall_friction=WALL_FRICTION,
        meshes=''.join(f'<mesh name="{name}" vertex="{at}"/>' for name, at in meshes),
        solids=''.join(f'<geom name="{name}" type="mesh" mesh="{name}"/>' for name, _ in meshes),
        movers=''.join(_mover(index, mover) for index, mover in enumerate(scene.movers)),
        pose=f'pos="{x} {y} {z}" quat="{np.cos(yaw / 2)} 0 0 {np.sin(yaw / 2)}"',
        parts=_parts(robot),
        imu=_words(mount.T_base_left[:3, 3]),
        imu_quat=_words(np.roll(quaternion_xyzw(mount.T_base_left[:3, :3]), 1)),
        motors=_motors(robot),
    )


def _parts(robot: Robot) -> str:
    """Return shell, wheels and casters."""
    length, width, height = robot.size_m
    bottom = robot.wheel_radius_m / 2
    half = (length / 2, width / 2, (height - bottom) / 2)
    parts = [
        f'<geom name="robot_shell" type="box" mass="{robot.mass_kg}" size="{_words(half)}" '
        f'pos="{robot.middle_m} 0 {bottom + half[2]}"/>'
    ]
    for name, axle_m, side in _wheels(robot):
        parts.append(
            f'<body pos="{axle_m} {side * robot.wheel_separation_m / 2} {robot.wheel_radius_m}">'
            f'<joint name="{name}" axis="0 1 0" armature="{_load(robot)}"/>'
            f'<geom name="robot_{name}" type="cylinder" '
            f'zaxis="0 1 0" size="{robot.wheel_radius_m} {bottom / 2}" mass="{robot.mass_kg / 50}" '
            f'friction="{TYRE_FRICTION} 0 0"/></body>'
        )
    if not robot.wheel_base_m:
        parts += [
            f'<geom name="robot_caster_{end}" type="sphere" size="{bottom / 2}" priority="1" '
            f'condim="1" mass="0" pos="{robot.middle_m + end * 0.4 * length} 0 {bottom / 2}"/>'
            for end in (-1, 1)
        ]
    return ''.join(parts)


def _wheels(robot: Robot) -> list[tuple[str, float, int]]:
    """Return name, place of the axle and side, 1 to the left, of each wheel, left ones first."""
    axles = (-robot.wheel_base_m / 2, robot.wheel_base_m / 2) if robot.wheel_base_m else (0.0,)
    return [(f'wheel_{i}_{side}', axle, side) for i, axle in enumerate(axles) for side in (1, -1)]


def _load(robot: Robot) -> float:
    """Return the inertia that the robot's mass is to the motor of a wheel, in kg m². Through its
    gears a rotor has about the same.
    """
    return robot.mass_kg * robot.wheel_radius_m**2 / len(_wheels(robot))


def _motors(robot: Robot) -> str:
    """Return a motor for each wheel that follows a speed, within a step where nothing holds it."""
    return ''.join(
        f'<velocity joint="{name}" kv="{_load(robot) * STEPS_PER_S}"/>'
        for name, _, _ in _wheels(robot)
    )


def _mover(index: int, mover: Mover) -> str:
    """Return what moves as it stands in the way: a person as a post."""
    if isinstance(mover, (Car, MovingBox)):
        height_m = mover.size[2]
        shape = f'type="box" size="{_words(np.array(mover.size) / 2)}"'
    else:
        height_m = Person.height_m
        shape = f'type="cylinder" size="{PERSON_RADIUS_M} {height_m / 2}"'
    return (
        f'<body name="mover_{index}" mocap="true"><geom name="obstacle_mover_{index}" '
        f'{shape} pos="0 0 {height_m / 2}"/></body>'
    )


def _corners(prism: Prism) -> str:
    """Return the corners of a prism, which is convex, as numbers."""
    low = np.column_stack([prism.footprint, prism.bottom_m])
    return _words(np.vstack([low, np.column_stack([prism.footprint, prism.top_m])]).ravel())


def _words(values: Array | Sequence[float]) -> str:
    return ' '.join(f'{value:.9g}' for value in values)
