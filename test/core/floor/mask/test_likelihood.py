"""What the features of a pixel say, and what becomes of a mask."""

import dataclasses

import numpy as np
import pytest
from floor_scenes import SMALL_CAMERA, Scene, floor_patch, wall

from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, NOT_FLOOR
from segfloor_ros.core.floor.mask.likelihood import (
    WEIGHTS,
    Likelihood,
    Seen,
    features,
    known_weight,
)
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings

SHAPE, SLOPE = (120, 200), 0.15
ROWS, COLUMNS = np.indices(SHAPE, np.float32)
NOISE_GREY = 1.0


def ground(seed: int = 0) -> Seen:
    """Level ground that is matched everywhere with a noise of half a pixel, of one colour with some
    texture; two image rows lie between the pixels.
    """
    rng = np.random.default_rng(seed)
    floor_px = 10 + 2 * SLOPE * ROWS
    matched_px = floor_px + rng.normal(0, 0.5, SHAPE)
    return Seen(
        floor_px=floor_px,
        disparity_px=matched_px.astype(np.float32),
        slope=SLOPE,
        texture=np.full(SHAPE, 2.0, np.float32),
        lower=np.zeros(SHAPE, bool),
        left_only=np.zeros(SHAPE, bool),
        grey=(100 + rng.normal(0, 12, SHAPE)).astype(np.float32),
        noise_grey=NOISE_GREY,
        step=0.0,
        mask=np.full(SHAPE, FLOOR, np.uint8),
    )


def named(seen: Seen) -> dict[str, np.ndarray]:
    return dict(zip(WEIGHTS, features(seen, known_weight(seen))[0], strict=True))


STONE = np.s_[60:70, 95:105]


def test_a_stone_is_higher_than_the_ground_beside_it_wherever_the_profile_lies() -> None:
    """The profile lies 2 px above the ground: by it the stone is no higher than floor."""
    seen = ground()
    stone_px = seen.disparity_px - 2
    stone_px[STONE] += 2.5
    parts = named(dataclasses.replace(seen, disparity_px=stone_px))
    middle = np.s_[63:67, 98:102]
    assert parts['above'][middle].min() > 2
    assert not parts['on'][middle].any()
    beside = np.s_[60:70, 120:160]
    assert parts['above'][beside].mean() < 0.7
    assert parts['on'][beside].mean() > 0.5
    mask = np.full(SHAPE, FLOOR, np.uint8)
    mask[beside] = NO_EVIDENCE
    weighed = Likelihood().weighed(mask, dataclasses.replace(seen, disparity_px=stone_px))[0]
    assert np.all(weighed[middle] == NO_EVIDENCE)
    assert np.mean(weighed[beside] == FLOOR) > 0.9


def test_a_hollow_is_no_obstacle() -> None:
    seen = ground()
    hollow_px = seen.disparity_px.copy()
    hollow_px[STONE] -= 3
    parts = named(dataclasses.replace(seen, disparity_px=hollow_px))
    assert not parts['above'][63:67, 98:102].any()


def test_what_is_upright_does_not_rise() -> None:
    seen = ground()
    face_px = seen.disparity_px.copy()
    face_px[30:70, 80:120] = face_px[69, 80:120]
    parts = named(dataclasses.replace(seen, disparity_px=face_px))
    assert parts['steep'][45:65, 90:110].mean() > 0.5
    assert parts['rises'][45:65, 20:60].mean() > 1
    # Level as a floor, but much higher: that it rises says nothing.
    table_px = seen.disparity_px.copy()
    table_px[30:70, 80:120] += 8
    parts = named(dataclasses.replace(seen, disparity_px=table_px))
    assert parts['rises'][45:60, 90:110].max() < 0.3


def test_what_has_no_texture_or_no_match_says_nothing_of_its_height() -> None:
    seen = ground()
    for change in (
        {'texture': np.full(SHAPE, 0.4, np.float32)},
        {'disparity_px': np.zeros(SHAPE, np.float32)},
    ):
        parts = named(dataclasses.replace(seen, **change))
        for name in ('above', 'rises', 'steep', 'on'):
            assert not parts[name].any()
    flat = dataclasses.replace(seen, grey=np.full(SHAPE, 100, np.float32))
    assert known_weight(flat).max() < 0.1 < known_weight(seen).mean()
    assert known_weight(dataclasses.replace(flat, noise_grey=0.0)).min() == 1


def test_noise_of_the_image_does_not_matter_to_a_depth_camera() -> None:
    kept: list[Seen] = []

    class Recorder(Likelihood):
        def weighed(self, mask: np.ndarray, seen: Seen) -> tuple[np.ndarray, np.ndarray]:
            kept.append(seen)
            return super().weighed(mask, seen)

    scene = Scene([floor_patch(), wall(2.0)], SMALL_CAMERA, noise_grey=2.0)
    left, right, _, depth_m = scene.render()
    disparity_px = (SMALL_CAMERA.disparity_times_depth / depth_m).astype(np.float32)
    for second in (right, disparity_px):
        stage = FloorSegmentation(SMALL_CAMERA, FloorSegmentationSettings())
        stage.likelihood = Recorder()
        stage.process(left, second, scene.mount)
    images, measured = kept
    assert images.noise_grey > 1 and measured.noise_grey == 0
    assert np.all(known_weight(measured)[measured.disparity_px > 0] == 1)


def test_what_looks_like_what_stands_and_not_like_the_floor_is_none() -> None:
    """Light falls off to one side by half: that is no change of the floor."""
    seen = ground()
    light = (1 - 0.5 * COLUMNS / SHAPE[1]).astype(np.float32)
    grey, bright, stands = seen.grey * light, np.s_[20:30, 95:105], np.s_[90:100, 20:40]
    grey[STONE] *= 0.4
    grey[bright] *= 2.0
    is_floor = np.ones(SHAPE, bool)
    is_floor[STONE] = is_floor[bright] = is_floor[stands] = False
    mask = np.where(is_floor, FLOOR, NO_EVIDENCE).astype(np.uint8)
    unknown = named(dataclasses.replace(seen, grey=grey, mask=mask))['look']
    assert unknown[is_floor].mean() > 0.5
    assert np.mean(unknown[is_floor] < -1) < 0.05
    assert all(unknown[where].mean() < -2 for where in (STONE, bright))
    grey[stands] *= 0.4
    mask[stands] = NOT_FLOOR
    look = named(dataclasses.replace(seen, grey=grey, mask=mask))['look']
    assert look[STONE].mean() < -4
    # It does not look like what stands either: it may be a bright patch.
    assert look[bright].mean() > unknown[bright].mean() + 0.5
    assert look[is_floor].mean() > 1
    few = named(dataclasses.replace(seen, mask=np.full(SHAPE, NO_EVIDENCE, np.uint8)))
    assert not few['look'].any()


@pytest.mark.parametrize('size', [SHAPE, (240, 200), (240, 400)])
def test_a_mask_changes_only_where_something_is_measured(size: tuple[int, int]) -> None:
    """At half the resolution of the mask, or at its own."""
    mask = np.full(size, NO_EVIDENCE, np.uint8)
    mask[: size[0] // 2] = FLOOR
    mask[:, -size[1] // 4 :] = NOT_FLOOR
    known, floor_px = COLUMNS >= 50, np.full(SHAPE, 10, np.float32)
    seen = dataclasses.replace(ground(), floor_px=floor_px, disparity_px=floor_px * known)
    surely, unlikely = (Likelihood([nats, *5 * [0.0]]) for nats in (3.0, -3.0))
    left, between = np.s_[:, : size[1] // 4], np.s_[:, size[1] // 4 : -size[1] // 4]
    changed = surely.weighed(mask, seen)[0]
    np.testing.assert_array_equal(changed[left], mask[left])
    assert np.all(changed[between] == FLOOR)
    assert np.all(changed[:, -size[1] // 4 :] == NOT_FLOOR)
    changed = unlikely.weighed(mask, seen)[0]
    np.testing.assert_array_equal(changed[left], mask[left])
    assert np.all(changed[between] == NO_EVIDENCE)
    assert np.all(changed[:, -size[1] // 4 :] == NOT_FLOOR)
    far = dataclasses.replace(seen, floor_px=np.full(SHAPE, 2, np.float32))
    # What is too far to be judged is no floor, whatever was filled.
    np.testing.assert_array_equal(
        surely.weighed(mask, far)[0], np.where(mask == FLOOR, NO_EVIDENCE, mask)
    )
    unsure = Likelihood([0.5, *5 * [0.0]])
    np.testing.assert_array_equal(unsure.weighed(mask, seen)[0], mask)
    drop = dataclasses.replace(seen, lower=np.ones(SHAPE, bool))
    np.testing.assert_array_equal(surely.weighed(mask, drop)[0], mask)


def test_a_thing_of_one_pixel_of_disparity_is_higher_than_even_ground() -> None:
    """Two sigmas of a single match, but many of a block of this ground."""
    seen = ground()
    smooth_px = seen.floor_px + 0.3 * (seen.disparity_px - seen.floor_px)
    smooth_px[STONE] += 1
    low = dataclasses.replace(seen, disparity_px=smooth_px.astype(np.float32))
    assert named(low)['above'][63:67, 98:102].min() > 4
    mask = Likelihood().weighed(seen.mask, low)[0]
    assert np.all(mask[61:68, 97:103] == NO_EVIDENCE)
    assert np.mean(mask[:, 120:] == FLOOR) > 0.95
    # What is surely higher is so at its border, too: the block that is matched holds both.
    smooth_px[STONE] += 3
    high = dataclasses.replace(seen, disparity_px=smooth_px.astype(np.float32))
    assert np.all(Likelihood().weighed(seen.mask, high)[0][59, 96:104] == NO_EVIDENCE)


def test_what_a_robot_climbs_is_no_floor_but_it_drives_there() -> None:
    """The stone is 2 px nearer than the floor of 29 px: a 15th of the height of the camera."""
    seen = dataclasses.replace(ground(), grey=np.full(SHAPE, 100, np.float32), noise_grey=0.0)
    stone_px = seen.floor_px.copy()
    stone_px[STONE] += 2
    for step, climbs in ((0.05, False), (0.1, True)):
        low = dataclasses.replace(seen, disparity_px=stone_px, step=step)
        mask, climbed = Likelihood().weighed(seen.mask, low)
        assert np.all(mask[61:69, 96:104] == NO_EVIDENCE)
        assert np.all(climbed[62:68, 97:103] == climbs)
        assert not climbed[:, :80].any()
    # However much a robot climbs, something much higher is in its way.
    stone_px[STONE] += 20
    high = dataclasses.replace(seen, disparity_px=stone_px, step=0.8)
    assert not Likelihood().weighed(seen.mask, high)[1][62:68, 97:103].any()
    stone_px[STONE] -= 20
    # Upright and as dark as what stands, it is not.
    mask = seen.mask.copy()
    mask[10:20, 20:60] = NOT_FLOOR
    grey = seen.grey.copy()
    grey[STONE] *= 0.2
    grey[10:20, 20:60] *= 0.2
    dark = dataclasses.replace(seen, disparity_px=stone_px, step=0.1, grey=grey, mask=mask)
    assert not Likelihood().weighed(mask, dark)[1][62:68, 97:103].any()


STRIP = np.s_[:, :30]


def one_sided(grey: np.ndarray) -> Seen:
    """Ground whose left strip only the left camera sees."""
    left_only, seen = np.zeros(SHAPE, bool), ground()
    left_only[STRIP] = True
    matched_px = np.where(left_only, np.float32(0), seen.disparity_px)
    return dataclasses.replace(seen, disparity_px=matched_px, left_only=left_only, grey=grey)


def test_floor_goes_on_where_only_the_left_camera_sees_it() -> None:
    empty = np.full(SHAPE, NO_EVIDENCE, np.uint8)
    mask = Likelihood().weighed(empty, one_sided(ground().grey))[0]
    assert np.mean(mask[STRIP] == FLOOR) > 0.95
    # Behind an edge is something else, although it is no darker than floor may be.
    thing = np.s_[40:80, :20]
    grey = np.full(SHAPE, 100, np.float32)
    grey[:, 30:] += 4 * np.random.default_rng(1).normal(size=SHAPE)[:, 30:]
    grey[thing] *= 0.9
    full = np.full(SHAPE, FLOOR, np.uint8)
    full[30:45, :20] = NOT_FLOOR
    seen = dataclasses.replace(one_sided(grey.astype(np.float32)), mask=full)
    mask = Likelihood().weighed(full, seen)[0]
    assert np.mean(mask[50:75, 2:16] == FLOOR) < 0.1
    assert np.mean(mask[85:, :30] == FLOOR) > 0.9


def test_some_matches_where_only_the_left_camera_sees_are_by_chance() -> None:
    """What both cameras see there is farther than the floor: a drop, if it is matched as a ground
    is, and nothing if it is one pixel in ten.
    """
    seen, empty = one_sided(ground().grey), np.full(SHAPE, NO_EVIDENCE, np.uint8)
    rng = np.random.default_rng(2)
    for share, is_floor in ((0.1, True), (0.7, False)):
        matched = seen.left_only & (rng.random(SHAPE) < share)
        disparity_px = np.where(matched, np.float32(3), seen.disparity_px)
        found = dataclasses.replace(seen, disparity_px=disparity_px, lower=matched)
        strip = Likelihood().weighed(empty, found)[0][:, 3:20]
        assert np.all(strip[matched[:, 3:20]] == NO_EVIDENCE)
        if is_floor:
            assert np.mean(strip[~matched[:, 3:20]] == FLOOR) > 0.9
        else:
            assert not np.any(strip == FLOOR)
