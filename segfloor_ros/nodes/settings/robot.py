"""Parameters of the node `simulated_robot`."""

from __future__ import annotations

from dataclasses import dataclass

from segfloor_ros.core.settings import setting
from segfloor_ros.nodes.settings.shared import NodeSettings


@dataclass(frozen=True)
class SimulatedRobotNodeSettings(NodeSettings):
    """Which robot drives where, and when its time goes on."""

    scene: str = setting(
        'hall', 'Name of a shipped scene, a scene file, or a map_server map (YAML) to drive in.'
    )
    scene_values: str = setting(
        '',
        'Values of the scene, e.g. camera.height_m=0.4, quoted and separated as words of a shell.',
    )
    robot: str = setting(
        'turtlebot3_burger', 'The robot, as published.', choices=('turtlebot3_burger', 'husky')
    )
    depth: bool = setting(False, 'A depth camera: depth/image_raw in place of the right images.')
    rate: float = setting(
        1.0,
        'Speed of its time against real time, less where the rendering takes longer; 0: in step '
        'with the driving node, one frame per command with the stamp of the last frame.',
        within=(0.0, 100.0),
    )
    stamped_commands: bool = setting(
        True, 'Take cmd_vel as TwistStamped, which driving in step needs; off: Twist.'
    )
    command_timeout_s: float = setting(
        0.5, 'The robot stops without a command for this time.', within=(0.05, 60.0)
    )
    start_paused: bool = setting(False, 'Wait for the service ~/pause before the first frame.')
    left_frame: str = setting('left_camera_optical_frame', 'Optical frame of the left camera.')
    right_frame: str = setting('right_camera_optical_frame', 'Optical frame of the right camera.')
