"""`segfloor explore`: a simulated robot maps a scene by itself and drives to goals on its map."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
import yaml

from segfloor_ros.cli import terminal
from segfloor_ros.cli.terminal import console, value_table
from segfloor_ros.configuration import resolve
from segfloor_ros.errors import MapError, SettingsError, about, os_errors
from segfloor_ros.files.results import check_target, folder_in_the_making, move_into_place
from segfloor_ros.files.whole import read_json, read_yaml
from segfloor_ros.geometry import Array, planar
from segfloor_ros.grid.map_file import OccupancyGrid, save_map
from segfloor_ros.processes import first_interrupt_noted
from segfloor_ros.trajectory import Trajectory, write_tum

if TYPE_CHECKING:
    from segfloor_ros.evaluation.exploration import Exploration
    from segfloor_ros.evaluation.maps import Pose2d

GOALS, SAVED = 'goals.yaml', 'saved.map'
FILES = (GOALS, SAVED, 'map.pgm', 'map.yaml', 'true_map.pgm', 'true_map.yaml', 'trajectory.txt',
         'ground_truth.txt', 'summary.json', 'explored.png', 'explored.gif')  # fmt: skip

CRUISE_M_S, TURN_RAD_S = 0.4, 0.6
"""No faster, whatever the robot can: SLAM follows these surely."""


def explore(
    scene: Annotated[
        str,
        typer.Argument(
            help='Name of a shipped scene, a scene file, or a map_server map (YAML) to explore.'
        ),
    ],
    out: terminal.Out,
    robot: Annotated[
        str, typer.Option(help='The robot: turtlebot3_burger or husky.')
    ] = 'turtlebot3_burger',
    goals: Annotated[int, typer.Option(min=0, help='Goals to draw at random and to drive to.')] = 5,
    seed: Annotated[int, typer.Option(min=0, help='Of the goals, the textures and the noise.')] = 1,
    goal: Annotated[
        list[str] | None,
        typer.Option(
            help='Drive to this place and explore nothing: a name in goals.yaml of --start-in, or '
            'X,Y in its map; repeatable.'
        ),
    ] = None,
    start_in: Annotated[
        Path | None, typer.Option(help='Start in the map of this earlier exploration, be found.')
    ] = None,
    minutes: Annotated[
        float, typer.Option(min=0.1, help="At most so long, in the robot's time.")
    ] = 30.0,
    depth: terminal.Depth = False,
    set_values: Annotated[
        list[str] | None,
        typer.Option('--set', help='One value of the scene, e.g. camera.height_m=0.4; repeatable.'),
    ] = None,
    params: terminal.Params = None,
) -> None:
    """Let a simulated robot explore a scene by the map that the nodes make, then drive to goals.

    \b
    segfloor explore complex_room --out explored
    segfloor explore office.yaml --out explored --robot husky --goals 20 --seed 3
    segfloor explore complex_room --out again --start-in explored --goal goal_2
    """
    # Imported here: simulator and pictures take time that other commands should not wait for.
    from segfloor_ros.evaluation import exploration
    from segfloor_ros.navigation import Body, Explorer, Goal
    from segfloor_ros.simulation.robot import DrivenRobot, open_robot
    from segfloor_ros.simulation.scene_file import open_scene
    from segfloor_ros.simulation.solids import floors, obstacles, true_map

    try:
        from segfloor_ros.cli.explore_session import ExploreSession
    except ImportError as error:
        raise SettingsError(
            f'explore needs ROS 2 ({error}); source a ROS 2 installation or install the extra: '
            "pip install 'segfloor_ros[ros]'"
        ) from None
    check_target(out, FILES)
    published, of_camera = open_robot(robot)
    values = [f'seed={seed}', *(set_values or ())]
    described = open_scene(scene, [*of_camera, *values])
    with about(scene):
        driven = DrivenRobot(described, published)
        x, y, yaw = planar(driven.T_world_base(0.0)).tolist()
        solids = obstacles(described), floors(described)
        truth = true_map(described, *solids, np.array([x, y]))
    start: Pose2d = (x, y, yaw)
    floor = exploration.reachable_floor(truth, published.radius_m, start)
    body = Body(
        published.radius_m,
        driven.nearest_floor_m(described),
        min(published.speed_m_s, CRUISE_M_S),
        min(published.turn_rate_rad_s, TURN_RAD_S),
    )
    slam: dict[str, Any] = {
        'camera_height_m': driven.mount.height_m,
        'camera_pitch_rad': driven.mount.pitch_rad,
        'camera_roll_rad': driven.mount.roll_rad,
        'camera_forward_m': driven.mount.forward_m,
    }
    named: dict[str, Any] = {}
    if start_in is not None:
        slam['load_map'] = str((start_in / SAVED).absolute())
        named = read_yaml(start_in / GOALS, 'names and places')
        start = tuple(read_json(start_in / 'summary.json', 'an exploration')['map_in_scene'])
    explorer = Explorer(body, goals, seed)
    if goal:
        wanted = [Goal(_place(text, named), text) for text in goal]
        explorer = Explorer(body, wanted, seed, phase='driving')
    found = exploration.Exploration(start)
    with (
        folder_in_the_making(out) as made,
        first_interrupt_noted() as interrupt,
        terminal.progress_bar('exploring', 100) as progress,
    ):

        def show(time_s: float, grid: OccupancyGrid, phase: str) -> None:
            share = exploration.mapped_share(grid, truth, floor, start)
            ended = f', {len(explorer.ended)} of {goals} goals' if phase == 'driving' else ''
            progress(round(100 * share), note=f'of the floor mapped at {time_s:.0f} s{ended}')

        session = ExploreSession(
            resolve(params, ()),
            params,
            {'scene': scene, 'scene_values': shlex.join(values), 'robot': robot, 'depth': depth},
            slam,
            explorer,
            found,
            60 * minutes,
            made / SAVED,
            show,
            interrupt,
        )
        session.execute()
        if not found.maps:
            raise MapError(f'{scene}: no map came of {len(found.true_poses)} frames')
        summary = {
            **exploration.figures(found, truth, published.radius_m),
            'goals_total': len(goal) if goal else goals,
            'scene': scene,
            'robot': robot,
            'seed': seed,
            'map_in_scene': start,
        }
        with os_errors(f'{out}: cannot be written'):
            _write(made, found, truth, summary, named)
            move_into_place(made, out)
    rows = [(name, str(value)) for name, value in summary.items() if name != 'cpu_s']
    console.print(value_table('exploration', rows, scene))
    console.print(str(out / 'explored.png'), highlight=False, soft_wrap=True)
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
    from segfloor_ros.evaluation.exploration import picture, write_film

    save_map(found.maps[-1][1], folder / 'map.yaml')
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
