"""One wrong message is one wrong message: the map stays, and no node ends."""

import itertools

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from rcl_interfaces.msg import Log
from std_srvs.srv import Trigger
from stereo_drive import room_drive
from test_saved_maps import LISTENED, PARAMETERS, Chain, last_keyframe

from segfloor_ros.core.files.results import read_map_file
from segfloor_ros.nodes.messages.poses import pose_message
from segfloor_ros.nodes.shared.stamp_order import AGREEING

S = 1_000_000_000
SHIFT_NS = 100 * S


@pytest.fixture(scope='module')
def frames():
    return room_drive(20)[0]


@pytest.fixture
def chain(make_graph) -> Chain:
    assert 'map' in LISTENED
    return Chain(make_graph(*PARAMETERS))


def warnings_of(chain: Chain) -> list[str]:
    """Collect what the nodes log as a warning or worse."""
    found: list[str] = []

    def take(message: Log) -> None:
        if message.level >= 30:  # WARN
            found.append(message.msg)

    chain.graph.tester.create_subscription(Log, '/rosout', take, 100)
    return found


@pytest.mark.parametrize(
    'wrong_ns',
    [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (SHIFT_NS - 5 * S, (2**31 - 2) * S))],
)
def test_a_pair_with_a_wrong_stamp_is_dropped_and_the_map_stays(chain, frames, wrong_ns) -> None:
    answers = chain.drive(frames[:8], SHIFT_NS)
    (answer,) = chain.drive(frames[8:9], wrong_ns - frames[8].stamp_ns)
    assert answer.values.get('tracked') != '1' and 'dropped' in answer.message
    answers += chain.drive(frames[9:], SHIFT_NS)
    assert [a.values['tracked'] for a in answers] == ['1'] * len(answers)
    found = chain.graph.call(Trigger, 'stereo_slam/map_info', Trigger.Request())
    assert found.success
    chain.mapped(last_keyframe(answers))

    def counted() -> list[str]:
        found = [s.values for s in chain.graph.statuses if s.node == 'stereo_slam']
        return [values['dropped'] for values in found if values.get('dropped', '0') != '0']

    chain.graph.until(counted, 'the number of dropped pairs')
    assert counted()[-1] == '1'


def test_a_clock_that_jumps_back_resets_the_map_which_is_saved_first(
    chain, frames, tmp_path
) -> None:
    saved, said = tmp_path / 'kept.map', warnings_of(chain)
    chain.set('stereo_slam', 'save_map', str(saved))
    answers = chain.drive(frames[:8], SHIFT_NS)
    keyframes = sum(a.values.get('keyframe') == '1' for a in answers)
    again = chain.drive(frames[:8])
    assert [a.values.get('tracked', '0') for a in again] == [
        *['0'] * (AGREEING - 1),
        *['1'] * (8 - AGREEING + 1),
    ]
    chain.graph.until(
        lambda: any('the map before the reset is in' in line for line in said), 'the saved map'
    )
    assert any('reset: the stamps of the images went back by 100' in line for line in said)
    parts = read_map_file(saved).parts
    assert set(parts) == {'slam', 'cloud', 'grid'}
    assert len(parts['slam']['keyframe_stamp_ns']) == keyframes
    assert parts['slam']['keyframe_stamp_ns'].min() >= SHIFT_NS


@pytest.mark.slow
def test_images_without_stamps_are_named(chain, frames) -> None:
    said = warnings_of(chain)
    images = [chain._inputs[f'{side}/image_raw'] for side in ('left', 'right')]
    chain.drive(frames[:1], -frames[0].stamp_ns)

    def named() -> bool:
        from segfloor_ros.nodes.messages.images import image_message

        for side, publisher in zip(('left', 'right'), images, strict=True):
            publisher.publish(image_message(0, f'{side}_eye', getattr(frames[1], side)))
        return any('all stamps on left/image_raw are zero' in line for line in said)

    assert chain.graph.comes(named, 30.0)


def test_an_initial_pose_with_a_covariance_that_is_no_number_is_refused(chain, frames) -> None:
    said = warnings_of(chain)
    given = chain.graph.publisher('initialpose')
    chain.graph.connected([given])
    message = PoseWithCovarianceStamped()
    message.header.frame_id = 'map'
    message.pose.pose = pose_message(np.eye(4))
    message.pose.covariance[0] = float('nan')
    given.publish(message)
    chain.graph.until(lambda: any('covariance is not finite' in line for line in said), 'it')
    assert [a.values['tracked'] for a in chain.drive(frames[:4])] == ['1'] * 4


FILES_BY = (
    ('stereo_slam', 'save_map', 'stereo_slam/save_map'),
    ('stereo_slam', 'save_map', 'stereo_slam/prune_map'),
    ('stereo_slam', 'load_map', 'stereo_slam/load_map'),
    ('occupancy_grid', 'map_file', 'save_map'),
)
"""Node, parameter and service that read or write a file."""
MINE = dict.fromkeys(('photo', 'photo.yaml', 'photo.pgm'), 'mine')


def test_no_name_of_a_file_ends_a_node(chain, frames, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for photo, content in MINE.items():
        (tmp_path / photo).write_text(content)
    answers = chain.drive(frames[:6])
    chain.mapped(last_keyframe(answers))
    names = ('~nosuchuser/x.map', 'a' * 300, '/dev/null/x', '/proc/x', 'photo')
    for (node, parameter, service), name in itertools.product(FILES_BY, names):
        chain.set(node, parameter, name)
        answer = chain.graph.call(Trigger, service, Trigger.Request())
        assert (answer.success, answer.message.count('\n')) == (False, 0), (service, name)
        assert name[:40] in answer.message, service
        assert chain.graph.call(Trigger, 'stereo_slam/map_info', Trigger.Request()).success
        assert {path.name: path.read_text() for path in tmp_path.iterdir()} == MINE


def test_what_a_service_raises_is_its_answer(chain, frames, monkeypatch) -> None:
    monkeypatch.setattr(chain.nodes[3], '_stage', None)
    answers = chain.drive(frames[:3])
    assert answers[-1].values['tracked'] == '1'
    monkeypatch.setattr(chain.nodes[3]._part, 'frame_id', 'map')
    answer = chain.graph.call(Trigger, 'save_map', Trigger.Request())
    assert (answer.success, 'NoneType' in answer.message) == (False, True)
    assert chain.graph.call(Trigger, 'stereo_slam/map_info', Trigger.Request()).success
