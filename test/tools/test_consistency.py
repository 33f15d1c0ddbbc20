"""A covariance that is true passes, one that is too small does not."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from stereo_room import MOUNT

from segfloor_ros.core.contracts import FrameResult
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.slam.held_results import in_map
from segfloor_ros.core.twists import adjoint, se3_exp, without_drift
from tools.consistency import (
    MEDIAN_OF_3,
    Published,
    as_published,
    errors,
    read_rows,
    summary,
    table_of,
    windows,
)

N = 4000
SIGMA = np.repeat((0.01, 0.002), 3)


@pytest.fixture(scope='module')
def path():
    """The true poses of a camera at 10 Hz, and how they are published: each errs independently."""
    rng = np.random.default_rng(0)
    twists = np.cumsum(rng.normal(0, (0.02, 0.02, 0.02, 0.01, 0.01, 0.01), (N, 6)), axis=0)
    true = se3_exp(twists)
    estimated = true @ se3_exp(rng.normal(0, SIGMA, (N, 6)))
    stamps = 100_000_000 * np.arange(N)
    covariance = np.tile(np.diag(SIGMA**2), (N, 1, 1))
    return true, Published(stamps, estimated, covariance, np.zeros((N, 6, 10)))


@pytest.mark.parametrize('window_s', [0.1, 1.0])
def test_a_true_covariance_passes(path, window_s) -> None:
    true, published = path
    pairs = windows(published, window_s)
    assert (np.diff(pairs) == round(10 * window_s)).all()
    row = summary('drive', window_s, *errors(published, true, pairs, 0 * np.eye(6)))
    assert row.windows == N - round(10 * window_s)
    assert row.beyond_3 == pytest.approx(0.0027, abs=0.003)
    assert row.beyond_6 == 0
    assert row.translation == pytest.approx(MEDIAN_OF_3, rel=0.1)
    assert row.rotation == pytest.approx(MEDIAN_OF_3, rel=0.1)


def test_a_covariance_that_is_too_small_does_not(path) -> None:
    true, published = path
    small = dataclasses.replace(published, covariance=published.covariance / 16)
    pairs = windows(small, 1.0)
    row = summary('drive', 1.0, *errors(small, true, pairs, 0 * np.eye(6)))
    assert row.beyond_3 > 0.5
    assert row.translation == pytest.approx(16 * MEDIAN_OF_3, rel=0.1)
    # What the truth errs by itself makes it good again.
    noise = np.diag(SIGMA**2) * 15 / 16
    row = summary('drive', 1.0, *errors(small, true, pairs, noise))
    assert row.translation == pytest.approx(MEDIAN_OF_3, rel=0.1)


def test_drift_between_the_poses_counts(path) -> None:
    true, published = path
    rng = np.random.default_rng(2)
    drift, astray, T = np.zeros((N, 6, 10)), np.eye(4), np.empty_like(true)
    for k, pose in enumerate(published.T_odom_left):
        T[k] = astray @ pose
        if k % 3 == 0:
            error = rng.normal(0, SIGMA)
            A = adjoint(T[k])
            drift[k:, :, :6] += A @ np.diag(SIGMA**2) @ A.T
            astray = without_drift(T[k] @ se3_exp(error) @ invert(T[k]) @ astray)
            T[k] = astray @ pose
    pairs = windows(published, 1.0)
    gone = dataclasses.replace(published, T_odom_left=T, drift=drift)
    row = summary('drive', 1.0, *errors(gone, true, pairs, 0 * np.eye(6)))
    assert row.translation == pytest.approx(MEDIAN_OF_3, rel=0.1)
    assert row.rotation == pytest.approx(MEDIAN_OF_3, rel=0.1)
    ignored = dataclasses.replace(gone, drift=0 * drift)
    assert summary('drive', 1.0, *errors(ignored, true, pairs, 0 * np.eye(6))).rotation > 1.5


def test_windows_with_a_lost_frame_are_left_out(path) -> None:
    _, published = path
    T = published.T_odom_left[:30].copy()
    T[15] = np.nan
    lost = Published(published.stamp_ns[:30], T, published.covariance[:30], published.drift[:30])
    assert not ((windows(lost, 1.0) <= 15).any(1) & (windows(lost, 1.0) >= 15).any(1)).any()
    assert len(windows(lost, 1.0)) == (15 - 10) + (14 - 10)
    assert len(windows(lost, 5.0)) == 0


def test_the_covariance_of_the_base_becomes_that_of_the_camera() -> None:
    rng = np.random.default_rng(1)
    T_camera_world = se3_exp(rng.normal(0, 0.5, 6))
    root = rng.normal(0, 0.01, (6, 6))
    # That of a twist in exp(twist) T_camera_world, whose inverse errs on the right.
    tracked = FrameResult(
        0, 0, True, invert(T_camera_world), np.eye(4), root @ root.T, 50, 'tracking', 0
    )
    published = as_published([in_map(tracked, MOUNT.T_base_left)], np.zeros((1, 6, 10)), MOUNT)
    np.testing.assert_allclose(published.covariance[0], root @ root.T, atol=1e-12)
    np.testing.assert_allclose(
        invert(MOUNT.T_base_left) @ published.T_odom_left[0], invert(T_camera_world), atol=1e-12
    )


def test_figures_are_read_again(path, tmp_path) -> None:
    true, published = path
    pairs = windows(published, 1.0)
    row = summary('drive', 1.0, *errors(published, true, pairs, 0 * np.eye(6)))
    file = tmp_path / 'rows.json'
    file.write_text(json.dumps({'rows': [dataclasses.asdict(row)]}))
    assert read_rows(file) == {row.key: row}
    assert table_of([row], read_rows(file)).row_count == 1
