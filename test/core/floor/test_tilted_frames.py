"""Frames whose plane is not that of the mount: the robot brakes, or leans, or has a new mount."""

from dataclasses import replace

import numpy as np
import pytest
from floor_scenes import CAMERA, MOUNT, SMALL_CAMERA, Patch, Scene, box, floor_patch, wall

from segfloor_ros.core.contracts import FloorScan, Mount
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings

BOARD_M, ROBOT_M = 2.0, 0.9
TILTS_DEG = [(4.0, 3.0), (-4.0, 3.0), (4.0, -3.0)]
"""Pitch and roll of the base: it brakes or speeds up, and leans to either side."""


def tilted(pitch_deg: float, roll_deg: float) -> Mount:
    """Return the mount as a base that has tilted makes it."""
    return replace(
        MOUNT, pitch_rad=MOUNT.pitch_rad + np.radians(pitch_deg), roll_rad=np.radians(roll_deg)
    )


def scan_of(true: Mount, *patches: Patch, is_tracked: bool) -> FloorScan:
    """Return the scan of a camera that is said to sit on MOUNT; while it is tracked the map knows
    the tilt, else the image alone does.
    """
    left, right, _, _ = Scene([*patches], CAMERA, true).render()
    stage = FloorSegmentation(CAMERA, FloorSegmentationSettings(robot_height_m=ROBOT_M))
    pose = true.T_base_left @ np.linalg.inv(MOUNT.T_base_left)
    return stage.process(left, right, MOUNT, pose if is_tracked else None).scan


def board(bottom_m: float) -> Patch:
    """The front of a board across the way, more to the left."""
    return Patch(
        (BOARD_M, -0.3, bottom_m), (0.0, 1.2, 0.0), (0.0, 0.0, 0.08), False, grey=90.0, seed=8
    )


@pytest.mark.parametrize(('pitch_deg', 'roll_deg'), TILTS_DEG)
@pytest.mark.parametrize(('bottom_m', 'is_in_the_way'), [(0.78, True), (0.93, False)])
@pytest.mark.parametrize('is_tracked', [True, False])
def test_what_hangs_over_the_way_is_as_high_as_the_plane_of_its_frame_says(
    pitch_deg, roll_deg, bottom_m, is_in_the_way, is_tracked
):
    """By the mount that is given the board would be 0.14 m higher or lower: on the other side of
    the robot's height.
    """
    true = tilted(pitch_deg, roll_deg)
    scan = scan_of(true, floor_patch(), wall(4.0), board(bottom_m), is_tracked=is_tracked)
    bearing = np.degrees(scan.bearings_rad)
    below = (bearing > -6) & (bearing < 22)
    at_board = np.abs(scan.obstacle_m * np.cos(scan.bearings_rad) - BOARD_M) < 0.15
    if is_in_the_way:
        assert at_board[below].mean() > 0.8
        assert not at_board[(bearing < -12) | (bearing > 28)].any()
    else:
        assert at_board.mean() < 0.05


def test_a_new_mount_is_fixed_until_the_contrary_is_seen():
    """A camera that was in a hand is mounted."""
    scene = [floor_patch(), wall(), *box(1.6, 0.5, 0.4, 0.3)]
    stage = FloorSegmentation(SMALL_CAMERA, FloorSegmentationSettings())

    def see(height_m: float, said: Mount) -> None:
        held = replace(MOUNT, height_m=height_m)
        left, right, _, _ = Scene(scene, SMALL_CAMERA, held).render()
        pose = held.T_base_left @ np.linalg.inv(said.T_base_left)
        stage.process(left, right, said, pose)

    for height_m in (0.30, 0.34, 0.38, 0.42):
        see(height_m, MOUNT)
    assert 'not fixed' in stage.remarks['fixture']
    for _ in range(2):
        see(0.42, replace(MOUNT, height_m=0.42))
        assert stage.remarks == {}
