"""What is plugged into SLAM forgets its frames where the next ones are relative to others."""

from collections import Counter

import numpy as np
import pytest
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.contracts import Mount, StereoFrame
from segfloor_ros.core.plugins.maps.session import MapSession
from segfloor_ros.core.plugins.rig.image_check import ImageCheck
from segfloor_ros.core.slam.optional import NoSensors, NothingMoves, Plugins
from segfloor_ros.core.slam.session import SessionState
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.stereo_slam import StereoSlam
from segfloor_ros.core.twists import se3_exp

SETTINGS = StereoSlamSettings(num_features=300)
GREY = np.full((CAMERA.height, CAMERA.width), 90, np.uint8)


class Meter:
    """A meter of the mount that finds none. resets: how often what was reset."""

    is_final, may_change, remark, provisional = False, True, None, MOUNT

    def __init__(self, resets: Counter) -> None:
        self._resets = resets
        self.mount: Mount | None = None

    def add(self, *_) -> None:
        """Look at nothing."""

    def use(self, mount: Mount) -> None:
        self.mount = mount

    def reset(self) -> None:
        self._resets['meter'] += 1


def equipped() -> tuple[StereoSlam, Counter]:
    """Return SLAM, and how often each of its plugins was reset."""
    resets = Counter()

    class Moving(NothingMoves):
        def reset(self) -> None:
            resets['moving'] += 1

    class Sensors(NoSensors):
        def reset(self) -> None:
            resets['sensors'] += 1

        def reset_world(self) -> None:
            resets['world'] += 1

    plugins = Plugins(
        moving=Moving(), sensors=Sensors(), image_check=ImageCheck(), session=MapSession
    )
    slam = StereoSlam(CAMERA, SETTINGS, mount_meter=Meter(resets), plugins=plugins)
    resets.clear()
    return slam, resets


@pytest.fixture(scope='module')
def rooms():
    return StereoRoom(), StereoRoom(seed=77)


@pytest.mark.slow
def test_a_map_that_begins_anew_has_none_of_the_frames_before(rooms) -> None:
    slam, resets = equipped()
    room, other = rooms
    for k in range(2):
        slam.process(room.frame(k, planar_pose(0.04 * k, 0.0, 0.0)))
    assert not resets
    seen = other.frame(2, planar_pose(0.0, 0.0, 1.0))
    for k in range(2, 6):
        slam.process(StereoFrame(k, round((k - 1) * 0.6e9), seen.left, seen.right))
    assert resets['sensors'] > 0
    # The world of the first map is that of the next, where the sensors are concerned.
    assert (resets['moving'], resets['meter'], resets['world']) == (1, 1, 0)


def test_a_loaded_map_is_another_world_than_what_is_mapped_beside_it(rooms) -> None:
    """The camera maps on its own first; then an image fails, and what was mapped is given up."""
    room, other = rooms
    first, _ = equipped()
    for k in range(3):
        first.process(room.frame(k, planar_pose(0.04 * k, 0.0, 0.0)))
    slam, resets = equipped()
    slam.load(first.to_arrays(), MOUNT, localize=False)
    slam.front_end.motion.T_world_odom = se3_exp(np.array([0.2, -0.3, 0.1, 0.4, -0.3, 0.9]))
    resets.clear()
    slam.process(other.frame(0, planar_pose(0.0, 0.0, 1.0)))
    assert slam.session.state is SessionState.BESIDE
    assert (resets['moving'], resets['meter'], resets['world']) == (1, 1, 1)
    np.testing.assert_array_equal(slam.front_end.motion.T_world_odom, np.eye(4))
    resets.clear()
    slam.process(StereoFrame(1, 10**8, GREY, GREY))
    assert not slam.session.state.holds_results
    assert slam.session.state is SessionState.LOADED
    assert (resets['moving'], resets['meter'], resets['world']) == (1, 1, 1)
    assert slam.front_end.motion.state.is_lost
