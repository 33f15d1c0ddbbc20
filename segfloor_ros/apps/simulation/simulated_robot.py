"""Node `simulated_robot`: speeds in; what a robot with a stereo or a depth camera measures in a
rendered scene out, and what is true of it.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import Point, PointStamped, Twist, TwistStamped
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from segfloor_ros.apps.simulation.robot import DrivenRobot, open_robot
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.simulation import SimulatedFrame, Simulation
from segfloor_ros.nodes.messages.camera_infos import camera_info_message
from segfloor_ros.nodes.messages.diagnostics import Level
from segfloor_ros.nodes.messages.images import image_message
from segfloor_ros.nodes.messages.odometry import odometry_message
from segfloor_ros.nodes.messages.poses import transform_message
from segfloor_ros.nodes.messages.sensors import imu_message, wheel_message
from segfloor_ros.nodes.messages.topics import (
    FRAMES,
    ROBOT,
    TOPICS,
    Topic,
    make_header,
    published_by,
    stamp_of,
    to_time,
)
from segfloor_ros.nodes.settings.robot import SimulatedRobotNodeSettings
from segfloor_ros.nodes.shared.inputs import LOOK_S
from segfloor_ros.nodes.shared.running import run_node
from segfloor_ros.nodes.shared.stage_node import StageNode
from segfloor_ros.nodes.shared.tf_link import TfLink
from segfloor_ros.nodes.stereo_camera import ClockPace

WORLD, BASE = 'world', 'base_link'

LOOK_AHEAD_S = 0.05
"""The camera's exposure, and the lag of one eye, end so long after the stamp at most."""


class SimulatedRobotNode(StageNode[SimulatedRobotNodeSettings]):
    """Lets the robot drive from frame to frame, and publishes each."""

    settings_type = SimulatedRobotNodeSettings

    def output_topics(self) -> Sequence[Topic]:
        """Return those of the camera that the robot has, and the others."""
        left_out = 'right/' if self.settings.depth else 'depth/'
        mine = published_by(ROBOT, alternatives=True)
        return [topic for topic in mine if not topic.name.startswith(left_out)]

    def set_up(self) -> None:
        """Build the scene and make the topics."""
        own = self.settings
        robot, of_camera = open_robot(own.robot)
        of_depth = ['sensors.depth.max_m=6.0'] if own.depth else []
        self._scene = open_scene(own.scene, [*of_camera, *of_depth, *shlex.split(own.scene_values)])
        self._body = robot
        kind = TwistStamped if own.stamped_commands else Twist
        profile = TOPICS['cmd_vel'].profile
        heard = self.create_subscription(kind, 'cmd_vel', self._take_command, profile)
        self.outputs.at_clean_up(lambda: self.destroy_subscription(heard))
        self._time_output: Publisher = self.create_publisher(Clock, '/clock', FRAMES)
        self.outputs.at_clean_up(lambda: self.destroy_publisher(self._time_output))
        self._transforms = TfLink(self)
        self._transforms.stop_listening()
        self.inputs.repeat(self._advance)
        self.states.pause(own.start_paused)
        self._simulation: Simulation | None = None
        self.outputs.at_clean_up(self._close)

    def reset_stage(self) -> None:
        """Put the robot where it starts."""
        self._close()
        self._robot = DrivenRobot(self._scene, self._body)
        self._simulation = Simulation(self._scene, robot=self._robot)
        T_base_left = self._robot.mount.T_base_left
        mount = transform_message(0, BASE, self.settings.left_frame, T_base_left)
        self._transforms.send_fixed(mount)
        self._commands: dict[int, tuple[float, float]] = {}
        self._stamps_ns: list[int] = []
        self._pace = ClockPace(self.settings.rate or math.inf)

    def find_problems(self) -> None:
        """Report commands of the other kind, which do not arrive."""
        is_stamped = self.settings.stamped_commands
        other = Twist if is_stamped else TwistStamped
        infos = self.get_publishers_info_by_topic('cmd_vel')
        if any(info.topic_type.endswith(f'/{other.__name__}') for info in infos):
            text = (
                f'cmd_vel is published as {other.__name__}, which this node does not take; set '
                f'stamped_commands to {str(not is_stamped).lower()}'
            )
            self.reporter.diagnose('kind of cmd_vel', text, Level.ERROR)

    def on_inputs_opened(self) -> None:
        """Keep the pace from here on."""
        self._pace.restart()

    def _close(self) -> None:
        if self._simulation is not None:
            self._simulation.__exit__()
            self._simulation = None

    def _take_command(self, message: TwistStamped | Twist) -> None:
        twist = message.twist if isinstance(message, TwistStamped) else message
        latest_ns = self._stamps_ns[-1] if self._stamps_ns else 0
        stamp_ns = stamp_of(message) if self._is_in_step else latest_ns
        self._commands[stamp_ns] = float(twist.linear.x), float(twist.angular.z)
        if self.inputs.is_open and self._is_in_step:
            self._advance()

    @property
    def _is_in_step(self) -> bool:
        return not self.settings.rate

    def _advance(self) -> float:
        """Go on to the next frame if its time has come; returns when to look again, in s."""
        index = len(self._stamps_ns)
        stamp_ns = round(1e9 * (index + 1) / self._scene.camera.rate_hz)
        wait_s = self._wait_s(index, stamp_ns)
        if wait_s > 0:
            return wait_s
        self._obey(index, stamp_ns)
        self._robot.advance(1e-9 * stamp_ns + LOOK_AHEAD_S)
        assert self._simulation is not None
        frame = self._simulation.frame_at(index, 1e-9 * stamp_ns)
        self._pace.sent(stamp_ns)
        self._stamps_ns.append(stamp_ns)
        self._publish(stamp_ns, frame)
        return 0.0

    def _wait_s(self, index: int, stamp_ns: int) -> float:
        """Return how long to wait for the time of a frame, or for who drives the robot. While one
        frame is worked on the next is rendered.
        """
        if not index and not self.outputs.listeners('left/image_raw'):
            return LOOK_S
        if not self._is_in_step:
            return self._pace.wait_s(stamp_ns)
        return LOOK_S if index > 1 and self._stamps_ns[index - 2] not in self._commands else 0.0

    def _obey(self, index: int, stamp_ns: int) -> None:
        """Drive as commanded last, but not after a while without commands; in step as commanded at
        the frame before the last, however long ago that is.
        """
        given = self._commands
        last_ns, is_late = max(given, default=0), False
        if self._is_in_step:
            last_ns = self._stamps_ns[index - 2] if index > 1 else 0
        else:
            is_late = stamp_ns - last_ns > 1e9 * self.settings.command_timeout_s
        self._robot.drive(*((0.0, 0.0) if is_late or not last_ns else given[last_ns]))
        self._commands = {ns: command for ns, command in given.items() if ns >= last_ns}

    def _publish(self, stamp_ns: int, frame: SimulatedFrame) -> None:
        out, own, robot = self.outputs, self.settings, self._robot
        assert self._simulation is not None
        self._time_output.publish(Clock(clock=to_time(stamp_ns)))
        truth = odometry_message(
            stamp_ns, WORLD, BASE, robot.T_world_base(frame.time_s), np.zeros((6, 6))
        )
        out.publish('ground_truth', truth)
        for time_s, place in robot.bumps:
            header = make_header(round(1e9 * time_s), BASE)
            x, y, z = place.tolist()
            out.publish('contact', PointStamped(header=header, point=Point(x=x, y=y, z=z)))
        for wheels in robot.wheels:
            out.publish('wheel_odometry', wheel_message(wheels, BASE))
        raw = self._simulation.imaging.raw
        for sample in robot.imu:
            out.publish('imu', imu_message(sample, own.left_frame, raw[0].R.T))
        robot.forget_measurements()
        sides = [('left', frame.left, own.left_frame, raw[0])]
        if frame.depth_mm is not None:
            depth = image_message(stamp_ns, own.left_frame, frame.depth_mm)
            depth.encoding = '16UC1'
            out.publish('depth/image_raw', depth)
        else:
            sides.append(('right', frame.right, own.right_frame, raw[1]))
        for side, image, frame_id, eye in sides:
            out.publish(f'{side}/camera_info', camera_info_message(stamp_ns, frame_id, eye))
            out.publish(f'{side}/image_raw', image_message(stamp_ns, frame_id, image))
        self.reporter.report(stamp_ns, Level.OK, 'sent', frame_index=frame.index)


def main() -> None:
    """Run the node."""
    run_node(SimulatedRobotNode)


if __name__ == '__main__':
    main()
