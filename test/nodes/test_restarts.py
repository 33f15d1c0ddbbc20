"""Each node killed without warning and started again in the middle of a drive."""

import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from node_chain import CHAIN, NodeChain, seen_again
from node_messages import grid_arrays
from ros_graph import fresh_graph, surroundings
from std_srvs.srv import Trigger
from stereo_drive import room_drive, write_kitti

from segfloor_ros.core.contracts import POINT_UNKNOWN, LabelledPoints, StereoFrame
from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.core.files.results import read_map_file
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.core.slam.places.views import NEW_TURN_RAD
from segfloor_ros.nodes.kept_state import KeptState
from segfloor_ros.nodes.messages.diagnostics import Level, Status
from segfloor_ros.nodes.messages.points import labelled_arrays
from segfloor_ros.nodes.messages.poses import path_arrays, pose_array
from segfloor_ros.nodes.messages.saved_maps import map_file_message, map_file_of
from segfloor_ros.nodes.messages.topics import (
    BEHIND,
    CAMERA,
    GRID,
    IMAGES,
    MAP_LOADED,
    MAP_PART,
    SLAM,
    to_ns,
)

NEW_VIEW_RAD = 1.1 * NEW_TURN_RAD
"""Turn per frame: every one is a new view, which becomes a keyframe."""

PLACES = 110
"""More than are driven past: a place that is seen again makes no keyframe."""
STEP_M = 0.05
FRAME_NS = 100_000_000
RECEIVED = ('map', 'labelled_points', 'odometry', 'pose', 'keyframe/path', MAP_PART)
REJOIN_S, FOUND_S = 60.0, 3.0


@pytest.fixture(scope='module')
def drive():
    return room_drive(PLACES, step_m=STEP_M, arc_rad=NEW_VIEW_RAD)


class Journey:
    """A drive to and fro through the chain, with the map and the cloud at every keyframe."""

    def __init__(self, chain: NodeChain, drive) -> None:
        self.chain = chain
        self._views, self._poses = drive
        self._count, self._stood = 0, 0
        self._truth: dict[int, np.ndarray] = {}
        self._received = {n: chain.graph.collect(n) for n in RECEIVED}

    def step(self) -> Status:
        """Drive on by one frame and return SLAM's answer to it."""
        return self.chain.drive([self.next()])[0]

    def next(self) -> StereoFrame:
        """Return the next frame."""
        turn = 2 * (PLACES - 1)
        place = (self._count - self._stood) % turn
        place = min(place, turn - place)
        frame = seen_again(self._views[place], self._count, self._count * FRAME_NS)
        self._count += 1
        self._truth[frame.stamp_ns] = invert(self._poses[0]) @ self._poses[place]
        return frame

    def stand(self) -> StereoFrame:
        """Return the next frame of a robot that waits here: how many nobody hears while a node
        starts is up to the machine, and must not be how far it has driven.
        """
        frame = self.next()
        self._stood += 1
        return frame

    def miss(self, count: int) -> None:
        """Let the robot drive on unseen."""
        self._count += count

    def rejoin(self) -> None:
        """Drive until a keyframe reaches the map again: the nodes must find each other first."""
        begun, end_s = len(self.chain.graph.statuses), time.monotonic() + REJOIN_S
        while not any(
            s.node == GRID and not s.kind and s.level is Level.OK
            for s in self.chain.graph.statuses[begun:]
        ):
            assert time.monotonic() < end_s
            self.step()

    def keyframes(self, count: int) -> tuple[OccupancyGrid, LabelledPoints]:
        """Drive until there are so many more keyframes; return map and cloud of the last one."""
        for _ in range(PLACES):
            if count == 0:
                break
            answer = self.step()
            assert answer.values['tracked'] == '1', answer
            if answer.values['keyframe'] == '1':
                self.chain.mapped(answer.stamp_ns)
                count -= 1
        assert count == 0, 'no more keyframes are made'
        return (
            grid_arrays(self.wait_for('map', answer.stamp_ns), 'map'),
            labelled_arrays(self.wait_for('labelled_points', answer.stamp_ns), 'labelled_points'),
        )

    def received(self, name: str) -> list:
        """Return the messages of a topic so far."""
        return self._received[name]

    def settle(self):
        """Drive on until every node had the time to keep its map; return the last odometry."""
        for _ in range(5):
            answer = self.step()
            time.sleep(0.1)
        return self.wait_for('odometry', answer.stamp_ns)

    def latest(self, name: str):
        """Return the last message of a topic."""
        return self.received(name)[-1]

    def truth(self, stamp_ns: int) -> np.ndarray:
        """Return the true pose (4, 4) of a frame."""
        return self._truth[int(stamp_ns)]

    def odometry_error_m(self) -> float:
        """Return how far the last pose is from the truth."""
        message = self.latest('odometry')
        T_odom_base = pose_array(message.pose.pose)
        truth = self._truth[to_ns(message.header.stamp)]
        return float(np.linalg.norm(T_odom_base[:3, 3] - truth[:3, 3]))

    def wait_for(self, name: str, stamp_ns: int):
        """Return the message of a topic with a stamp."""

        def found():
            return [m for m in self._received[name] if to_ns(m.header.stamp) == stamp_ns]

        self.chain.graph.until(found, f'{name} at {stamp_ns}')
        return found()[-1]


@pytest.fixture(scope='module')
def journey(tmp_path_factory, drive):
    with fresh_graph() as graph:
        chain = NodeChain(graph, tmp_path_factory.mktemp('logs'))
        try:
            journey = Journey(chain, drive)
            chain.start(*CHAIN)
            journey.keyframes(4)
            yield journey
        finally:
            chain.stop()


@pytest.mark.slow
@pytest.mark.parametrize('node', CHAIN)
def test_a_node_that_is_killed_goes_on_where_it_was(journey, node) -> None:
    chain = journey.chain
    grid, cloud = journey.keyframes(1)
    journey.settle()
    chain.kill(node)
    journey.miss(2)
    chain.start(node)
    chain.wake(journey.stand)
    journey.rejoin()
    grid_after, cloud_after = journey.keyframes(2)
    assert journey.odometry_error_m() < 0.03
    known, known_after = known_cells(grid), known_cells(grid_after)
    assert len(known & known_after.keys()) >= 0.98 * len(known)
    same = [known[cell] == known_after[cell] for cell in known.keys() & known_after.keys()]
    assert np.mean(same) > 0.97
    ids = cloud_after.point_id
    assert (np.diff(ids) > 0).all()
    both = np.intersect1d(cloud.point_id[cloud.label != POINT_UNKNOWN], ids)
    assert len(both) > 100
    rows = np.searchsorted(ids, both)
    assert (cloud_after.label[rows] != POINT_UNKNOWN).mean() > 0.95
    assert 'Traceback' not in chain.log(node)
    assert 'resumed with the map' in chain.log(node)


@pytest.mark.slow
@pytest.mark.parametrize('node', BEHIND)
def test_keyframes_that_come_while_a_node_is_away_reach_the_map(journey, node) -> None:
    chain = journey.chain
    journey.keyframes(1)
    chain.kill(node)
    stamps: list[int] = []
    while len(stamps) < 3:
        answer = journey.step()
        stamps += [answer.stamp_ns] if answer.values['keyframe'] == '1' else []
    chain.start(node)

    def mapped() -> set[int]:
        parts = (map_file_of(message, MAP_PART) for message in reversed(journey.received(MAP_PART)))
        grid = next((part.parts['grid'] for part in parts if 'grid' in part.parts), {})
        return set(grid.get('stamp_ns', np.zeros(0)).tolist())

    chain.graph.until(lambda: mapped() >= set(stamps), 'all keyframes in the map')


@pytest.mark.slow
def test_a_map_is_saved_after_all_nodes_were_killed_together(journey, tmp_path) -> None:
    """Nobody sends the grid the last keyframes of SLAM again."""
    chain, file = journey.chain, tmp_path / 'kept.map'
    journey.keyframes(1)
    journey.settle()
    os.kill(chain.pid(GRID), signal.SIGSTOP)
    stamps_ns = {journey.step().stamp_ns for _ in range(3)}
    journey.settle()
    for node in CHAIN:
        chain.kill(node)
    chain.start(*CHAIN, save_map=file)
    client = chain.graph.tester.create_client(Trigger, 'stereo_slam/save_map')
    chain.graph.comes(lambda: False, FOUND_S)  # the killed node seems to offer it, too
    answer = client.call_async(Trigger.Request())
    chain.graph.until(answer.done, 'the saved map')
    assert answer.result().success, answer.result().message
    parts = read_map_file(file).parts
    assert stamps_ns <= set(parts['slam']['keyframe_stamp_ns'].tolist())
    of_grid = set(parts['grid']['stamp_ns'].tolist())
    assert len(of_grid) > 4 and not stamps_ns & of_grid
    chain.wake(journey.stand)
    journey.rejoin()


@pytest.mark.slow
def test_parts_do_not_wait_behind_the_images_of_a_busy_slam(journey) -> None:
    """What SLAM keeps meanwhile would lack the keyframes of the parts that wait."""
    graph, chain = journey.chain.graph, journey.chain
    asks, loaded = graph.publisher(MAP_PART), graph.collect(MAP_LOADED)
    graph.connected([asks])
    journey.settle()
    frames = [journey.next() for _ in range(IMAGES.depth)]
    for frame in frames:
        chain.send(frame)
    for asked in range(1, len(frames) + 1):
        header = {'part': 'tester', 'start_ns': None, 'asked': asked}
        asks.publish(map_file_message(MapFile(header)))

    def answered() -> list[int]:
        headers = (map_file_of(message, MAP_LOADED).header for message in loaded)
        return [header['asked'].get('tester') for header in headers]

    graph.until(lambda: len(frames) in answered(), 'the answer')
    # SLAM answers between two frames: with one question for each there are many answers.
    assert len(answered()) <= len(frames) / 6
    chain.answers(frame.stamp_ns for frame in frames)
    journey.rejoin()


@pytest.mark.slow
def test_a_camera_that_is_killed_is_taken_up_again(journey, tmp_path) -> None:
    """A driver that comes back goes on with the stamps of the clock."""
    chain = journey.chain
    for life in ('first', 'second'):
        frames = [journey.next() for _ in range(12)]
        drive = write_kitti(tmp_path / life, [replace(f, index=i) for i, f in enumerate(frames)])
        # Lossless: a busy machine may be slower than 10 Hz.
        chain.start(CAMERA, input=drive, rate=10.0, lossless=True)
        assert all(a.level is Level.OK for a in chain.answers(f.stamp_ns for f in frames[:4]))
        chain.kill(CAMERA)
        journey.miss(1)
    path = path_arrays(journey.latest('keyframe/path'))
    assert path.stamp_ns[0] == 0, 'the map was begun anew'
    assert journey.odometry_error_m() < 0.03


@pytest.mark.slow
def test_a_slam_that_sees_nothing_when_it_goes_on_holds_its_pose_and_the_map(journey) -> None:
    chain = journey.chain
    grid, _ = journey.keyframes(1)
    last = journey.settle()
    chain.kill(SLAM)
    chain.start(SLAM)
    dark = np.zeros_like(journey.next().left)

    def covered() -> StereoFrame:
        return replace(journey.next(), left=dark, right=dark)

    chain.wake(covered)
    # How many frames wake the node depends on the machine: the robot may just have come back.
    moved_m, frames = 0.0, 10
    while moved_m < 0.3:
        answer = chain.drive([covered() for _ in range(frames)])[-1]
        assert 'held where the drive was broken off' in answer.message
        journey.wait_for('odometry', answer.stamp_ns)
        moved_m, frames = journey.odometry_error_m(), 1
    held = journey.latest('odometry')
    np.testing.assert_allclose(place_of(held), place_of(last), atol=1e-6)
    since_s = 1e-9 * (stamp_of(held) - stamp_of(last))
    # A robot that nobody sees may be carried at a walking pace: three sigma.
    sigma_m = np.sqrt(held.pose.covariance[0])
    assert sigma_m >= 0.5 * since_s
    assert moved_m < 3 * sigma_m
    begun = len(journey.received('odometry'))
    journey.rejoin()
    grid_after, _ = journey.keyframes(1)
    path = path_arrays(journey.latest('keyframe/path'))
    assert path.stamp_ns[0] == 0
    truth = journey.truth(path.stamp_ns[-1])
    assert np.linalg.norm(path.T_map_base[-1][:3, 3] - truth[:3, 3]) < 0.03
    # `odom` is continuous: it goes on from where it was held, frame by frame, however far the robot
    # is from there; what was not seen is now between it and the map.
    since = [held, *journey.received('odometry')[begun:]]
    assert (np.diff([stamp_of(message) for message in since]) > 0).all()
    steps_m = np.linalg.norm(np.diff([place_of(m) for m in since], axis=0), axis=1)
    assert steps_m.max() < 3 * STEP_M
    # In the map the robot is where it is.
    stamp_ns = stamp_of(journey.latest('odometry'))
    place = place_of(journey.wait_for('pose', stamp_ns))
    assert np.linalg.norm(place - journey.truth(stamp_ns)[:3, 3]) < 0.03
    assert journey.odometry_error_m() > 0.1
    known, known_after = known_cells(grid), known_cells(grid_after)
    assert len(known & known_after.keys()) >= 0.98 * len(known)


def stamp_of(message) -> int:
    return to_ns(message.header.stamp)


def place_of(message) -> np.ndarray:
    return pose_array(message.pose.pose)[:3, 3]


def known_cells(grid: OccupancyGrid) -> dict[tuple[int, int], bool]:
    """Return the cells that are free or occupied by their place in the map, and which it is."""
    rows, columns = np.nonzero(grid.cells >= 0)
    first = np.rint(np.array(grid.origin_xy_m) / grid.resolution_m).astype(int)
    occupied = grid.cells[rows, columns] > 50
    places = zip((columns + first[0]).tolist(), (rows + first[1]).tolist(), strict=True)
    return dict(zip(places, occupied.tolist(), strict=True))


@pytest.fixture
def own_folder(monkeypatch, tmp_path) -> Path:
    """Where nodes keep their maps in this test."""
    monkeypatch.setenv('ROS_DOMAIN_ID', 'test')
    monkeypatch.setenv('XDG_RUNTIME_DIR', str(tmp_path))
    return tmp_path


def some_map(value: int = 1) -> MapFile:
    return MapFile({'start_ns': 7}, {'grid': {'a': np.array([value])}})


def keep(kept: KeptState, value: int = 1) -> None:
    kept.save(lambda: some_map(value))
    kept.finish()


def kept_value(kept: KeptState) -> int | None:
    saved = kept.take()
    return None if saved is None else int(saved.parts['grid']['a'][0])


def test_what_is_kept_is_found_once_by_the_same_user_and_only_for_a_while(own_folder) -> None:
    kept = KeptState('/robot/stereo_slam', 30.0)
    keep(kept)
    assert KeptState('/other/stereo_slam', 30.0).take() is None
    assert kept_value(KeptState('/robot/stereo_slam', 30.0)) == 1
    assert KeptState('/robot/stereo_slam', 30.0).take() is None
    again = KeptState('/robot/stereo_slam', 30.0)
    keep(again, 2)
    keep(again, 3)  # too soon after the last one
    assert kept_value(again) == 2
    keep(KeptState('/robot/stereo_slam', 30.0))
    file = kept.file
    long_ago = file.stat().st_mtime - 31
    os.utime(file, (long_ago, long_ago))
    assert kept.take() is None
    assert not file.exists()


def test_what_is_kept_is_kept_again_when_it_is_time(own_folder) -> None:
    kept = KeptState('/robot/stereo_slam', 30.0)
    keep(kept)
    keep(kept, 2)  # too soon after the last one
    deadline_s = time.monotonic() + 20
    while not kept.is_due and time.monotonic() < deadline_s:
        time.sleep(0.01)
    keep(kept, 3)
    assert kept_value(kept) == 3


def test_what_a_killed_node_leaves_does_not_reach_the_next_graph(monkeypatch) -> None:
    for _ in range(2):
        with surroundings():
            # A later graph may well have the domain of an earlier one.
            monkeypatch.setenv('ROS_DOMAIN_ID', 'test')
            kept = KeptState('/occupancy_grid', 30.0)
            assert kept_value(kept) is None
            keep(kept)


def test_what_was_noted_last_comes_with_the_map_and_tells_its_age(own_folder) -> None:
    kept = KeptState('/robot/noting', 30.0)
    keep(kept)
    for stamp_ns in (1, 2):
        kept.note({'stamp_ns': stamp_ns})
    long_ago = kept.file.stat().st_mtime - 31
    os.utime(kept.file, (long_ago, long_ago))  # it has stood since, and made no keyframe
    assert KeptState('/robot/noting', 30.0).take().header['note'] == {'stamp_ns': 2}
    assert [file.name for file in kept.file.parent.glob('test-robot-noting*')] == []
    off = KeptState('/robot/noting', 0.0)
    off.note({'stamp_ns': 3})
    assert [file.name for file in kept.file.parent.glob('test-robot-noting*')] == []


def test_what_is_damaged_or_not_wanted_is_not_taken(own_folder) -> None:
    off = KeptState('/robot/damaged', 0.0)
    keep(off)
    kept = KeptState('/robot/damaged', 30.0)
    assert kept.take() is None
    keep(kept)
    kept.file.write_bytes(kept.file.read_bytes()[:-3])
    assert kept.take() is None
    kept = KeptState('/robot/damaged', 30.0)
    keep(kept)
    kept.remove()
    assert kept.take() is None


@pytest.mark.parametrize('mode', [0o777, 0o750, 0o705])
def test_a_folder_that_is_not_private_is_not_touched(own_folder, mode) -> None:
    kept = KeptState('/robot/open', 30.0)
    keep(kept)
    before = kept.file.read_bytes()
    kept.file.parent.chmod(mode)
    assert kept.take() is None
    kept.remove()
    keep(KeptState('/robot/open', 30.0), value=2)
    assert [path.read_bytes() for path in kept.file.parent.iterdir()] == [before]
    kept.file.parent.chmod(0o700)
    assert kept_value(kept) == 1


def test_a_link_in_place_of_the_folder_is_not_followed(own_folder) -> None:
    kept = KeptState('/robot/linked', 30.0)
    (theirs := own_folder / 'theirs').mkdir(mode=0o700)
    (theirs / kept.file.name).write_text('mine')
    kept.file.parent.symlink_to(theirs)
    assert kept.take() is None
    kept.remove()
    keep(kept)
    assert (theirs / kept.file.name).read_text() == 'mine'
