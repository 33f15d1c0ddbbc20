"""The states of a session: each way from one to another, with parts that only answer."""

from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from bundle_problems import CAMERA

from segfloor_ros.core.contracts import FrameResult, LastPose, Mount
from segfloor_ros.core.plugins.maps import session as sessions
from segfloor_ros.core.plugins.maps.session import HARDLY_BEGUN, LOST_NS, MapSession
from segfloor_ros.core.slam import session as core
from segfloor_ros.core.slam.held_results import HeldResults
from segfloor_ros.core.slam.rig import DisparityOffset
from segfloor_ros.core.slam.session import SessionState

MAPPING, RESUMED, LOADED = SessionState.MAPPING, SessionState.RESUMED, SessionState.LOADED
BESIDE, OUTSIDE, LOST = SessionState.BESIDE, SessionState.OUTSIDE, SessionState.LOST
LAST = LastPose(0, np.eye(4), np.eye(4))
STEP_NS = 100_000_000


class Parts:
    """A session and what it works with. found: whether the known map shows the frame."""

    def __init__(self, monkeypatch, last=None, is_loaded=False, keyframes=HARDLY_BEGUN + 1) -> None:
        monkeypatch.setattr(sessions, 'in_merged_map', lambda *_: lambda result: result)
        self.motion = SimpleNamespace(
            state=SimpleNamespace(is_resuming=False),
            T_camera_world=np.eye(4),
            T_world_odom=np.eye(4),
            covariance=np.eye(6),
            reset=MagicMock(),
        )
        self.front_end = MagicMock(motion=self.motion, is_fixed=False, is_searching=True)
        self.known = MagicMock(num_keyframes=keyframes)
        self.known.find.return_value = None, {}
        self.known.recognise.return_value = False
        self.back_end = MagicMock()
        self.back_end.follow = lambda change: change()
        self.hold, self.to_arrays = MagicMock(return_value=self.known), MagicMock(return_value={})
        monkeypatch.setattr(sessions, 'KnownMap', self.hold)
        monkeypatch.setattr(sessions, 'map_and_words', self.to_arrays)
        monkeypatch.setattr(sessions, 'fill_map', MagicMock())
        self.known.to_arrays.return_value = {}
        mount = Mount(0.3, 0.0, 0.0)
        self.map = SimpleNamespace(
            keyframes=[None] * keyframes,
            rig=SimpleNamespace(mount=mount, base_mount=mount, offset=DisparityOffset(CAMERA)),
        )
        self.sensors, self.moving, self.mount_search = MagicMock(), MagicMock(), MagicMock()
        self.parts = core.Parts(
            self.map,
            self.front_end,
            self.back_end,
            self.sensors,
            self.moving,
            self.mount_search,
            HeldResults(self.map.rig),
        )
        self.session = MapSession(self.parts)
        self.now_ns = 0
        if is_loaded:
            self.session.load({sessions.OFFSET: np.zeros(2)}, last)
            self.motion.state.is_resuming = last is not None

    def frame(self, is_tracked: bool = False, fault: str = '') -> list[FrameResult]:
        """Put one frame through the session as `StereoSlam` does; returns what is ready."""
        self.now_ns += STEP_NS
        frame, images = MagicMock(stamp_ns=self.now_ns), MagicMock()
        found, proof = self.session.find_in_loaded(frame, images, fault)
        if (is_tracked or found is not None) and not fault:
            self.session.found(proof)
        else:
            self.session.search(frame, images, fault)
        state = self.session.state
        result = FrameResult(
            self.now_ns // STEP_NS,
            self.now_ns,
            not fault,
            np.eye(4),
            np.eye(4),
            np.eye(6),
            0,
            f'tracking{state.words}',
            0,
            in_submap=state.holds_results,
            outside=state is OUTSIDE,
        )
        return self.session.take(result)

    def lose(self) -> list[FrameResult]:
        """Put frames that are not tracked through the session for as long as it waits."""
        return [result for _ in range(LOST_NS // STEP_NS + 1) for result in self.frame()]

    def map_submap(self, frames: int = 3) -> list[FrameResult]:
        """Track frames in the submap."""
        return [result for _ in range(frames) for result in self.frame(is_tracked=True)]


@pytest.fixture
def make(monkeypatch):
    return lambda **of: Parts(monkeypatch, **of)


@pytest.fixture
def lost(make):
    """A session whose camera got lost and maps a submap."""
    parts = make()
    assert len(parts.lose()) == LOST_NS // STEP_NS
    assert parts.session.state is LOST and parts.map_submap() == []
    return parts


@pytest.fixture
def beside(make):
    """A session that maps a submap, and searches a loaded map."""
    parts = make(is_loaded=True)
    assert parts.session.state is LOADED and parts.map_submap() == []
    assert parts.session.state is BESIDE
    return parts


def test_a_camera_that_is_lost_long_enough_begins_a_submap(make):
    parts = make()
    parts.frame(is_tracked=True)
    for _ in range(LOST_NS // STEP_NS):
        assert len(parts.frame()) == 1 and parts.session.state is MAPPING
    assert parts.frame() == [] and parts.session.state is LOST
    assert parts.hold.call_args.args[-1]  # of this drive
    parts.sensors.reset_world.assert_not_called()


@pytest.mark.parametrize('what', ['a tracked frame', 'a fault', 'a search near a pose'])
def test_what_interrupts_a_search_starts_the_time_anew(make, what):
    parts = make()
    for _ in range(LOST_NS // STEP_NS):
        parts.frame()
    parts.front_end.is_searching = what != 'a search near a pose'
    parts.frame(is_tracked=what == 'a tracked frame', fault='dark' if what == 'a fault' else '')
    parts.front_end.is_searching = True
    for _ in range(LOST_NS // STEP_NS):
        parts.frame()
    assert parts.session.state is MAPPING


@pytest.mark.parametrize('why', ['localize', 'nothing kept'])
def test_no_submap_begins_where_none_may(make, why):
    parts = make()
    parts.front_end.is_fixed = why == 'localize'
    if why == 'nothing kept':
        parts.session = core.OneMap(parts.parts)
    parts.lose()
    assert parts.session.state is MAPPING
    parts.back_end.reset.assert_not_called()


def test_a_map_that_had_hardly_begun_is_dropped(make):
    parts = make(keyframes=HARDLY_BEGUN)
    parts.lose()
    assert parts.session.state is MAPPING
    parts.back_end.reset.assert_called_once()
    parts.hold.assert_not_called()


def test_a_submap_that_is_recognised_joins_the_map(lost):
    assert not lost.session.join(MagicMock(), MagicMock())
    lost.known.recognise.return_value = True
    assert lost.session.join(MagicMock(), MagicMock())
    assert lost.session.state is MAPPING and lost.session.is_public is False
    lost.known.merge.assert_called_once()
    ready = lost.frame(is_tracked=True)
    assert len(ready) == 5 and all(r.tracked for r in ready)
    assert lost.session.is_public
    assert not lost.session.join(MagicMock(), MagicMock())  # nothing is known beside it


@pytest.mark.parametrize('is_seen', [False, True], ids=['time', 'the known map'])
def test_a_submap_in_which_the_camera_is_lost_again_is_dropped(lost, is_seen):
    lost.known.find.return_value = (object() if is_seen else None), {}
    ready = lost.frame() if is_seen else lost.lose()
    assert lost.session.state is MAPPING
    lost.known.restore.assert_called_once()
    assert len(ready) > 4 and ready[0].in_submap and not ready[0].tracked


def test_a_search_near_a_pose_drops_what_is_held(lost):
    lost.session.search_near(np.eye(4), (1.0, 1.0))
    assert lost.session.state is MAPPING
    lost.front_end.search_near.assert_called_once()


@pytest.mark.parametrize('may_replace', [False, True])
@pytest.mark.parametrize('more', [0, 1])
def test_at_the_end_the_larger_of_map_and_submap_stays(lost, may_replace, more):
    lost.known.num_keyframes = len(lost.map.keyframes) - more
    rest = lost.session.finish(may_replace)
    is_kept = bool(may_replace and more)
    assert lost.session.state is MAPPING
    assert [r.tracked for r in rest] == [is_kept] * 4
    assert lost.known.restore.called is not is_kept


def test_the_map_for_a_file_is_the_known_one_while_results_are_held(lost):
    lost.to_arrays.reset_mock()
    lost.known.to_arrays.return_value = {'of': 'the known one'}
    assert lost.session.to_arrays()['of'] == 'the known one'
    lost.to_arrays.assert_not_called()
    lost.session.search_near(np.eye(4), (1.0, 1.0))
    assert 'of' not in lost.session.to_arrays()
    lost.to_arrays.assert_called_once()


def test_a_submap_begins_beside_a_loaded_map_with_the_first_frame(make):
    parts = make(is_loaded=True)
    parts.frame(fault='dark')
    assert parts.session.state is LOADED
    assert parts.frame(is_tracked=True) == [] and parts.session.state is BESIDE
    assert not parts.hold.call_args.args[-1]
    parts.motion.reset.assert_called_once()
    parts.sensors.reset_world.assert_called_once()


def test_a_frame_that_is_found_in_the_loaded_map_drops_the_submap(beside):
    beside.known.find.return_value = object(), {}
    ready = beside.frame()
    assert beside.session.state is MAPPING
    beside.known.restore.assert_called_once()
    assert [r.tracked for r in ready] == [False] * 3 + [True]
    assert not any(r.in_submap for r in ready)


def test_an_image_that_cannot_be_tracked_drops_the_submap_beside_a_loaded_map(beside):
    beside.frame(fault='dark')
    assert beside.session.state is LOADED
    beside.frame(is_tracked=True)
    assert beside.session.state is BESIDE


def test_a_localised_camera_stays_in_the_loaded_map(make):
    parts = make(is_loaded=True)
    parts.front_end.is_fixed = True
    parts.lose()
    assert parts.session.state is LOADED
    parts.frame(is_tracked=True)
    assert parts.session.state is MAPPING


@pytest.mark.parametrize('is_over', [False, True], ids=['time', 'the end'])
def test_a_submap_beside_a_loaded_map_is_returned_late(beside, is_over):
    ready = beside.session.finish(True) if is_over else beside.map_submap(LOST_NS // STEP_NS)
    assert beside.session.state is OUTSIDE
    assert all(r.tracked and r.outside and not r.in_submap for r in ready)
    assert all(r.state.endswith('outside the loaded map') for r in ready)
    assert [r.index for r in ready] == list(range(1, len(ready) + 1))
    assert len(ready) >= 3


def test_a_submap_that_was_returned_late_can_still_join(beside):
    beside.map_submap(LOST_NS // STEP_NS)
    beside.lose()
    assert beside.session.state is OUTSIDE  # it is not dropped
    beside.known.recognise.return_value = True
    assert beside.session.join(MagicMock(), MagicMock())
    assert beside.session.state is MAPPING
    assert beside.sensors.reset_world.call_count == 2


def test_a_resumed_drive_is_in_its_map_once_it_is_found(make):
    parts = make(is_loaded=True, last=LAST)
    assert parts.session.state is RESUMED
    parts.frame(is_tracked=True)
    assert parts.session.state is MAPPING


def test_a_resumed_drive_is_an_ordinary_one_once_sensors_measure_it(make):
    parts = make(is_loaded=True, last=LAST, keyframes=HARDLY_BEGUN)
    parts.frame()
    assert parts.session.state is RESUMED
    parts.motion.state.is_resuming = False
    parts.frame()
    assert parts.session.state is MAPPING


def test_a_resumed_drive_that_is_not_found_maps_from_an_unsure_start(make):
    parts = make(is_loaded=True, last=LAST, keyframes=HARDLY_BEGUN)
    parts.lose()
    assert parts.session.state is LOST  # its map is kept, however small
    assert parts.session.provisional is not None
    np.testing.assert_array_equal(parts.session.covariance, 2 * np.eye(6))
    parts.known.recognise.return_value = True
    assert parts.session.join(MagicMock(), MagicMock())
    np.testing.assert_array_equal(parts.session.covariance, np.eye(6))
