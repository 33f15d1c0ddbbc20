"""Spreading and matching on hand-made features."""

import math

import cv2
import numpy as np

from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.tracking import images
from segfloor_ros.core.slam.tracking.images import (
    FeatureExtractor,
    Features,
    hamming,
    match_predicted,
    match_unguided,
    one_to_one,
    spread,
)


def descriptors(count, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, 32), dtype=np.uint8)


def features(uv, seed=0, octave=None):
    uv = np.asarray(uv, np.float32)
    octave = np.zeros(len(uv), np.uint8) if octave is None else np.asarray(octave, np.uint8)
    return Features(uv, octave, descriptors(len(uv), seed))


def test_hamming_counts_bits():
    a = np.zeros((1, 32), np.uint8)
    b = a.copy()
    b[0, 0], b[0, 31] = 0b101, 0xFF
    np.testing.assert_array_equal(hamming(a, b), [10])


def test_spread_serves_every_cell_before_any_second_corner():
    # Cell (0, 0) has three strong corners, cell (1, 0) one weak one.
    uv = np.array([[1, 1], [2, 2], [3, 3], [20, 1]], np.float32)
    response = np.array([9, 8, 7, 1], np.float32)
    np.testing.assert_array_equal(spread(uv, response, cell_px=16, budget=2), [0, 3])
    np.testing.assert_array_equal(spread(uv, response, cell_px=16, budget=3), [0, 1, 3])


def test_one_to_one_keeps_the_nearest_of_both_ends():
    a, b = np.array([0, 0, 1, 2]), np.array([5, 6, 5, 7])
    distance = np.array([10, 4, 3, 9])
    kept = one_to_one(a, b, distance)
    np.testing.assert_array_equal(kept[0], [0, 1, 2])
    np.testing.assert_array_equal(kept[1], [6, 5, 7])


def test_a_single_feature_is_matched_by_the_point_it_shows():
    seen = features([[50, 50]])
    near = np.array([[200.0, 200.0], [52.0, 51.0], [90.0, 50.0]])
    wanted = np.concatenate([descriptors(1, 7), seen.descriptor, descriptors(1, 8)])
    points, rows = match_predicted(seen, near, np.zeros(3), wanted, np.full(3, 15.0))
    np.testing.assert_array_equal(points, [1])
    np.testing.assert_array_equal(rows, [0])


def test_predicted_matches_need_nearness_and_a_clear_winner():
    seen = features([[50, 50], [60, 50], [200, 200]])
    near = np.array([[52.0, 51.0], [150.0, 150.0]])
    wanted = seen.descriptor[[0, 2]]
    points, rows = match_predicted(seen, near, np.zeros(2), wanted, np.full(2, 15.0))
    np.testing.assert_array_equal(points, [0])
    np.testing.assert_array_equal(rows, [0])
    # Two features alike but for a few bits, both at a small distance: nothing shows which it is.
    twin = seen.descriptor.copy()
    twin[1] = twin[0]
    twin[0, 0] ^= 0xFF
    twin[1, 1] ^= 0xFF
    twins = Features(seen.uv_px, seen.octave, twin)
    points, _ = match_predicted(twins, near, np.zeros(2), wanted, np.full(2, 15.0))
    assert len(points) == 0


def test_predicted_matches_respect_the_pyramid_level():
    seen = features([[50, 50]], octave=[4])
    at, radius = np.array([[50.0, 50.0]]), np.array([15.0])
    assert len(match_predicted(seen, at, np.array([4.0]), seen.descriptor, radius)[0]) == 1
    assert len(match_predicted(seen, at, np.array([1.0]), seen.descriptor, radius)[0]) == 0


def test_unguided_matches_are_mutual_and_bounded():
    base = descriptors(20)
    shuffled = np.random.default_rng(1).permutation(20)
    query, train = match_unguided(base, base[shuffled])
    np.testing.assert_array_equal(shuffled[train], query)
    assert len(query) == 20
    assert len(match_unguided(base, descriptors(20, seed=9))[0]) == 0
    assert len(match_unguided(base, np.zeros((0, 32), np.uint8))[0]) == 0


def test_extractor_places_features_of_every_level_exactly():
    # Corners of a square lie symmetrically about its centre, whatever pyramid level found them.
    image = np.full((240, 320), 90, np.uint8)
    image[100:140, 150:190] = 200
    found = FeatureExtractor(StereoSlamSettings(num_features=400)).extract(image)
    levels = np.unique(found.octave)
    assert len(levels) >= 4
    for level in levels:
        uv = found.uv_px[found.octave == level]
        centre = (uv.min(axis=0) + uv.max(axis=0)) / 2
        np.testing.assert_allclose(centre, [169.5, 119.5], atol=0.3 * 1.2**level)


def test_extractor_finds_nothing_in_a_blank_image():
    found = FeatureExtractor(StereoSlamSettings()).extract(np.full((120, 160), 77, np.uint8))
    assert len(found) == 0


def test_in_strong_noise_corners_are_those_of_the_scene(monkeypatch):
    rng = np.random.default_rng(3)
    scene = cv2.GaussianBlur(rng.normal(0, 1, (240, 320)), (0, 0), 4.0)
    scene = 110 + 14 * scene / scene.std()

    def found_again() -> int:
        seen = []
        for _ in range(2):
            image = np.clip(scene + rng.normal(0, 6, scene.shape), 0, 255).astype(np.uint8)
            seen.append(FeatureExtractor(StereoSlamSettings()).extract(image))
        a, b = match_unguided(seen[0].descriptor, seen[1].descriptor)
        off_px = np.linalg.norm(seen[0].uv_px[a] - seen[1].uv_px[b], axis=1)
        return int((off_px < 2).sum())

    smoothed = found_again()
    monkeypatch.setattr(images, 'NOISY_GREY', math.inf)
    assert smoothed > 1.25 * found_again()
