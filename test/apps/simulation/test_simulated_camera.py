"""Each effect of a real camera, measured in the image for what it claims."""

import numpy as np
import pytest

from segfloor_ros.apps.simulation.camera import depth_reading_mm, develop, moments_s, plan_imaging
from segfloor_ros.apps.simulation.scene import CameraRig, DepthSensor, Route, Scene, Sensors
from segfloor_ros.apps.simulation.scene_file import open_scene, scene_from_mapping, shipped
from segfloor_ros.apps.simulation.simulation import Simulation
from segfloor_ros.apps.simulation.world import RenderingError
from segfloor_ros.core.errors import InputError

WIDTH, HEIGHT = 160, 120
U, V = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
ROUTE = Route(((0.0, 0.0), (1.0, 0.0)))


def scene_with(depth=None, **effects):
    effects = {'noise_sigma': 0.0, **effects}
    rig = CameraRig(width=WIDTH, height=HEIGHT, **effects)
    return Scene('test', ROUTE, camera=rig, sensors=Sensors(depth=depth or DepthSensor()))


def image(ideal, side=0, time_s=0.0, **effects):
    """Return what a camera with these effects delivers, as numbers with a sign."""
    scene = scene_with(**effects)
    return develop(ideal, plan_imaging(scene), scene, side, 0, time_s).astype(float)


def flat(grey):
    return np.full((HEIGHT, WIDTH), grey, np.float32)


def test_the_variance_of_shot_noise_grows_with_the_grey_level():
    for grey in (40, 80, 200):
        noisy = image(flat(grey), noise_sigma=2.0, shot_noise=6.0)
        # Rounding to whole grey levels adds a twelfth.
        assert noisy.var() == pytest.approx(4 + 36 * grey / 255 + 1 / 12, rel=0.05)
        assert noisy.mean() == pytest.approx(grey, abs=0.2)


def test_the_corners_lose_the_share_of_the_light_and_the_middle_none():
    dimmed = image(flat(200), vignetting=0.3)
    assert dimmed[HEIGHT // 2, WIDTH // 2] == 200
    assert dimmed[0, 0] == dimmed[-1, -1] == pytest.approx(140, abs=1)


def test_a_soft_lens_spreads_an_edge_by_its_deviation():
    edge = np.where(U < WIDTH / 2, 0, 250).astype(np.float32)
    spread = np.diff(image(edge, softness_px=1.5)[60])
    place = np.arange(WIDTH - 1)
    middle = (spread * place).sum() / spread.sum()
    assert np.sqrt((spread * (place - middle) ** 2).sum() / spread.sum()) == pytest.approx(1.5, 0.1)


INNER = (slice(20, -20), slice(20, -20))
LEVELS_PER_PX = 20
ROWS, COLUMNS = ((128 + LEVELS_PER_PX * (axis - axis.mean())) for axis in (V, U))


def shift_px(axis, **effects):
    """Return how far the right image lies towards the end of an axis in the inner parts of the
    picture, where neither end of the grey scale is met.
    """
    ramp = ROWS if axis == 0 else COLUMNS
    change = image(ramp, side=0) - image(ramp, side=1, **effects)
    return np.where((ramp > 30) & (ramp < 225), change / LEVELS_PER_PX, np.nan)


def test_the_rows_of_the_right_image_are_lower_and_swing_to_the_opposite():
    assert np.nanmean(shift_px(0, row_offset_px=0.3)[INNER]) == pytest.approx(0.3, abs=0.02)
    assert np.nanmean(shift_px(1, row_offset_px=0.3)[INNER]) == pytest.approx(0.0, abs=0.02)
    half = shift_px(0, row_offset_px=0.3, drift_s=60.0, time_s=30.0)
    assert np.nanmean(half[INNER]) == pytest.approx(-0.3, abs=0.02)
    np.testing.assert_array_equal(image(ROWS, 0, row_offset_px=0.3), image(ROWS, 0))


def test_a_rolled_right_image_is_lower_on_its_right():
    turned = shift_px(0, pair_roll_deg=0.5)
    for column in (30, 130):
        wanted = np.radians(0.5) * (column - (WIDTH - 1) / 2)
        assert np.nanmean(turned[20:-20, column]) == pytest.approx(wanted, abs=0.04)


def test_a_longer_focal_length_moves_what_is_off_the_middle_outwards():
    moved = shift_px(1, pair_focal=0.05)
    for column in (75, 84):
        wanted = 0.05 * (column - (WIDTH - 1) / 2)
        assert np.nanmean(moved[20:-20, column]) == pytest.approx(wanted, abs=0.06)


def test_each_eye_makes_up_for_the_light_it_sees():
    for side, grey in ((0, 60), (1, 180)):
        assert image(flat(grey), side, auto_exposure=1.0).mean() == pytest.approx(118, abs=0.5)
    # Half of a change: 118 / 60 to the power of one half.
    assert image(flat(60), auto_exposure=0.5).mean() == pytest.approx(60 * (118 / 60) ** 0.5, abs=1)
    # What is amplified has more noise, and no sensor sees in the dark.
    assert image(flat(30), auto_exposure=1.0, noise_sigma=1.0).std() == pytest.approx(118 / 30, 0.1)
    assert image(flat(0), auto_exposure=1.0, noise_sigma=1.0).std() < 16


def test_a_darker_right_eye_swings_to_a_lighter_one():
    assert image(flat(100), 1, right_gain=0.8).mean() == 80
    swing = {'right_gain': 0.8, 'drift_s': 60.0}
    assert image(flat(100), 1, time_s=30.0, **swing).mean() == 125
    assert image(flat(100), 1, time_s=15.0, **swing).mean() == 100


def test_a_mosaic_makes_noise_of_neighbours_alike():
    grainy = image(flat(120), noise_sigma=4.0)
    mixed = image(flat(120), noise_sigma=4.0, bayer=True)
    assert mixed.mean() == pytest.approx(120, abs=0.3)
    alike = [np.corrcoef(a[:, :-1].ravel(), a[:, 1:].ravel())[0, 1] for a in (grainy, mixed)]
    assert abs(alike[0]) < 0.03
    assert alike[1] > 0.3


def test_jpeg_costs_more_at_a_lower_quality():
    grain = flat(120) + np.random.default_rng(0).normal(0, 10, (HEIGHT, WIDTH)).astype(np.float32)
    exact = image(grain)
    off = [np.abs(image(grain, jpeg=quality) - exact).mean() for quality in (95, 50)]
    assert 0.2 < off[0] < off[1] / 3


def test_each_row_is_seen_while_it_is_exposed():
    moments, weights = moments_s(scene_with(exposure_s=0.01, rolling_s=0.03), 0)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-6)
    # From the middle of the exposure of the first row to that of the last: 30 ms.
    seen_s = weights @ moments
    wanted = ((np.arange(HEIGHT) + 0.5) / HEIGHT - 0.5) * 0.03
    np.testing.assert_allclose(seen_s, wanted, atol=0.002)
    moments, weights = moments_s(scene_with(exposure_s=0.02), 0)
    np.testing.assert_allclose(weights @ moments, 0.0, atol=1e-9)
    assert 0.005 < np.sqrt((weights @ moments**2).mean()) < 0.02 / np.sqrt(12) + 1e-3
    np.testing.assert_allclose(moments_s(scene_with(lag_s=0.01), 1)[0], [0.01])
    np.testing.assert_allclose(moments_s(scene_with(lag_s=0.01), 0)[0], [0.0])


def depth_of(true_m, grey, **sensor):
    sensor = DepthSensor(**{'max_m': 9.0, 'noise_px': 1e-4, 'hole_share': 0.0, **sensor})
    return depth_reading_mm(scene_with(sensor), 320.0, true_m, grey, 0, 0.0)


def test_no_depth_of_what_is_dark_or_shiny():
    grey = flat(100)
    grey[:, :40], grey[:, 120:] = 10, 252
    told = depth_of(flat(2.0), grey, dark_grey=15, shiny_grey=250)
    assert not told[:, :40].any() and not told[:, 120:].any()
    assert (told[:, 40:120] == 2000).all()
    assert (depth_of(flat(2.0), grey) == 2000).all()


def test_pixels_at_edges_fly_between_both_sides():
    true_m = np.where(U < 80, 2.0, 4.0).astype(np.float32)
    told = depth_of(true_m, flat(100), flying_share=0.5)
    edge = told[:, 79:81]
    assert (edge > 0).mean() == pytest.approx(0.5, abs=0.1)
    between = edge[edge > 0]
    assert between.min() >= 2000 and between.max() <= 4000
    assert ((between > 2200) & (between < 3800)).mean() > 0.6
    assert not depth_of(true_m, flat(100))[:, 79:81].any()


TURN = {
    'description': 'a turn on the spot between brick walls',
    'walls': [
        {'points': [[-2, -2], [2, -2], [2, 2], [-2, 2]], 'closed': True, 'texture': 'bricks'}
    ],
    'camera': {'width': WIDTH, 'height': HEIGHT, 'rate_hz': 20, 'noise_sigma': 0.0},
    'sensors': {'depth': {'max_m': 9.0, 'noise_px': 1e-4, 'hole_share': 0.0}},
    'path': {'waypoints': [[0, 0], [0.6, 0], [0, 0]], 'turn_rate_deg_s': 40},
}
TURNING = 60
"""A frame in the middle of the turn."""


def rendered(frames, **camera):
    sensors = {'depth': {**TURN['sensors']['depth'], 'lag_s': camera.pop('depth_lag_s', 0.0)}}
    values = {**TURN, 'camera': {**TURN['camera'], **camera}, 'sensors': sensors}
    try:
        with Simulation(scene_from_mapping(values, 'test')) as simulation:
            turn = np.diff(simulation.drive.xy_yaw[TURNING - 1 : TURNING + 2, 2])
            assert (np.abs(np.degrees(turn)) > 1).all()
            return [simulation.frame(TURNING + index) for index in frames]
    except RenderingError as error:
        pytest.skip(str(error))


@pytest.mark.slow
def test_a_lag_delivers_what_the_others_see_a_frame_later_or_earlier():
    before, here, after = rendered((-1, 0, 1))
    (late,) = rendered((0,), lag_s=0.05, depth_lag_s=0.05)
    np.testing.assert_array_equal(late.left, here.left)
    np.testing.assert_array_equal(late.right, after.right)
    assert (late.right != here.right).mean() > 0.3
    alike = [(np.abs(late.depth_mm.astype(int) - one.depth_mm) <= 1).mean() for one in
             (before, here, after)]  # fmt: skip
    assert alike[0] > 0.9 > max(alike[1:]) + 0.1, alike


@pytest.mark.slow
def test_a_rolling_shutter_shows_the_top_earlier_than_the_bottom():
    before, _, after = (frame.left.astype(float) for frame in rendered((-1, 0, 1)))
    (rolled,) = rendered((0,), rolling_s=0.1)
    for rows, nearer, farther in (
        (slice(0, 8), before, after), (slice(-8, None), after, before)
    ):  # fmt: skip
        off = [np.abs(rolled.left[rows] - image[rows]).mean() for image in (nearer, farther)]
        assert off[0] < 0.3 * off[1]


@pytest.mark.parametrize('kind', sorted(shipped('cameras')))
def test_a_kind_of_camera_is_what_a_scene_does_not_say_itself(kind):
    plain, seen = open_scene('lane'), open_scene('lane', [f'camera.kind={kind}'])
    assert seen.camera.shot_noise > plain.camera.shot_noise == 0.0
    assert seen.camera.height_m == plain.camera.height_m
    said = open_scene('lane', [f'camera.kind={kind}', 'camera.shot_noise=1.0'])
    assert said.camera.shot_noise == 1.0
    assert said.camera.exposure_s == seen.camera.exposure_s > 0
    assert (seen.sensors.depth.max_m > 0) == (kind == 'kinect')


def test_an_unknown_kind_of_camera_is_refused():
    with pytest.raises(InputError, match='camera leica is none of kinect, oak, realsense'):
        open_scene('lane', ['camera.kind=leica'])
