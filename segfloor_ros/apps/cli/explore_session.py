"""`segfloor explore`: a simulated robot maps a scene by itself and drives to goals on its map.

The robot and the nodes behind its camera are processes of their own, and the planner drives it by
what they publish, in step with the robot's time.
"""

from __future__ import annotations

import json
import os
import shlex
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import typer
import yaml
from geometry_msgs.msg import Twist, TwistStamped, Vector3
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from segfloor_ros.apps.cli.printing import console
from segfloor_ros.apps.cli.replay_nodes import STALL_S, NodeGraph, ReplayError, running_nodes
from segfloor_ros.apps.cli.replay_session import cpu_s
from segfloor_ros.apps.cli.terminal import ExploreOptions, print_json, progress_bar, value_table
from segfloor_ros.apps.evaluation.exploration import (
    Exploration,
    Moment,
    figures,
    mapped_share,
    picture,
    reachable_floor,
    write_film,
)
from segfloor_ros.apps.navigation import NOWHERE, STOP, Body, Explorer, Goal
from segfloor_ros.apps.simulation.robot import DrivenRobot, Robot, open_robot
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.solids import floors, obstacles, true_map
from segfloor_ros.apps.trajectory import Trajectory, write_tum
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import UNKNOWN_COVARIANCE, FloorScan
from segfloor_ros.core.errors import MapError, SettingsError, about, os_errors
from segfloor_ros.core.files.whole import read_json
from segfloor_ros.core.files.writing import check_target, folder_in_the_making, move_into_place
from segfloor_ros.core.geometry import Array, Pose2d, planar, transform_points
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.core.processes import Interrupt, first_interrupt_noted
from segfloor_ros.nodes.configuration import resolve
from segfloor_ros.nodes.map_files import save_map
from segfloor_ros.nodes.messages.grids import grid_of
from segfloor_ros.nodes.messages.images import grey8_image
from segfloor_ros.nodes.messages.points import moving_points_arrays, sparse_cloud_arrays
from segfloor_ros.nodes.messages.poses import pose_array
from segfloor_ros.nodes.messages.scans import scan_arrays
from segfloor_ros.nodes.messages.topics import (
    CAMERA,
    GRID,
    NODES,
    PATIENCE_S,
    ROBOT,
    SLAM,
    TOPICS,
    make_header,
    stamp_of,
    to_ns,
)
from segfloor_ros.nodes.yaml_files import read_yaml

GOALS, SAVED = 'goals.yaml', 'saved.map'
FILES = (GOALS, SAVED, 'map.pgm', 'map.yaml', 'true_map.pgm', 'true_map.yaml', 'trajectory.txt',
         'ground_truth.txt', 'summary.json', 'explored.png', 'explored.gif')  # fmt: skip

CRUISE_M_S, TURN_RAD_S = 0.4, 0.6
"""No faster, whatever the robot can: SLAM follows these surely."""

WORDS = {
    'mapped_share': 'share of the floor that is mapped',
    'goals_reached': 'goals reached',
    'goals_total': 'goals',
    'path_rmse_m': 'error of the path, RMSE [m]',
    'free_precision': 'share of free cells that are floor',
    'free_recall': 'share of the floor that is free',
    'tracked_share': 'share of the frames with a pose',
    'path_m': 'distance [m]',
    'sim_s': 'duration [s]',
    'wall_s': 'computed in [s]',
    'real_time_factor': 'speed, 1 is real time',
    'map_in_scene': 'start of the map in the scene (x, y, yaw)',
}
"""Names of figures, in words."""

STANDING_S = 3.0
"""So long the robot stands at first, as any does while it starts: SLAM learns the bias of its
gyroscope."""

GIVEN = ('height_m', 'pitch_rad', 'roll_rad', 'forward_m', 'left_m')
"""Of the mount of the camera: what SLAM is given."""

OnMap = Callable[[float, OccupancyGrid, str], None]
"""Told the time of the robot, the map and the phase."""


@dataclass(frozen=True)
class ExploreSession:
    """One exploration. robot: values of the node `simulated_robot`. slam: values of `stereo_slam`,
    e.g. where the camera sits. half_width_m: of the robot. found: what it comes to. most_s: of the
    robot's time. save: where the whole map goes at the end.
    """

    configuration: Configuration
    params_file: Path | None
    robot: dict[str, Any]
    slam: dict[str, Any]
    half_width_m: float
    explorer: Explorer
    found: Exploration
    most_s: float
    save: Path
    on_map: OnMap
    interrupt: Interrupt

    def execute(self) -> None:
        """Explore until all is done, the time is over or an interrupt comes. A node that is killed
        starts again. Raises ReplayError when one ends otherwise, or nothing moves.
        """
        nodes = (ROBOT, *(node for node in NODES if node != CAMERA))
        with running_nodes(self._parameters, self.params_file, None, nodes) as graph:
            pilot = Pilot(graph, self.explorer, self.found, self.on_map)
            graph.connect(is_paced=False, interrupted=self.interrupt)
            graph.pause(ROBOT, False)
            graph.processes.restarts_killed = True
            start_s, pilot.last_sign_s = time.monotonic(), time.monotonic()
            while not (self.explorer.is_done or self.interrupt.is_set()):
                graph.spin()
                pilot.answer()
                if pilot.time_s > self.most_s:
                    break
                if time.monotonic() > pilot.last_sign_s + STALL_S:
                    raise ReplayError(f'the robot has not moved on for {STALL_S:g} s')
            self.found.wall_s = time.monotonic() - start_s
            self.found.cpu_s = {**cpu_s(graph.processes), 'planner': sum(os.times()[:2])}
            if self.found.moments:
                graph.call(Trigger, f'{SLAM}/save_map', Trigger.Request(), STALL_S)

    def _parameters(self, folder: Path) -> dict[str, Any]:
        """Return the parameters as resolved, of nodes in step with the robot."""
        slam = {'background': False, 'tf_wait_s': 0.0, 'save_map': str(self.save.absolute())}
        nodes = {
            ROBOT: {**self.robot, 'rate': 0.0, 'start_paused': True},
            SLAM: {**self.slam, **slam},
            GRID: {'publish_period_s': 0.0, 'footprint_radius_m': self.half_width_m},
        }
        return self.configuration.as_ros_parameters(**nodes)


class Pilot:
    """Drives the robot: answers every frame with a command once the nodes are done with it."""

    def __init__(
        self, graph: NodeGraph, explorer: Explorer, found: Exploration, on_map: OnMap
    ) -> None:
        self._recorder, self._explorer, self._on_map = graph.recorder, explorer, on_map
        self.found = found
        self.last_sign_s = time.monotonic()
        """When the last frame came, in real time."""
        self._waiting: dict[int, float] = {}
        self._scans: dict[int, FloorScan] = {}
        self._near: dict[int, FloorScan] = {}
        self._poses: dict[int, Array | None] = {}
        self._standing = NOWHERE
        """Points (N, 3) that obstacles and what moves have shown since the last command."""
        self._image: Image | None = None
        self._map_ns = 0
        topic = TOPICS['cmd_vel']
        self._commands = graph.recorder.create_publisher(topic.type, topic.name, topic.profile)
        for name, take in (
            ('pose', self._take_pose),
            ('scan', self._take_scan),
            ('obstacle_points', self._take_obstacles),
            ('moving_points', self._take_moving),
            ('obstacle_scan', self._take_near),
            ('map', self._take_map),
            ('contact', self._take_contact),
            ('left/image_raw', self._take_image),
            ('ground_truth', self._take_truth),
            ('frame_done', lambda message: self.answer()),
            ('keyframe/done', lambda message: self.answer()),
        ):
            topic = TOPICS[name]
            graph.recorder.create_subscription(topic.type, name, take, topic.profile)

    @property
    def time_s(self) -> float:
        """The time of the robot."""
        return 1e-9 * max(self.found.true_poses, default=0)

    def answer(self) -> None:
        """Command the robot at the frames that the nodes are done with, or have lost."""
        now_s = time.monotonic()
        while self._waiting:
            stamp_ns, since_s = next(iter(self._waiting.items()))
            if not self._is_done(stamp_ns) and now_s < since_s + PATIENCE_S:
                return
            del self._waiting[stamp_ns]
            self._command(stamp_ns)

    def _is_done(self, stamp_ns: int) -> bool:
        """Whether all that the nodes make of a frame has come."""
        notes = self._recorder.notes
        status = notes.answers.get(stamp_ns)
        if status is None:
            return False
        values = status.values
        is_mapped = values.get('keyframe') != '1' or stamp_ns in notes.failed
        # Of frames that come close together only the newest has scans.
        newest_ns = min(max(scans, default=0) for scans in (self._scans, self._near))
        has_pose = stamp_ns in self._poses and newest_ns >= stamp_ns
        return (is_mapped or self._map_ns >= stamp_ns) and (
            values.get('tracked') != '1' or has_pose
        )

    def _command(self, stamp_ns: int) -> None:
        T_map_base = self._poses.pop(stamp_ns, None)
        scan, near = (scans.get(stamp_ns) for scans in (self._scans, self._near))
        for scans in (self._scans, self._near):
            for older_ns in [ns for ns in scans if ns < stamp_ns]:
                del scans[older_ns]
        if T_map_base is not None:
            self.found.poses[stamp_ns] = T_map_base
            now = NOWHERE if near is None else transform_points(T_map_base, near.ends())
            self._explorer.take_obstacles(self._standing, scan, T_map_base, now)
            self._standing = NOWHERE
        ended = len(self._explorer.ended)
        time_s = 1e-9 * stamp_ns
        stands = time_s < STANDING_S
        forward, turn = STOP if stands else self._explorer.step(time_s, T_map_base)
        for goal in self._explorer.ended[ended:]:
            self.found.goals.append((goal, stamp_ns))
        twist = Twist(linear=Vector3(x=float(forward)), angular=Vector3(z=float(turn)))
        self._commands.publish(TwistStamped(header=make_header(stamp_ns, 'base_link'), twist=twist))

    def _take_truth(self, message: Any) -> None:
        stamp_ns = stamp_of(message)
        self.found.true_poses[stamp_ns] = pose_array(message.pose.pose)
        self.last_sign_s = time.monotonic()
        self._waiting[stamp_ns] = self.last_sign_s

    def _take_pose(self, message: Any) -> None:
        is_known = message.pose.covariance[0] < UNKNOWN_COVARIANCE
        self._poses[stamp_of(message)] = pose_array(message.pose.pose) if is_known else None
        self.answer()

    def _take_scan(self, message: Any) -> None:
        self._scans[stamp_of(message)] = scan_arrays(message, 'scan')
        self.answer()

    def _take_obstacles(self, message: Any) -> None:
        found = sparse_cloud_arrays(message, 'obstacle_points')
        self._standing = np.vstack([self._standing, found.xyz_map])

    def _take_moving(self, message: Any) -> None:
        found = moving_points_arrays(message, 'moving_points')
        self._standing = np.vstack([self._standing, found.xyz_map])

    def _take_near(self, message: Any) -> None:
        self._near[stamp_of(message)] = scan_arrays(message, 'obstacle_scan')
        self.answer()

    def _take_map(self, message: Any) -> None:
        grid = self._explorer.grid = grid_of(message)
        self._map_ns = to_ns(message.header.stamp)
        image = None
        if self._image is not None:
            image = np.asarray(cv2.pyrDown(grey8_image(self._image, 'left/image_raw')), np.uint8)
        self.found.take(Moment(self._map_ns, grid, image))
        self._on_map(self.time_s, grid, self._explorer.phase)
        self.answer()

    def _take_image(self, message: Image) -> None:
        self._image = message

    def _take_contact(self, message: Any) -> None:
        self.found.bumps_ns.append(stamp_of(message))


@dataclass(frozen=True)
class Task:
    """What is to be explored. values: of the scene. truth: its map. start: where the frame of the
    map lies in the scene. slam: values of `stereo_slam`. named: places by name.
    """

    values: list[str]
    robot: Robot
    body: Body
    truth: OccupancyGrid
    start: Pose2d
    slam: dict[str, Any]
    named: dict[str, Any]

    @classmethod
    def of(cls, options: ExploreOptions) -> Task:
        """Open the scene with the robot in it. Raises SegfloorError."""
        robot, of_camera = open_robot(options.robot)
        values = [f'seed={options.seed}', *(options.set_values or ())]
        scene = open_scene(options.scene, [*of_camera, *values])
        with about(options.scene):
            driven = DrivenRobot(scene, robot)
            x, y, yaw = planar(driven.T_world_base(0.0)).tolist()
            truth = true_map(scene, obstacles(scene), floors(scene), np.array([x, y]))
            reachable_floor(truth, robot.radius_m, (x, y, yaw))
        mount = asdict(driven.mount)
        slam: dict[str, Any] = {f'camera_{name}': mount[name] for name in GIVEN}
        start, named = (x, y, yaw), {}
        if options.start_in is not None:
            slam['load_map'] = str((options.start_in / SAVED).absolute())
            named = read_yaml(options.start_in / GOALS, 'names and places')
            summary = read_json(options.start_in / 'summary.json', 'an exploration')
            start = tuple(summary['map_in_scene'])
        speeds = min(robot.speed_m_s, CRUISE_M_S), min(robot.turn_rate_rad_s, TURN_RAD_S)
        body = Body(robot.radius_m, driven.nearest_floor_m(scene), *speeds)
        return cls(values, robot, body, truth, start, slam, named)

    def explorer(self, options: ExploreOptions) -> Explorer:
        """Return who explores, or drives to the goals that are given."""
        if not options.goal:
            return Explorer(self.body, options.goals, options.seed)
        wanted = [Goal(_place(text, self.named), text) for text in options.goal]
        return Explorer(self.body, wanted, options.seed, phase='driving')


def explore_scene(options: ExploreOptions) -> None:
    """Explore as the options say, write what came of it and print its figures. Raises SegfloorError
    where nothing can come of it, typer.Exit after an interrupt.
    """
    check_target(options.out, FILES)
    task = Task.of(options)
    explorer, found = task.explorer(options), Exploration(task.start)
    floor = reachable_floor(task.truth, task.robot.radius_m, task.start)
    goals = len(options.goal) if options.goal else options.goals
    with (
        folder_in_the_making(options.out) as made,
        first_interrupt_noted() as interrupt,
        progress_bar('exploring', 100) as progress,
    ):

        def show(time_s: float, grid: OccupancyGrid, phase: str) -> None:
            share = mapped_share(grid, task.truth, floor, task.start)
            ended = f', {len(explorer.ended)} of {goals} goals' * (phase == 'driving')
            progress(round(100 * share), note=f'of the floor mapped at {time_s:.0f} s{ended}')

        robot = {
            'scene': options.scene,
            'scene_values': shlex.join(task.values),
            'robot': options.robot,
            'depth': options.depth,
        }
        configuration, most_s = resolve(options.params, ()), 60 * options.minutes
        ExploreSession(
            configuration, options.params, robot, task.slam, task.robot.size_m[1] / 2, explorer,
            found, most_s, made / SAVED, show, interrupt,
        ).execute()  # fmt: skip
        if not found.moments:
            raise MapError(f'{options.scene}: no map came of {len(found.true_poses)} frames')
        summary = {
            **figures(found, task.truth, task.robot.radius_m),
            'goals_total': goals,
            'scene': options.scene,
            'robot': options.robot,
            'seed': options.seed,
            'map_in_scene': found.start,
        }
        with os_errors(f'{options.out}: cannot be written'):
            _write(made, found, task.truth, summary, task.named)
            move_into_place(made, options.out)
    if options.as_json:
        print_json(summary)
    rows = [(WORDS.get(name, name), str(value)) for name, value in summary.items()]
    rows = [row for row in rows if row[0] != 'cpu_s']
    console.print(value_table('exploration', rows, options.scene))
    console.print(str(options.out / 'explored.png'), highlight=False, soft_wrap=True)
    if interrupt.status:
        raise typer.Exit(interrupt.status)


def _write(
    folder: Path,
    found: Exploration,
    truth: OccupancyGrid,
    summary: dict[str, Any],
    named: dict[str, Any],
) -> None:
    """Write what an exploration came to. named: goals of earlier ones by name."""
    save_map(found.moments[-1].grid, folder / 'map.yaml')
    save_map(truth, folder / 'true_map.yaml')
    for name, poses in (('trajectory', found.poses), ('ground_truth', found.true_poses)):
        stamps = sorted(poses)
        path = np.array([poses[stamp_ns] for stamp_ns in stamps]).reshape(-1, 4, 4)
        write_tum(folder / f'{name}.txt', Trajectory(np.array(stamps), path))
    places = {goal.name: goal.point.round(3).tolist() for goal, _ in found.goals}
    (folder / GOALS).write_text(yaml.safe_dump({**named, **places}))
    (folder / 'summary.json').write_text(json.dumps(summary, indent=2) + '\n')
    (folder / 'explored.png').write_bytes(picture(found, truth))
    write_film(folder / 'explored.gif', found, truth)


def _place(text: str, named: dict[str, Any]) -> Array:
    """Return the place (2,) of a name, or of `x,y`. Raises SettingsError."""
    try:
        x, y = named.get(text) or text.split(',')
        return np.array([float(x), float(y)])
    except (TypeError, ValueError):
        known = ', '.join(named) or 'none is known without --start-in'
        raise SettingsError(f'--goal {text}: expected X,Y or a name ({known})') from None
