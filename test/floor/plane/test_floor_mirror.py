"""The mount on polished floors, whose matches are those of what they mirror."""

from dataclasses import replace

import numpy as np
import pytest
from floor_scenes import Patch, Scene, box, floor_patch, wall

from segfloor_ros.camera.model import Mount
from segfloor_ros.floor.plane.mirror import MIRRORED_SHARE, MirrorView, mirrored_share
from segfloor_ros.floor.plane.mount import MountEstimator
from segfloor_ros.floor.plane.plane_fit import Samples, mean_climb


def room(
    height_m: float = 0.3,
    pitch_deg: float = 7.0,
    reflectance: float = 0.4,
    contrast: float = 12.0,
    grey: float = 70.0,
    seed: int = 1,
) -> Scene:
    """A floor that mirrors a structured wall and a box, and plainer walls."""
    left = Patch((-1, 1.5, 0), (6, 0, 0), (0, 0, 2.5), False, contrast=45.0, seed=seed + 2)
    right = Patch((-1, -1.8, 0), (6, 0, 0), (0, 0, 2.5), False, contrast=8.0, seed=seed + 3)
    patches = [floor_patch(grey=grey, contrast=contrast, seed=seed), left, right]
    patches += [wall(contrast=8.0, seed=2), *box(1.8, 0.5, 0.4, 0.6, contrast=45.0)]
    mount = Mount(height_m, np.radians(pitch_deg))
    return Scene(patches, mount=mount, noise_grey=1.0, reflectance=reflectance)


def true_share(scene: Scene, plane_height_m: float) -> float:
    """Return the mirrored share of a level plane, with the scene's true depths as disparities."""
    left, _, _, depth_m = scene.render()
    camera = scene.camera
    disparity = (camera.disparity_times_depth / depth_m).astype(np.float32)
    rows, columns = (index.ravel() for index in np.mgrid[4:480:8, 4:640:8])
    rays = camera.back_project(np.stack([columns, rows], axis=1), np.ones(len(rows)))
    weight = np.ones(len(rows))
    values = disparity[rows, columns].astype(np.float64)
    samples = Samples(rays, np.zeros(3), values, weight, camera.disparity_times_depth)
    view = MirrorView.of(camera, left, disparity, samples, np.eye(4))
    below_m = scene.mount.height_m - plane_height_m
    return mirrored_share([view], np.array([scene.mount.pitch_rad, 0.0, below_m]))


def seen_through(scene: Scene) -> Scene:
    """Return the scene as a perfect mirror shows it: what stands, and the same upside down."""
    standing = [patch for patch in scene.patches if not patch.is_floor]
    return replace(scene, patches=standing + [p.below() for p in standing], reflectance=0.0)


def test_what_a_floor_mirrors_is_found_above_it():
    assert true_share(seen_through(room()), 0.0) > 0.8


@pytest.mark.parametrize('plane_height_m', [0.06, 0.12, 0.2])
def test_a_plane_above_a_dull_floor_does_not_mirror(plane_height_m):
    assert true_share(room(reflectance=0.0), plane_height_m) < MIRRORED_SHARE / 2


def test_where_nothing_is_seen_below_nothing_mirrors():
    assert true_share(room(reflectance=0.0), 0.0) == 0.0


def measured(scene: Scene, frames: int) -> Mount | None:
    left, right, _, _ = scene.render()
    estimator = MountEstimator(scene.camera)
    for _ in range(frames):
        estimator.add(left, right, np.eye(4))
    return estimator.mount


@pytest.mark.parametrize(
    ('height_m', 'pitch_deg', 'floor'),
    [(0.5, 12.0, {'seed': 51, 'grey': 50.0}), (0.21, 3.0, {'seed': 41})],
)
def test_the_mount_over_a_polished_floor(height_m, pitch_deg, floor):
    mount = measured(room(height_m, pitch_deg, **floor), 6)
    assert mount is not None
    assert mount.height_m == pytest.approx(height_m, rel=0.03)
    assert np.degrees(mount.pitch_rad) == pytest.approx(pitch_deg, abs=0.5)


def test_a_faint_mirror_is_measured():
    mount = measured(room(reflectance=0.4, contrast=12.0), 6)
    assert mount is not None
    assert mount.height_m == pytest.approx(0.3, rel=0.03)


def test_a_floor_lost_in_its_mirror_image_is_not_measured():
    assert measured(room(reflectance=0.7, contrast=5.0), 6) is None


def test_a_level_path_leaves_a_plane_that_dips():
    level = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 1.0]])
    planes = np.array([[0.0, 0.0, 0.3], [np.radians(2.0), 0.0, 0.3], [np.radians(19.0), 0.0, 2.3]])
    still, slope, dip = mean_climb(planes, level)
    assert still == 0.0
    assert slope < 1.0
    assert dip > 3.0
    assert (mean_climb(planes, np.zeros((0, 3))) == 0).all()


@pytest.mark.parametrize(('path_deg', 'settles'), [(0.0, True), (25.0, False)])
def test_a_floor_that_the_robot_drives_into_is_none(path_deg, settles):
    scene = Scene([floor_patch(), wall()])
    estimator = MountEstimator(scene.camera)
    bare_left, bare_right, _, _ = Scene([wall(1.0)], mount=scene.mount).render()
    estimator.add(bare_left, bare_right, np.eye(4))
    assert estimator.mount is None
    moved = np.eye(4)
    into_floor = scene.mount.pitch_rad - np.radians(path_deg)
    moved[:3, 3] = 0.6 * np.array([0.0, -np.sin(into_floor), np.cos(into_floor)])
    left, right, _, _ = scene.render()
    for _ in range(3):
        estimator.add(left, right, moved)
    assert (estimator.mount is not None) is settles
