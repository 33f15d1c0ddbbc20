import pytest

from segfloor_ros.nodes.stereo_camera import (
    MAX_FRAMES_UNDER_WAY,
    MAX_KEYFRAMES_UNDER_WAY,
    PATIENCE_S,
    ChainPace,
    ClockPace,
)

S = 1_000_000_000


def test_the_clock_starts_with_the_first_frame_and_runs_at_the_rate() -> None:
    now = [100.0]
    pace = ClockPace(2.0, clock_s=lambda: now[0])
    assert pace.wait_s(7 * S) == 0
    pace.sent(7 * S)
    assert pace.wait_s(8 * S) == pytest.approx(0.5)
    now[0] = 100.49
    assert pace.wait_s(8 * S) == pytest.approx(0.01)
    now[0] = 100.51
    assert pace.wait_s(8 * S) == 0
    pace.restart()
    assert pace.wait_s(1000 * S) == 0


def test_few_frames_are_under_way_at_a_time() -> None:
    pace = ChainPace()
    for stamp in range(MAX_FRAMES_UNDER_WAY):
        assert pace.ready()
        pace.sent(stamp)
    assert not pace.ready()
    assert 'stamp 0' in pace.waits_for()
    pace.frame_done(-1)
    assert not pace.ready()
    pace.frame_done(0)
    assert pace.ready()


def test_the_answer_to_a_frame_is_the_end_of_those_before_it() -> None:
    """They are answered in order: what has none yet never had one."""
    pace = ChainPace()
    for stamp in range(MAX_FRAMES_UNDER_WAY):
        pace.sent(stamp)
    pace.frame_done(MAX_FRAMES_UNDER_WAY - 1)
    for stamp in range(MAX_FRAMES_UNDER_WAY - 1):
        pace.sent(100 + stamp)
        assert pace.ready()
    for stamp in range(MAX_KEYFRAMES_UNDER_WAY):
        pace.keyframe_began(200 + stamp)
    pace.keyframe_done(200 + MAX_KEYFRAMES_UNDER_WAY - 1)
    assert pace.ready()


def test_what_is_lost_under_way_is_given_up_after_a_while_without_any_sign() -> None:
    now = [100.0]
    pace = ChainPace(lambda: now[0])
    for stamp in range(MAX_FRAMES_UNDER_WAY):
        pace.sent(stamp)
    now[0] += PATIENCE_S - 1
    pace.keyframe_began(7)
    pace.keyframe_done(7)
    now[0] += PATIENCE_S - 1
    assert pace.give_up() == ''
    assert not pace.ready()
    now[0] += 2
    assert pace.give_up() == f'{MAX_FRAMES_UNDER_WAY} frames and 0 keyframes'
    assert pace.ready()
    assert pace.give_up() == ''
    for stamp in range(MAX_FRAMES_UNDER_WAY):
        pace.sent(stamp)
    pace.drop_frames()
    assert pace.ready()


def test_keyframes_count_until_they_go_no_further() -> None:
    pace = ChainPace()
    for stamp in range(MAX_KEYFRAMES_UNDER_WAY):
        pace.sent(stamp)
        pace.frame_done(stamp)
        pace.keyframe_began(stamp)
    assert not pace.ready()
    assert 'the keyframe with stamp 0' in pace.waits_for()
    pace.keyframe_done(0)
    assert pace.ready()
    pace.keyframe_began(9)
    assert not pace.ready()
    pace.keyframe_done(1)
    assert pace.ready()


def test_the_end_of_a_keyframe_may_be_heard_of_before_its_beginning() -> None:
    pace = ChainPace()
    for stamp in range(10):
        pace.keyframe_done(stamp)
        pace.keyframe_began(stamp)
        assert pace.ready()
