"""Conditions A1, A2, A3 and B, one at a time."""

import numpy as np
import pytest

from segfloor_ros.core.geometry import make_transform
from segfloor_ros.core.plugins.rig.image_check import ImageCheck, image_fault
from segfloor_ros.core.slam.places.views import View, is_keyframe, novelty
from segfloor_ros.core.twists import se3_exp

STILL = np.eye(4)
MOVED = make_transform(np.eye(3), np.array([0.0, 0.0, 0.2]))
TURNED = se3_exp(np.array([0, 0, 0, 0, 0.15, 0]))


@pytest.mark.parametrize(
    ('motion', 'depth_m', 'expected'),
    [(STILL, 2.0, 0.0), (MOVED, 2.0, 2.5), (MOVED, 8.0, 0.625), (TURNED, 2.0, 2.5)],
)
def test_novelty_is_motion_for_the_depth_or_rotation(motion, depth_m, expected):
    assert novelty(motion, depth_m) == pytest.approx(expected)


@pytest.mark.parametrize(
    ('view', 'expected'),
    [
        (View(10, 200, 300, 0.0), False),  # nothing new
        (View(10, 200, 300, 1.1), True),  # A2
        (View(10, 200, 300, 0.9), False),
        (View(2, 200, 300, 1.5), False),  # too soon
        (View(3, 200, 300, 1.5), True),
        (View(6, 200, 300, 1.5, since_ns=int(2e8)), False),  # a camera of 30 Hz
        (View(8, 200, 300, 1.5, since_ns=int(27e7)), True),
        (View(2, 200, 300, 1.5, since_ns=int(4e8)), False),  # and one of 5 Hz
        (View(3, 200, 300, 4.0, since_ns=int(1e8)), True),
        (View(1, 200, 300, 4.0), True),  # so new that it waits for no frames
        (View(1, 200, 300, 1.5, found_share=0.4), True),  # the next frame finds fewer still
        (View(1, 200, 300, 0.9, found_share=0.4), False),  # as many are found from a known view
        (View(1, 200, 300, 1.5, mapper_idle=False, found_share=0.4), False),
        (View(10, 200, 300, 1.5, mapper_idle=False), False),  # mapper busy
        (View(30, 200, 300, 1.5, mapper_idle=False), True),  # A1: too many frames
        (View(500, 200, 300, 0.0), False),  # standing still adds nothing
        (View(1, 74, 300, 0.0), True),  # A3: 74 < 0.25 · 300
        (View(1, 76, 300, 0.0), False),
    ],
)
def test_conditions(view, expected):
    assert is_keyframe(view, max_frames=30) is expected


def textured():
    return np.random.default_rng(0).integers(0, 255, (48, 64)).astype(np.uint8)


def test_image_faults_are_named():
    good = textured()
    assert image_fault(good, good) == ''
    assert 'left image without contrast' in image_fault(np.zeros_like(good), good)
    assert 'right image without contrast' in image_fault(good, np.full_like(good, 255))
    half = good.copy()
    half[24:] = 128
    assert 'left image incomplete' in image_fault(half, good)


def test_an_image_is_repeated_once_and_frozen_then_where_the_camera_was_moving():
    one, two = np.zeros((6, 8), np.uint8), np.ones((6, 8), np.uint8)
    check = ImageCheck()

    def see(image, shift):
        return check.is_frozen(image.copy(), lambda: shift), check.is_repeated, check.is_carried

    assert see(one, 0.05) == (False, False, False)  # nothing came before
    assert see(one, 0.05) == (False, True, True)
    assert see(one, 0.05) == (True, True, False)
    assert see(one, 0.0) == (True, True, False)  # still the same one
    assert see(two, 0.05) == (False, False, False)
    assert see(two, 0.0005) == (False, True, False)  # it stands still
    assert see(one, 0.05) == (False, False, False)
    assert see(one, 0.05) == (False, True, True)
    assert see(two, 0.05) == (False, False, False)
    assert see(two, 0.05) == (False, True, True)
