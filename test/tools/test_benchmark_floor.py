"""`tools.benchmark_floor`: shares of the steps; disparities scored by hand."""

import cv2
import numpy as np
import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from segfloor_ros.core.errors import InputError, MapError
from segfloor_ros.core.floor.segmentation import DISPARITY, DISPARITY_ABOVE
from segfloor_ros.core.floor.settings import FloorSegmentationSettings
from segfloor_ros.nodes.configuration import resolve
from tools.benchmark_floor import benchmark_floor, disparity_table, steps_table
from tools.disparity_choices import TruePair, choices, read_pairs, score, visible
from tools.floor_steps import WHOLE, WITHOUT_DISPARITY, generated_keyframes, time_steps

SHIFT_PX = 16

app = typer.Typer()
app.command()(benchmark_floor)


def shifted_pair(name: str = 'shifted') -> TruePair:
    """A picture and itself, shifted."""
    rng = np.random.default_rng(2)
    wide = cv2.GaussianBlur(rng.normal(size=(60, 300)), (0, 0), 1.2)
    wide = np.clip(128 + 40 * wide / wide.std(), 0, 255).astype(np.uint8)
    true = np.full((60, 280), SHIFT_PX, np.float32)
    left, right = wide[:, :280], wide[:, SHIFT_PX : SHIFT_PX + 280]
    return TruePair(name, left, right, true, visible(true, true))


def test_shares_of_the_steps_add_up():
    camera, keyframes = generated_keyframes(5, seed=0)
    times = time_steps('generated', camera, keyframes, resolve(), threads=1)
    assert times.keyframes == 3
    shares = {name: step['share'] for name, step in times.steps.items()}
    assert shares[WHOLE] == 1.0
    matching = shares[DISPARITY] + shares[DISPARITY_ABOVE]
    assert matching + shares[WITHOUT_DISPARITY] == pytest.approx(1.0)
    steps = [share for name, share in shares.items() if name not in (WHOLE, WITHOUT_DISPARITY)]
    assert 0.9 < sum(steps) <= 1.0
    console = Console(record=True, width=80)
    console.print(steps_table(times))
    assert 'disparity above the horizon' in console.export_text()


def test_too_few_keyframes_are_refused():
    camera, keyframes = generated_keyframes(2, seed=0)
    with pytest.raises(MapError, match='2 keyframes'):
        time_steps('short', camera, keyframes, resolve(), threads=1)


def test_pixels_that_the_right_camera_does_not_see():
    # Something near (2 px) hides two columns of what is far (1 px) from the right camera.
    left = np.array([[1, 1, 1, 1, 2, 2, 1, 0]], np.float32)
    right = np.array([[1, 1, 2, 2, 0, 1, 1, 1]], np.float32)
    assert visible(left, right).tolist() == [[False, True, True, True, True, True, True, False]]
    right[0, 2:4] = 3.5  # too far from 1 and from 2
    assert visible(left, right)[0, 3:6].tolist() == [False, False, False]


def test_score_by_hand():
    pair = shifted_pair()
    found = pair.disparity_px.copy()
    counted = np.flatnonzero(pair.counted)
    some = len(counted) // 10
    found.reshape(-1)[counted[:some]] = 0  # a tenth has no match
    found.reshape(-1)[counted[some : 2 * some]] += 1.5  # another tenth is off
    found.reshape(-1)[counted[2 * some : 3 * some]] += 4
    result = score('by hand', lambda left, right: found, pair)
    assert result.bad_half == pytest.approx(0.3, abs=0.001)
    assert result.bad_1 == pytest.approx(0.3, abs=0.001)
    assert result.bad_2 == pytest.approx(0.2, abs=0.001)
    assert result.matched == pytest.approx(0.9, abs=0.001)
    assert result.wrong_2 == pytest.approx(1 / 9, abs=0.001)


def test_every_choice_finds_a_shift_and_the_border_is_missed_without_recovery():
    pair = shifted_pair()
    found = choices(FloorSegmentationSettings())
    scores = {name: score(name, match, pair) for name, match in found.items()}
    left_out = scores.pop('left border left out')
    assert left_out.matched == pytest.approx((280 - 64) / (280 - SHIFT_PX), abs=0.03)
    for result in scores.values():
        assert result.bad_1 < 0.08, result.choice
    console = Console(record=True, width=100)
    console.print(disparity_table([left_out, *scores.values()]))
    assert '…' not in console.export_text()


def test_pairs_are_read_from_files(tmp_path):
    with pytest.raises(InputError, match=r'disp2\.png'):
        read_pairs(tmp_path)
    pair, folder = shifted_pair(), tmp_path / 'shifted'
    folder.mkdir()
    true = (4 * pair.disparity_px).astype(np.uint8)
    images = {'im2': pair.left, 'im6': pair.right, 'disp2': true, 'disp6': true}
    for name, image in images.items():
        cv2.imwrite(str(folder / f'{name}.png'), image)
    (read,) = read_pairs(tmp_path)
    assert read.name == 'shifted'
    assert np.array_equal(read.disparity_px, pair.disparity_px)
    assert np.array_equal(read.counted, pair.counted)
    (folder / 'im6.png').unlink()
    result = CliRunner().invoke(app, ['--middlebury', str(tmp_path)])
    assert isinstance(result.exception, InputError)
    assert 'im6.png' in str(result.exception)


def test_middlebury(shared_data):
    usual = choices(FloorSegmentationSettings())['three paths (in use)']
    for pair in read_pairs(shared_data / 'middlebury'):
        assert score('in use', usual, pair).bad_2 < 0.08, pair.name
