"""Which points hold in every direction, in images drawn for it."""

from __future__ import annotations

import numpy as np
import pytest

from segfloor_ros.core.slam.tracking.patch_alignment import count_firm

RNG = np.random.default_rng(3)


def noisy(image):
    return np.clip(image + RNG.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize('contrast', [12, 30, 80])
@pytest.mark.parametrize('slope', [0.0, 0.6, -1.3])
def test_points_on_an_edge_are_not_firm(contrast, slope):
    v, u = np.mgrid[:120, :160]
    image = noisy(np.where(u - 80 > slope * (v - 60), 100 + contrast, 100.0))
    rows = np.arange(30, 90, 2)
    on_edge = np.stack([80 + slope * (rows - 60), rows], axis=1)
    assert count_firm(image, on_edge) <= 2


def test_corners_and_textures_are_firm():
    v, u = np.mgrid[:480, :640]
    image = noisy(100 + 40.0 * ((u // 40 + v // 40) % 2))
    corners = np.array([(x - 0.5, y - 0.5) for x in range(40, 630, 80) for y in range(40, 470, 80)])
    assert count_firm(image, corners) == len(corners)
    weak = noisy(100 + 6 * np.sin(u * 0.9) * np.sin(v * 1.1))
    anywhere = RNG.uniform(10, 460, (100, 2))
    assert count_firm(weak, anywhere) > 80


def test_of_many_points_in_one_place_few_count():
    texture = noisy(RNG.uniform(60, 160, (480, 640)))
    together = RNG.uniform([200, 200], [240, 240], (200, 2))
    assert count_firm(texture, together) <= 12


def test_points_at_the_border_and_none_at_all():
    image = noisy(np.full((40, 60), 90.0))
    assert count_firm(image, np.zeros((0, 2))) == 0
    assert 0 <= count_firm(image, np.array([[0.0, 0.0], [59.4, 39.4]])) <= 2
