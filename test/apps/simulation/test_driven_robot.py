"""The robot in MuJoCo: it drives as told and as its wheels let it, and feels what it runs into."""

from importlib.util import find_spec

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from segfloor_ros.apps.simulation.robot import DrivenRobot, open_robot
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.core.errors import InputError

pytestmark = pytest.mark.skipif(find_spec('mujoco') is None, reason='the extra sim')


def robot_in(scene: str, name: str = 'turtlebot3_burger', *values: str) -> DrivenRobot:
    robot, camera = open_robot(name)
    return DrivenRobot(open_scene(scene, [*camera, *values]), robot)


def yaw_of(pose: np.ndarray) -> float:
    return float(Rotation.from_matrix(pose[:3, :3]).as_euler('ZYX')[0])


def test_it_starts_where_the_drive_of_the_scene_does() -> None:
    pose = robot_in('lane').T_world_base(0.0)
    assert pose[:3, 3] == pytest.approx(np.zeros(3), abs=0.001)
    assert yaw_of(pose) == pytest.approx(0.0, abs=0.001)


@pytest.mark.parametrize('name', ['turtlebot3_burger', 'husky'])
def test_both_eyes_sit_so_far_within_it_that_they_see_the_wall_that_it_touches(name) -> None:
    driven, (robot, values), nearest_m = robot_in('lane', name), open_robot(name), 0.02
    baseline_m = open_scene('lane', values).camera.baseline_m
    eyes = driven.mount.T_base_left @ [[0, baseline_m], [0, 0], [0, 0], [1, 1]]
    off_middle_m = np.abs(eyes[:2] - [[robot.middle_m], [0]])
    assert (off_middle_m < np.array(robot.size_m)[:2, None] / 2 - nearest_m).all()


@pytest.mark.parametrize('name', ['turtlebot3_burger', 'husky'])
def test_it_drives_straight_at_the_speed_it_is_told_and_no_faster_than_it_can(name) -> None:
    driven, (published, _) = robot_in('lane', name), open_robot(name)
    driven.drive(0.2, 0.0)
    driven.advance(3.0)
    way = driven.T_world_base(3.0)[:3, 3] - driven.T_world_base(2.2)[:3, 3]
    assert way == pytest.approx([0.16, 0.0, 0.0], abs=0.003)
    assert driven.wheels[-1].T_wheels_base[0, 3] == pytest.approx(0.2 * 3.0 - 0.02, abs=0.01)
    driven.drive(9.0, 0.0)
    driven.advance(5.5)
    way = driven.T_world_base(5.5)[0, 3] - driven.T_world_base(5.0)[0, 3]
    assert way == pytest.approx(0.5 * published.speed_m_s, rel=0.02)


def test_it_turns_on_the_spot_as_its_wheels_and_its_gyroscope_measure() -> None:
    driven = robot_in('lane')
    driven.drive(0.0, 0.6)
    driven.advance(3.0)
    turned = yaw_of(driven.T_world_base(3.0))
    assert turned == pytest.approx(0.6 * 3.0, rel=0.05)
    assert np.hypot(*driven.T_world_base(3.0)[:2, 3]) < 0.03
    assert yaw_of(driven.wheels[-1].T_wheels_base) == pytest.approx(turned, rel=0.05)
    # The base turns about what is up in the camera.
    rate = [sample.gyro_rad_s @ driven.mount.up_in_camera for sample in driven.imu]
    assert np.sum(rate) / 100 == pytest.approx(turned, rel=0.05)


def test_standing_its_accelerometer_measures_gravity() -> None:
    driven = robot_in('lane')
    driven.advance(1.0)
    mean = np.mean([sample.accel_m_s2 for sample in driven.imu], axis=0)
    assert mean == pytest.approx(9.81 * driven.mount.up_in_camera, abs=0.1)
    stamps = [sample.stamp_ns for sample in driven.imu]
    assert set(np.diff(stamps)) == {10_000_000}


def test_it_stops_as_soon_when_it_also_has_to_turn() -> None:
    driven = robot_in('lane', 'husky')
    driven.drive(0.4, 0.3)
    driven.advance(2.0)
    driven.drive(0.0, -0.6)
    driven.advance(3.0)
    before, after = driven.T_world_base(2.0), driven.T_world_base(3.0)
    assert np.hypot(*(after - before)[:2, 3]) == pytest.approx(0.4**2 / 2, abs=0.02)


@pytest.mark.parametrize('command', [(0.0, 0.3), (0.0, 0.8), (0.5, 0.3), (0.3, -0.6)])
def test_four_wheels_slip_in_a_turn_by_about_as_much_as_its_controller_knows(command) -> None:
    driven = robot_in('hall', 'husky')
    driven.drive(*command)
    driven.advance(3.0)
    turned = yaw_of(driven.T_world_base(3.0))
    assert turned == pytest.approx(command[1] * 3.0, rel=0.2)
    assert yaw_of(driven.wheels[-1].T_wheels_base) == pytest.approx(turned, rel=0.2)


def test_a_wall_stops_it_and_is_one_bump_while_its_wheels_go_on() -> None:
    driven = robot_in('low_box', 'turtlebot3_burger', 'boxes=[{at: [0.6, 0], size: [0.1, 1, 0.5]}]')
    driven.drive(0.22, 0.0)
    driven.advance(6.0)
    ((time_s, place),) = driven.bumps
    front_m = 0.55 - (-0.032 + 0.138 / 2)
    assert time_s == pytest.approx(front_m / 0.22, abs=0.3)
    assert place[0] == pytest.approx(-0.032 + 0.138 / 2, abs=0.01)
    assert driven.T_world_base(6.0)[0, 3] == pytest.approx(front_m, abs=0.02)
    assert driven.wheels[-1].T_wheels_base[0, 3] > front_m + 0.3


def test_a_car_drives_into_it() -> None:
    car = 'cars=[{points: [[4, 0], [-1, 0]], speed_m_s: 1.0, size: [2, 1, 1]}]'
    driven = robot_in('lane', 'turtlebot3_burger', car)
    driven.advance(4.0)
    front_m = -0.032 + 0.138 / 2
    assert driven.bumps[0][0] == pytest.approx(3.0 - front_m, abs=0.1)


def test_people_wait_for_it_and_walk_on_when_it_is_out_of_their_way() -> None:
    person = 'people=[{points: [[2, 0], [-1, 0]], speed_m_s: 1.0, returns: false}]'
    driven = robot_in('lane', 'turtlebot3_burger', person)
    driven.advance(5.0)
    assert not driven.bumps
    (waited_s,) = driven.mover_times_s(5.0)
    # The robot turns within 0.135 m, the person is 0.5 m thick.
    assert 2.0 - waited_s == pytest.approx(0.135 + 0.25 + 0.45, abs=0.02)
    driven.drive(-0.2, 0.6)
    driven.advance(5.0 + 0.5 * np.pi / 0.6)
    driven.drive(-0.2, 0.0)
    driven.advance(12.0)
    assert not driven.bumps
    assert driven.mover_times_s(12.0)[0] > 3.0


@pytest.mark.parametrize(('end', 'bumps'), [((4, 0), 0), ((0.3, 0), 1)])
def test_a_crate_that_is_put_down_touches_only_what_is_where_it_is_put(end, bumps) -> None:
    crate = f'{{points: [[-4, 0], [{end[0]}, {end[1]}]], size: [0.4, 0.4, 0.4], '
    crates = f'moving_boxes=[{crate} speed_m_s: 100, start_s: 1, stays_s: 40}}]'
    driven = robot_in('lane', 'turtlebot3_burger', crates)
    driven.advance(2.0)
    driven.drive(0.2, 0.0)
    driven.advance(4.0)
    assert len(driven.bumps) == bumps


def test_people_who_have_waited_for_it_turn_round() -> None:
    person = 'people=[{points: [[2, 0], [-1, 0]], speed_m_s: 1.0, returns: false}]'
    driven = robot_in('lane', 'turtlebot3_burger', person)
    walked_s = []
    for time_s in (6.0, 7.5, 8.5):
        driven.advance(time_s)
        walked_s.append(driven.mover_times_s(time_s)[0])
    # He waits from 1.2 s on, has walked back by 7.4 s, and comes again.
    assert walked_s == pytest.approx([1.165, 0.1, 1.1], abs=0.15)


def test_people_go_back_before_it_where_it_comes_too_near() -> None:
    person = 'people=[{points: [[2, 0], [-1, 0]], speed_m_s: 0.5, returns: false}]'
    driven = robot_in('lane', 'turtlebot3_burger', person)
    driven.advance(4.0)
    driven.drive(0.2, 0.0)
    driven.advance(8.0)
    person_m = 2.0 - 0.5 * driven.mover_times_s(8.0)[0]
    assert not driven.bumps
    assert person_m - driven.T_world_base(8.0)[0, 3] == pytest.approx(0.135 + 0.25 + 0.45, abs=0.02)


def test_people_do_not_walk_past_it_within_reach_of_its_turn() -> None:
    past = 'people=[{points: [[2, 0.5], [-2, 0.5]], speed_m_s: 1.0, returns: false}]'
    driven = robot_in('lane', 'turtlebot3_burger', past)
    driven.advance(6.0)
    reached_m = 2.0 - driven.mover_times_s(6.0)[0]
    assert np.hypot(reached_m, 0.5) == pytest.approx(0.135 + 0.25 + 0.45, abs=0.02)


def test_a_crate_stops_it_where_somebody_has_put_it_down_and_no_longer_when_it_is_gone() -> None:
    crate = 'moving_boxes=[{points: [[0.5, 4], [0.5, 0]], size: [0.4, 0.2, 0.3], speed_m_s: 100, '
    driven = robot_in('lane', 'turtlebot3_burger', crate + 'start_s: 0.5, stays_s: 4}]')
    driven.drive(0.2, 0.0)
    driven.advance(4.0)
    front_m = -0.032 + 0.138 / 2
    assert driven.T_world_base(4.0)[0, 3] + front_m == pytest.approx(0.4, abs=0.01)
    assert len(driven.bumps) == 1
    driven.advance(7.0)
    assert driven.T_world_base(7.0)[0, 3] > 0.6


def test_a_robot_that_there_is_not_is_refused_with_one_like_it() -> None:
    with pytest.raises(InputError, match=r'huski: no such robot.*husky'):
        open_robot('huski')
