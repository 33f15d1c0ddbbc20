"""The mount measured from the floor of rendered scenes and of recordings."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from floor_scenes import (
    CAMERA,
    SMALL_CAMERA,
    Patch,
    Scene,
    blank_floored,
    box,
    floor_patch,
    ramp,
    wall,
)

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import Mount, StereoFrame
from segfloor_ros.core.floor.plane.mount import (
    MAX_KEYFRAMES,
    MountEstimator,
    MountViewer,
    disagreement,
)
from segfloor_ros.core.floor.plane.plane import mean_climb, shares
from segfloor_ros.core.plugins.assembly import make_pipeline, make_slam
from segfloor_ros.core.plugins.sensors.gyroscope import STEP_NS
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.twists import se3_exp
from segfloor_ros.nodes.configuration import resolve

LEANING = se3_exp(np.array([0.4, 0.1, -0.3, 0.7, -0.4, 0.3]))
"""The first camera in a world whose axes are pitched, turned and rolled."""


def estimate(scene: Scene, **known) -> Mount | None:
    left, right, _, _ = scene.render()
    estimator = MountEstimator(scene.camera, **known)
    estimator.add(left, right, np.eye(4))
    return estimator.mount


@pytest.mark.parametrize(
    ('height_m', 'pitch_deg', 'roll_deg'), [(0.3, 7.0, 0.0), (0.5, 15.0, 4.0), (0.25, 0.0, -3.0)]
)
def test_one_frame_of_plain_floor_is_enough(height_m, pitch_deg, roll_deg):
    true = Mount(height_m, np.radians(pitch_deg), np.radians(roll_deg))
    scene = Scene([floor_patch(), wall(), *box(1.6, 0.5, 0.4, 0.3)], mount=true)
    mount = estimate(scene)
    assert mount is not None
    assert mount.height_m == pytest.approx(height_m, rel=0.02)
    assert np.degrees(mount.pitch_rad) == pytest.approx(pitch_deg, abs=0.2)
    assert np.degrees(mount.roll_rad) == pytest.approx(roll_deg, abs=0.2)


def test_a_small_image_is_enough():
    scene = Scene([floor_patch(), wall(), *box(1.6, 0.5, 0.4, 0.3)], camera=SMALL_CAMERA)
    mount = mounts_on_the_way(scene, 4)[-1]
    assert mount is not None
    assert mount.height_m == pytest.approx(0.3, rel=0.03)


def test_what_is_known_is_kept():
    scene = Scene([floor_patch(), wall()])
    mount = estimate(scene, height_m=0.3, roll_rad=0.0, forward_m=0.2, left_m=-0.1)
    assert mount is not None
    assert (mount.height_m, mount.roll_rad) == (0.3, 0.0)
    assert (mount.forward_m, mount.left_m) == (0.2, -0.1)
    assert np.degrees(mount.pitch_rad) == pytest.approx(7.0, abs=0.2)


def test_a_floor_nearer_than_is_searched_is_found() -> None:
    """Of a low camera with eyes far apart the near floor's disparities are over a quarter of the
    width, as far as a matcher looks while no mount is known: what it matches there is not there.
    """
    camera = replace(CAMERA, fx=300.0, fy=300.0, baseline_m=0.14)
    true = Mount(0.16, np.radians(10.0))
    mount = estimate(Scene([floor_patch(), wall()], camera=camera, mount=true))
    assert mount is not None
    assert mount.height_m == pytest.approx(0.16, rel=0.02)
    assert np.degrees(mount.pitch_rad) == pytest.approx(10.0, abs=0.2)


def test_a_table_is_not_the_floor():
    table = Patch((0.8, -0.8, 0.45), (1.2, 0, 0), (0, 1.6, 0), False, seed=8)
    scene = Scene([floor_patch(), wall(), table], mount=Mount(0.9, np.radians(15.0)))
    mount = estimate(scene)
    assert mount is None or mount.height_m == pytest.approx(0.9, rel=0.03)


def test_a_wall_is_not_the_floor():
    assert estimate(Scene([wall(1.0)], mount=Mount(0.3))) is None


def test_nothing_is_seen_of_a_blank_scene():
    assert estimate(Scene([floor_patch(contrast=0.0), wall(contrast=0.0)], noise_grey=1.0)) is None


def test_a_look_at_the_rows_of_the_floor_shows_the_same_floor() -> None:
    scene = Scene([floor_patch(), wall(), *box(1.6, 0.5, 0.4, 0.3)])
    left, right, _, _ = scene.render()
    true = np.array([scene.mount.pitch_rad, scene.mount.roll_rad, scene.mount.height_m])
    viewer = MountViewer(scene.camera, scene.mount)
    first = viewer.first_row
    assert first > 100
    disparity = viewer.disparity(left[first:], right[first:])
    samples = viewer.surfaces(left[first:], right[first:], disparity, 1.0)
    assert len(samples.weight) > 500
    on, below = shares(samples, true)
    assert on > 0.6 and below < 0.02


def test_a_height_that_is_off_by_three_per_cent_does_harm() -> None:
    used, sigma = Mount(1.7), np.zeros(3)
    assert disagreement(used, Mount(1.64), sigma) is not None
    assert disagreement(used, Mount(1.66), sigma) is None


def test_a_camera_that_hangs_upside_down_is_told() -> None:
    scene = Scene([floor_patch(), wall(), *box(1.6, 0.5, 0.4, 0.3)])
    left, right, _, _ = scene.render()
    remark = remark_after_looks(scene.camera, right[::-1, ::-1].copy(), left[::-1, ::-1].copy())
    assert 'upside down' in remark and '0.3 m above' in remark


def test_a_world_that_is_too_large_is_told() -> None:
    scene = Scene([floor_patch(), wall(), *box(1.6, 0.5, 0.4, 0.3)], mount=Mount(0.7, 0.2))
    left, right, _, _ = scene.render()
    camera = replace(scene.camera, baseline_m=10 * scene.camera.baseline_m)
    remark = remark_after_looks(camera, left, right)
    assert '7.0 m below' in remark and 'baseline' in remark


def test_of_a_wall_alone_nothing_is_told() -> None:
    scene = Scene([wall(1.0)], mount=Mount(0.3))
    left, right, _, _ = scene.render()
    assert remark_after_looks(scene.camera, left, right) is None


def remark_after_looks(camera, left, right) -> str | None:
    """Return what is said of a mount that is not found in as many looks as there are at most."""
    estimator = MountEstimator(camera)
    for _ in range(MAX_KEYFRAMES):
        estimator.add(left, right, np.eye(4))
    assert estimator.mount is None
    return estimator.remark


def mounts_on_the_way(scene: Scene, frames: int, step_m: float = 0.15) -> list[Mount | None]:
    """Return what a robot that drives ahead over the floor has measured after each frame."""
    estimator = MountEstimator(scene.camera)
    T_left_base = np.linalg.inv(scene.mount.T_base_left)
    mounts = []
    for i in range(frames):
        here = replace(scene.mount, forward_m=i * step_m)
        left, right, _, _ = replace(scene, mount=here).render()
        estimator.add(left, right, T_left_base @ here.T_base_left)
        mounts.append(estimator.mount)
    return mounts


@pytest.mark.parametrize(
    ('height_m', 'pitch_deg', 'roll_deg', 'noise_grey'),
    [(0.35, 8.0, 0.0, 1.0), (0.2, 5.0, 2.0, 1.0), (0.3, 7.0, 0.0, 5.0)],
)
def test_a_floor_of_one_colour_is_where_things_stand(height_m, pitch_deg, roll_deg, noise_grey):
    true = Mount(height_m, np.radians(pitch_deg), np.radians(roll_deg))
    scene = replace(blank_floored(true, *box(1.6, 0.5, 0.4, 0.3)), noise_grey=noise_grey)
    mount = mounts_on_the_way(scene, 4)[-1]
    assert mount is not None
    assert mount.height_m == pytest.approx(height_m, rel=0.03)
    assert np.degrees(mount.pitch_rad) == pytest.approx(pitch_deg, abs=0.3)
    assert np.degrees(mount.roll_rad) == pytest.approx(roll_deg, abs=0.5)


SWAYING = [(0.35, 8.0), (0.31, 11.0), (0.39, 6.0), (0.33, 12.0), (0.38, 5.0), (0.32, 10.0)]
"""Heights in m and pitches in degrees of a camera that is carried in a hand."""


@pytest.mark.slow
@pytest.mark.parametrize('poses_sway', [True, False], ids=['seen by SLAM', 'not seen by SLAM'])
def test_a_camera_that_a_hand_holds_has_no_mount(poses_sway):
    """Where the poses sway, it keeps no place above the plane; else planes do not repeat."""
    scene = blank_floored(Mount(0.35, np.radians(8.0)), *box(1.6, 0.5, 0.4, 0.3))
    estimator = MountEstimator(scene.camera)
    T_left_base = np.linalg.inv(scene.mount.T_base_left)
    for i, (height_m, pitch_deg) in enumerate(SWAYING):
        seen_from = Mount(height_m, np.radians(pitch_deg), forward_m=0.15 * i)
        left, right, _, _ = replace(scene, mount=seen_from).render()
        told = seen_from if poses_sway else replace(scene.mount, forward_m=0.15 * i)
        estimator.add(left, right, T_left_base @ told.T_base_left)
    assert estimator.mount is None


@pytest.mark.slow
def test_poses_come_before_the_mount_is_known():
    scene = blank_floored(Mount(0.35, np.radians(8.0)), *box(1.6, 0.5, 0.4, 0.3))
    scene = replace(scene, camera=SMALL_CAMERA)
    slam = make_slam(scene.camera, StereoSlamSettings(keyframe_max_frames=1))
    come, positions = [], []
    for i in range(8):
        here = replace(scene.mount, forward_m=0.1 * i)
        left, right, _, _ = replace(scene, mount=here).render()
        come.append(len(slam.process(StereoFrame(i, i * 10**8, left, right))))
        if slam.session.provisional is not None:
            positions.append(slam.session.provisional.T_odom_base[:3, 3])
    settled = come.index(max(come))
    assert settled > 0
    # One for each frame before, none since, and nothing is lost.
    assert len(positions) == settled
    assert come == [0] * settled + [settled + 1] + [1] * (7 - settled)
    assert positions[-1] == pytest.approx([0.1 * (settled - 1), 0.0, 0.0], abs=0.02)


@pytest.mark.slow
def test_a_camera_that_is_lost_before_its_mount_is_known_begins_again():
    """It faces a wall and turns away from it: nothing of what it saw first is seen again."""
    mount = Mount(0.35, np.radians(8.0))
    faced = Scene([wall(1.0, contrast=45.0, seed=9)], mount=mount, noise_grey=1.0)
    room = blank_floored(mount, *box(1.6, 0.5, 0.4, 0.3))
    slam = make_slam(SMALL_CAMERA, StereoSlamSettings(keyframe_max_frames=1))
    results = []
    for i in range(20):
        here = replace(mount, forward_m=0.1 * max(0, i - 8))
        scene = replace(faced if i < 3 else room, mount=here, camera=SMALL_CAMERA)
        left, right, _, _ = scene.render()
        results += slam.process(StereoFrame(i, i * 4 * 10**8, left, right))
    assert [r.index for r in results] == list(range(20))
    assert [r.index for r in results if not r.tracked] == [3, 4, 5, 6]
    assert slam.mount is not None
    assert slam.mount.height_m == pytest.approx(0.35, rel=0.04)
    path = next(r.keyframe.path for r in reversed(results) if r.keyframe)
    assert path.stamp_ns[0] == results[7].stamp_ns


@pytest.mark.slow
def test_after_a_while_the_best_plane_will_do():
    """A small rug is all that has texture: nothing shows its plane better than to some per cent."""
    rug = Patch((0.9, -0.15, 0.0), (0.2, 0, 0), (0, 0.13, 0), True, contrast=25.0, seed=5)
    floor, blank = floor_patch(grey=175.0, contrast=0.0), wall(4.0, contrast=0.0)
    scene = Scene([floor, blank, rug], mount=Mount(0.3, np.radians(7.0)), noise_grey=2.0)
    mounts = mounts_on_the_way(scene, 20, step_m=0.01)
    assert mounts[18] is None
    mount = mounts[19]
    assert mount is not None
    assert mount.height_m == pytest.approx(0.3, rel=0.05)


def test_posters_on_a_blank_wall_are_not_the_floor():
    """They hang at one height, and nothing shows where the wall ends."""
    poster = [
        Patch((2.9, y, 0.12), (0, 0.5, 0), (0, 0, 0.4), False, contrast=45.0, seed=i)
        for i, y in enumerate((-1.0, 0.5))
    ]
    floor = floor_patch(grey=175.0, contrast=0.0)
    blank = wall(3.0, grey=175.0, contrast=0.0)
    scene = Scene([floor, blank, *poster], mount=Mount(0.35, np.radians(8.0)), noise_grey=1.0)
    assert mounts_on_the_way(scene, 8) == [None] * 8


@pytest.mark.parametrize(
    ('height_m', 'pitch_deg', 'reflectance', 'contrast', 'seed'),
    [
        (0.5, 12.0, 0.4, 12.0, 51),
        (0.21, 3.0, 0.4, 12.0, 41),
        (0.3, 7.0, 0.4, 12.0, 1),
        (0.3, 7.0, 0.7, 5.0, 1),
    ],
)
def test_what_a_polished_floor_mirrors_is_not_the_floor(
    height_m, pitch_deg, reflectance, contrast, seed
):
    """What it mirrors lies below it, and speaks against it: nothing is known of it then."""
    left = Patch((-1, 1.5, 0), (6, 0, 0), (0, 0, 2.5), False, contrast=45.0, seed=seed + 2)
    right = Patch((-1, -1.8, 0), (6, 0, 0), (0, 0, 2.5), False, contrast=8.0, seed=seed + 3)
    patches = [floor_patch(grey=70.0, contrast=contrast, seed=seed), left, right]
    patches += [wall(contrast=8.0, seed=2), *box(1.8, 0.5, 0.4, 0.6, contrast=45.0)]
    scene = Scene(
        patches,
        mount=Mount(height_m, np.radians(pitch_deg)),
        noise_grey=1.0,
        reflectance=reflectance,
    )
    left_image, right_image, _, _ = scene.render()
    estimator = MountEstimator(scene.camera)
    for _ in range(6):
        estimator.add(left_image, right_image, np.eye(4))
    mount = estimator.mount
    assert mount is None or mount.height_m == pytest.approx(height_m, rel=0.03)


def test_a_level_path_leaves_a_plane_that_dips():
    level = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 1.0]])
    planes = np.array([[0.0, 0.0, 0.3], [np.radians(2.0), 0.0, 0.3], [np.radians(19.0), 0.0, 2.3]])
    still, slope, dip = mean_climb(planes, level)
    assert still == 0.0
    assert slope < 1.0
    assert dip > 3.0
    assert (mean_climb(planes, np.zeros((0, 3))) == 0).all()


@pytest.mark.parametrize(('path_deg', 'settles'), [(0.0, True), (25.0, False)])
@pytest.mark.parametrize('T_world_first', [np.eye(4), LEANING], ids=['level', 'leaning'])
def test_a_floor_that_the_robot_drives_into_is_none(path_deg, settles, T_world_first):
    """The axes of the world need not be those of the first camera: a map may begin on a ramp."""
    scene = Scene([floor_patch(), wall()])
    estimator = MountEstimator(scene.camera)
    bare_left, bare_right, _, _ = Scene([wall(1.0)], mount=scene.mount).render()
    estimator.add(bare_left, bare_right, T_world_first)
    assert estimator.mount is None
    moved = np.eye(4)
    into_floor = scene.mount.pitch_rad - np.radians(path_deg)
    moved[:3, 3] = 0.6 * np.array([0.0, -np.sin(into_floor), np.cos(into_floor)])
    left, right, _, _ = scene.render()
    for _ in range(4):
        estimator.add(left, right, T_world_first @ moved)
    assert (estimator.mount is not None) is settles


@pytest.mark.parametrize('T_world_first', [np.eye(4), LEANING], ids=['level', 'leaning'])
def test_a_ramp_that_shows_more_than_the_floor_is_not_what_the_robot_drives_on(T_world_first):
    """Its way says which of both is the floor, whatever the axes of the world."""
    ahead = ramp(1.0, np.radians(18.0), contrast=30.0)
    scene = Scene([floor_patch(far_m=1.0, contrast=6.0), ahead], camera=SMALL_CAMERA)
    bare = Scene([wall(1.0)], camera=SMALL_CAMERA, mount=scene.mount)
    estimator = MountEstimator(SMALL_CAMERA)
    T_left_base = np.linalg.inv(scene.mount.T_base_left)
    for i in range(4):
        here = replace(scene.mount, forward_m=0.15 * i)
        left, right, _, _ = replace(scene if i else bare, mount=here).render()
        estimator.add(left, right, T_world_first @ T_left_base @ here.T_base_left)
    assert estimator.mount is not None
    assert estimator.mount.height_m == pytest.approx(0.3, rel=0.03)
    assert np.degrees(estimator.mount.pitch_rad) == pytest.approx(7.0, abs=0.6)


def test_a_camera_that_was_lost_is_measured_by_what_it_sees_since():
    """It stood on a stage before: by the frames of both worlds it would have no mount at all."""
    before, now = (
        replace(Scene([floor_patch(), wall()], camera=SMALL_CAMERA, noise_grey=1.0), mount=mount)
        for mount in (Mount(0.3, np.radians(7.0)), Mount(0.45, np.radians(12.0)))
    )
    estimator = MountEstimator(SMALL_CAMERA)
    weak = replace(before, patches=[floor_patch(contrast=2.0), wall()], noise_grey=4.0)
    for _ in range(3):
        estimator.add(*weak.render()[:2], np.eye(4))
    assert estimator.mount is None
    estimator.reset()
    for _ in range(4):
        estimator.add(*now.render()[:2], LEANING)
    assert estimator.mount is not None
    assert estimator.mount.height_m == pytest.approx(0.45, rel=0.03)
    assert np.degrees(estimator.mount.pitch_rad) == pytest.approx(12.0, abs=0.4)


def test_disagreement_names_both_numbers():
    used, seen = Mount(0.35, np.radians(7.0)), Mount(0.30, np.radians(10.0))
    words = disagreement(used, seen, np.zeros(3))
    assert words is not None
    for number in ('0.350 m', '0.300 m', '7.0 deg', '10.0 deg'):
        assert number in words
    assert disagreement(used, used, np.zeros(3)) is None
    # Neither is known well enough to say so.
    assert disagreement(used, seen, np.array([0.03, 0.03, 0.04])) is None


@pytest.mark.slow
def test_a_mount_that_later_looks_contradict_is_corrected_and_the_map_follows():
    """It begins before a stage, drives past it, and sees the floor then."""
    mount = Mount(0.35, np.radians(8.0))
    stage = Patch((0.2, -2.0, 0.1), (1.2, 0, 0), (0, 4.0, 0), True, contrast=30.0, seed=5)
    scene = Scene([floor_patch(), wall(7.0), stage], camera=SMALL_CAMERA, noise_grey=1.0)
    every = resolve(assignments=['stereo_slam.keyframe_max_frames=1'])
    pipeline = make_pipeline(SMALL_CAMERA, every)
    results, heights_m = [], []
    for i in range(48):
        here = replace(mount, forward_m=0.1 * i)
        left, right, _, _ = replace(scene, mount=here, seed=i).render()
        results.append(pipeline.process(StereoFrame(i, i * 10**8, left, right)))
        heights_m.append(pipeline.mount.height_m if pipeline.mount else None)
    pipeline.finish_tracking()
    grid = pipeline.finish()
    first = next(height_m for height_m in heights_m if height_m)
    assert first == pytest.approx(0.25, rel=0.05)
    assert heights_m[-1] == pytest.approx(0.35, rel=0.03)
    assert len(set(heights_m) - {None}) == 2
    changed = heights_m.index(heights_m[-1])
    # All of the drive comes once more, as it is seen with the mount that is right.
    assert [result.index for result in results[changed]] == list(range(changed + 1))
    assert [len(one) for one in results[changed + 1 :]] == [1] * (47 - changed)
    keyframes = {r.index for one in results[changed:] for r in one if r.keyframe is not None}
    assert pipeline.keyframe_stages.map_updates == len(keyframes)
    assert min(keyframes) == 0
    assert grid is not None
    (words,) = pipeline.slam.sensors.remarks.values()
    assert 'height 0.2' in words
    assert 'made anew' in words


def kitti_folder(folder, pose_name='poses.txt'):
    rows = [line.split() for line in (folder / 'calib.txt').read_text().splitlines()]
    P0, P1 = (np.array(row[1:], float).reshape(3, 4) for row in rows[:2])
    image = cv2.imread(str(folder / 'image_0' / '000000.png'), 0)
    camera = StereoCamera(
        image.shape[1], image.shape[0], P0[0, 0], P0[1, 1], P0[0, 2], P0[1, 2], -P1[0, 3] / P1[0, 0]
    )
    poses = np.tile(np.eye(4), (len(np.loadtxt(folder / pose_name)), 1, 1))
    poses[:, :3] = np.loadtxt(folder / pose_name).reshape(-1, 3, 4)
    return camera, poses


def measured(folder, frames) -> Mount | None:
    camera, poses = kitti_folder(folder)
    estimator = MountEstimator(camera)
    for i in frames:
        pair = [cv2.imread(str(folder / f'image_{k}' / f'{i:06d}.png'), 0) for k in (0, 1)]
        estimator.add(*pair, poses[i])
    return estimator.mount


def test_corridor(shared_data):
    mount = measured(shared_data / 'corridor', [0])
    assert mount is not None
    assert mount.height_m == pytest.approx(0.30, abs=0.005)
    assert np.degrees(mount.pitch_rad) == pytest.approx(7.0, abs=0.2)
    assert np.degrees(mount.roll_rad) == pytest.approx(0.0, abs=0.2)


def test_car_on_a_road(shared_data):
    mount = measured(shared_data / 'kitti06', range(0, 30, 3))
    assert mount is not None
    assert mount.height_m == pytest.approx(1.65, abs=0.05)


@pytest.mark.slow
def test_a_camera_that_stands_has_a_mount_too():
    """It has but one keyframe. Its floor is seen ever again, and no better: it takes some time."""
    scene = Scene([floor_patch(), wall(), *box(1.6, 0.5, 0.4, 0.3)], camera=SMALL_CAMERA)
    slam = make_slam(SMALL_CAMERA, StereoSlamSettings())
    results = []
    for i in range(MAX_KEYFRAMES):
        left, right, _, _ = replace(scene, seed=i).render()
        results += slam.process(StereoFrame(i, i * STEP_NS, left, right))
    assert len(slam.map.keyframes) == 1
    assert slam.mount is not None
    assert slam.mount.height_m == pytest.approx(0.3, rel=0.03)
    # What was held back comes, with the keyframe.
    assert [result.index for result in results] == list(range(MAX_KEYFRAMES))
    assert results[0].keyframe is not None


@pytest.mark.parametrize('is_new_view', [False, True])
def test_looks_at_one_view_are_worth_one(is_new_view):
    scene = Scene([floor_patch(contrast=4.0), wall()], camera=SMALL_CAMERA, noise_grey=3.0)
    estimator = MountEstimator(SMALL_CAMERA)
    left, right, _, _ = scene.render()
    for i in range(MAX_KEYFRAMES - 1):
        estimator.add(left, right, np.eye(4), is_new_view=i == 0 or is_new_view)
    assert (estimator.mount is not None) == is_new_view
