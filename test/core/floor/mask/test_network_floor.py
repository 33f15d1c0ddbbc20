"""What a network says of the floor, beside what is measured."""

import numpy as np
import pytest
from floor_scenes import SMALL_CAMERA, Scene, floor_patch, wall

from segfloor_ros.core.contracts import FLOOR, MOVING, NO_EVIDENCE, NOT_FLOOR
from segfloor_ros.core.floor.mask.filling import TRUSTED, NetworkFloor
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings
from segfloor_ros.core.geometry import Array

KEYFRAMES = 12


def masks(scene: Scene, say, keyframes=KEYFRAMES):
    """The masks of a scene seen again and again, and its true floor. say: of the true floor."""
    left, right, floor, _ = scene.render()
    stage = FloorSegmentation(scene.camera, FloorSegmentationSettings())
    said = None if say is None else say(floor)
    seen = [
        stage.process(left, right, scene.mount, said=said) for _ in range(keyframes if say else 1)
    ]
    return stage, seen, floor


def plain_scene() -> Scene:
    """Textured floor, and a plain stretch of another grey up to a plain wall."""
    textured = floor_patch(-1.0, 2.0)
    plain = floor_patch(2.0, 4.0, grey=160.0, contrast=0.0)
    return Scene([textured, plain, wall(4.0, grey=90.0)], SMALL_CAMERA)


def truth(floor):
    return np.where(floor, np.uint8(FLOOR), np.uint8(NO_EVIDENCE))


def test_floor_without_texture_is_believed_once_the_network_was_right_often_enough() -> None:
    _, without, floor = masks(plain_scene(), None)
    stage, seen, _ = masks(plain_scene(), truth)
    assert stage.network.is_trusted and stage.network.remark == ''
    np.testing.assert_array_equal(seen[0].mask, without[0].mask)
    recall = [(observed.mask[floor] == FLOOR).mean() for observed in (seen[0], seen[-1])]
    assert recall[1] > recall[0] + 0.02
    assert floor[seen[-1].mask == FLOOR].mean() > 0.99


def test_a_network_that_sees_floor_everywhere_changes_nothing_and_it_is_said() -> None:
    _, without, _ = masks(plain_scene(), None)
    stage, seen, _ = masks(plain_scene(), lambda floor: np.full(floor.shape, FLOOR, np.uint8))
    assert not stage.network.is_trusted
    assert 'it is not used as floor' in stage.network.remark
    np.testing.assert_array_equal(seen[-1].mask, without[0].mask)


def test_what_moves_is_unknown_in_the_mask() -> None:
    def say(floor):
        said = truth(floor)
        said[150:200, 100:200] = MOVING
        return said

    _, seen, floor = masks(plain_scene(), say, 1)
    assert floor[150:200, 100:200].all()
    assert (seen[0].mask[150:200, 100:200] == NO_EVIDENCE).all()


def test_a_barrier_ends_the_floor_and_stands_in_the_scan_though_floor_is_seen_through_it() -> None:
    scene = Scene([floor_patch(), wall()])
    _, without, _ = masks(scene, None)
    line, camera = scene.mount, scene.camera
    # A pane 2 m ahead, all across, whose foot is where floor at 2 m is seen.
    T_left_base: Array = np.linalg.inv(line.T_base_left)
    foot = camera.project((T_left_base[:3, :3] @ [2.0, 0, 0] + T_left_base[:3, 3])[None])[0, 1]

    def say(floor):
        said = truth(floor)
        said[: int(foot) + 1] = NOT_FLOOR
        return said

    _, seen, _ = masks(scene, say, 1)
    ahead = np.abs(without[0].scan.bearings_rad) < 0.4
    assert np.nanmedian(without[0].scan.ranges_m[ahead]) > 3.0
    scan = seen[0].scan
    across_m = scan.obstacle_m[ahead] * np.cos(scan.bearings_rad[ahead])
    assert np.isfinite(across_m).mean() > 0.9
    assert np.nanmedian(across_m) == pytest.approx(2.0, abs=0.1)
    assert np.nanmax(scan.ranges_m[ahead] * np.cos(scan.bearings_rad[ahead])) < 2.2


@pytest.mark.parametrize('below_px', [0, 2, 4, 6])
def test_a_barrier_that_ends_close_to_the_horizon_stands_nowhere_near(below_px) -> None:
    """There, no row has a disparity of the floor."""
    scene = Scene([floor_patch(), wall()], SMALL_CAMERA)
    horizon = SMALL_CAMERA.cy - SMALL_CAMERA.fy * np.tan(scene.mount.pitch_rad)

    def say(floor):
        said = np.full(floor.shape, NO_EVIDENCE, np.uint8)
        said[: int(horizon) + below_px] = NOT_FLOOR
        return said

    _, without, _ = masks(scene, None)
    _, seen, _ = masks(scene, say, 1)
    nearest = [np.nanmin(observed.scan.obstacle_m) for observed in (without[0], seen[0])]
    assert nearest[1] == pytest.approx(nearest[0], abs=0.05)


def test_the_probability_follows_the_rule_of_succession() -> None:
    network, measured = NetworkFloor(), np.full((4, 4), FLOOR, np.uint8)
    said = np.full((4, 4), FLOOR, np.uint8)
    assert network.probability == 0.5
    network.note(said, measured)
    assert network.probability == pytest.approx(2 / 3)
    measured[:2] = NOT_FLOOR
    network.note(said, measured)
    assert network.probability == pytest.approx(2.5 / 4)
    network.note(said, np.full((4, 4), NO_EVIDENCE, np.uint8))
    assert network.probability == pytest.approx(2.5 / 4)
    assert network.remark == ''
    for _ in range(200):
        network.note(said, np.full((4, 4), FLOOR, np.uint8))
    assert network.probability > TRUSTED and network.is_trusted
