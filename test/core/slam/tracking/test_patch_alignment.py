"""Patch alignment on textures that were shifted, zoomed, slanted and relit by known amounts."""

import numpy as np
import pytest
from scipy.stats import chi2

from segfloor_ros.core.slam.tracking import patch_alignment
from segfloor_ros.core.slam.tracking.images import smooth
from segfloor_ros.core.slam.tracking.patch_alignment import (
    _remap,
    align_patches,
    refine_disparity,
    sample_patches,
)


class Texture:
    """A sum of waves: grey levels are known exactly at any position, without interpolation."""

    def __init__(self, seed=0, waves=0.25):
        rng = np.random.default_rng(seed)
        self._waves = rng.normal(scale=waves, size=(80, 2))
        self._phases = rng.uniform(0, 2 * np.pi, 80)

    def __call__(self, u, v):
        angles = np.multiply.outer(u, self._waves[:, 0]) + np.multiply.outer(v, self._waves[:, 1])
        return (128 + 6 * np.sin(angles + self._phases).sum(axis=-1)).astype(np.float32)

    def image(self, size=(200, 300)):
        v, u = np.indices(size).astype(np.float64)
        return self(u, v)


def warp(texture, u_of, v_of, size=(200, 300)):
    """Return the image whose pixel (u, v) shows the texture at (u_of(u, v), v_of(u, v))."""
    v, u = np.indices(size).astype(np.float64)
    return texture(u_of(u, v), v_of(u, v))


def grid_of_features(step=23, margin=40, size=(200, 300)):
    v, u = np.mgrid[margin : size[0] - margin : step, margin : size[1] - margin : step]
    return np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)


def test_finds_a_subpixel_shift_under_another_brightness():
    texture = Texture()
    image = texture.image()
    moved = 0.7 * warp(texture, lambda u, v: u - 0.62, lambda u, v: v + 0.35) + 25
    uv = grid_of_features()
    found = align_patches(sample_patches(image, uv), moved, uv, np.ones(len(uv)))
    assert found.sound.mean() > 0.9
    error = found.uv_px[found.sound] - (uv[found.sound] + [0.62, -0.35])
    assert np.abs(np.median(error, axis=0)).max() < 0.02
    assert np.percentile(np.abs(error), 90) < 0.1


def test_a_patch_that_has_settled_is_not_looked_at_again(monkeypatch):
    texture = Texture()
    image = texture.image()
    uv = grid_of_features()
    start = uv + np.where(np.arange(len(uv)) % 2, 0.0, 1.2)[:, None]
    looked_at = []

    def noted(image, u, v):
        looked_at.append(len(u))
        return _remap(image, u, v)

    template = sample_patches(image, uv)
    monkeypatch.setattr(patch_alignment, '_remap', noted)
    found = align_patches(template, image, start, np.ones(len(uv)))
    # Those that start where they lie take the first step alone, the others more.
    assert looked_at[0] == len(uv) and looked_at[1] == pytest.approx(len(uv) / 2, abs=1)
    assert found.sound.mean() > 0.9
    assert np.percentile(np.abs(found.uv_px - uv)[found.sound], 90) < 0.1


def test_follows_a_zoom():
    texture = Texture(1)
    image = texture.image()
    larger = warp(texture, lambda u, v: 150 + (u - 150) / 1.3, lambda u, v: 100 + (v - 100) / 1.3)
    uv = grid_of_features(margin=60)
    truth = [150, 100] + (uv - [150, 100]) * 1.3
    found = align_patches(sample_patches(image, uv), larger, truth + 0.5, np.full(len(uv), 1.3))
    assert found.sound.mean() > 0.9
    assert np.percentile(np.abs(found.uv_px - truth)[found.sound], 90) < 0.15


def test_weak_texture_in_noise_is_found_and_not_held_back() -> None:
    """Where a search starts, a patch with the slopes of its noise seems to lie."""
    rng, texture, uv = np.random.default_rng(0), Texture(6, waves=0.5), grid_of_features(11)
    shift = np.array([1.2, -0.8])
    images = [texture.image(), warp(texture, lambda u, v: u - shift[0], lambda u, v: v - shift[1])]
    weak = [128 + 3.0 / image.std() * (image - 128) for image in images]
    noisy = [np.rint(image + rng.normal(0, 2.0, image.shape)).astype(np.uint8) for image in weak]
    left, moved = map(smooth, noisy)
    found = align_patches(sample_patches(left, uv), moved, uv, np.ones(len(uv)))
    assert found.sound.mean() > 0.5
    error = (found.uv_px - uv - shift)[found.sound]
    assert np.linalg.norm(np.median(error, axis=0)) < 0.2 * np.linalg.norm(shift)
    squared = (error / found.sigma_px[found.sound]) ** 2
    assert np.median(squared.sum(axis=1)) / chi2.median(2) < 2.0


def test_a_patch_of_something_else_is_not_sound():
    uv = grid_of_features()
    found = align_patches(
        sample_patches(Texture(2).image(), uv), Texture(3).image(), uv, np.ones(len(uv))
    )
    assert found.sound.mean() < 0.05


def test_featureless_patches_are_not_sound():
    flat = np.full((200, 300), 90.0, np.float32)
    uv = grid_of_features()
    assert not align_patches(sample_patches(flat, uv), flat, uv, np.ones(len(uv))).sound.any()


@pytest.mark.parametrize('slant', [0.0, 0.4])
def test_disparity_of_a_floor_is_that_of_the_patch_centre(slant):
    # Disparity grows by `slant` per row, as on a floor; the right image shows u + d(v) of the left.
    texture = Texture(4)
    left = texture.image()
    right = 1.2 * warp(texture, lambda u, v: u + 20.3 + slant * (v - 100), lambda u, v: v) - 10
    uv = grid_of_features(margin=70)
    truth = 20.3 + slant * (uv[:, 1] - 100)
    guess = np.rint(truth + np.random.default_rng(0).uniform(-2, 2, len(truth)))
    disparity, sigma = refine_disparity(left, right, uv, guess, reach_px=4)
    found = np.isfinite(disparity)
    assert found.mean() > 0.8
    error = disparity[found] - truth[found]
    assert abs(np.median(error)) < 0.02
    assert 1.48 * np.median(np.abs(error)) < 0.08
    assert (sigma[found] < 0.5).all()


def test_no_disparity_beyond_the_reach():
    left = Texture(5).image()
    right = warp(Texture(5), lambda u, v: u + 20, lambda u, v: v)
    uv = grid_of_features(margin=70)
    disparity, _ = refine_disparity(left, right, uv, np.full(len(uv), 40.0), reach_px=4)
    assert np.isnan(disparity).mean() > 0.95


def test_nothing_in_nothing_out():
    image = Texture().image()
    disparity, sigma = refine_disparity(image, image, np.zeros((0, 2)), np.zeros(0), 4)
    assert disparity.shape == sigma.shape == (0,)


def test_no_patches_are_found_nowhere():
    image = np.zeros((40, 60), np.float32)
    none = np.zeros((0, 2))
    found = align_patches(sample_patches(image, none), image, none, np.zeros(0), along_row=True)
    assert found.uv_px.shape == (0, 2) and found.sigma_px.shape == (0, 2)
    assert found.sound.shape == (0,)
