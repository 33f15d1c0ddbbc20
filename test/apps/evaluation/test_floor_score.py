"""Floor scores of masks that fit into a line."""

import cv2
import numpy as np
import pytest

from segfloor_ros.apps.evaluation.floor import draw_outline, score_floor_folders
from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE, NOT_FLOOR
from segfloor_ros.core.errors import InputError

SQUARE = [10, 10, 50, 10, 50, 40, 10, 40]


def write(folder, name, rows):
    folder.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / name), np.array(rows, np.uint8))


def test_shares_of_a_hand_made_mask(tmp_path):
    write(tmp_path / 'truth', '000004.png', [[255, 255, 255, 0, 0, 127]])
    write(tmp_path / 'estimate', '000004.png', [[255, 255, 127, 255, 0, 255]])
    score = score_floor_folders(tmp_path / 'estimate', tmp_path / 'truth')
    assert score.precision == pytest.approx(2 / 3)
    assert score.recall == pytest.approx(2 / 3)
    assert score.iou == pytest.approx(2 / 4)
    assert score.false_floor_share == pytest.approx(1 / 2)
    assert score.coverage == pytest.approx(4 / 5)
    assert (score.masks, score.missing) == (1, 0)


def test_masks_are_paired_by_name_and_missing_ones_counted(tmp_path):
    for name in ('000000.png', '000010.png'):
        write(tmp_path / 'scene' / 'floor', name, [[255, 0]])
    write(tmp_path / 'run' / 'floor_masks', '000010.png', [[255, 0]])
    write(tmp_path / 'run' / 'floor_masks', '000011.png', [[0, 255]])
    score = score_floor_folders(tmp_path / 'run', tmp_path / 'scene')
    assert (score.masks, score.missing) == (1, 1)
    assert score.precision == score.recall == score.iou == score.coverage == 1.0


def test_nothing_called_floor(tmp_path):
    write(tmp_path / 'truth', '0.png', [[255, 0]])
    write(tmp_path / 'estimate', '0.png', [[127, 127]])
    score = score_floor_folders(tmp_path / 'estimate', tmp_path / 'truth')
    assert score.precision == score.recall == score.coverage == 0.0


def test_bad_folders_are_refused(tmp_path):
    write(tmp_path / 'a', '000000.png', [[255, 0]])
    write(tmp_path / 'b', '000001.png', [[255, 0]])
    write(tmp_path / 'c', '000000.png', [[255, 0, 0]])
    with pytest.raises(InputError, match='same name'):
        score_floor_folders(tmp_path / 'a', tmp_path / 'b')
    with pytest.raises(InputError, match='2x1'):
        score_floor_folders(tmp_path / 'a', tmp_path / 'c')
    with pytest.raises(InputError, match='no floor masks'):
        score_floor_folders(tmp_path / 'missing', tmp_path / 'a')
    (tmp_path / 'a' / '000000.png').write_bytes(b'not a picture')
    with pytest.raises(InputError, match='cannot be decoded'):
        score_floor_folders(tmp_path / 'a', tmp_path / 'c')


def test_outlines_become_masks_with_unsure_borders():
    mask = draw_outline({'floor': [SQUARE], 'unsure': [[0, 50, 9, 50]]}, (60, 80))
    u, v = [30, 70, 30, 30, 5], [25, 25, 8, 11, 50]
    assert mask[v, u].tolist() == [FLOOR, NOT_FLOOR, NO_EVIDENCE, NO_EVIDENCE, NO_EVIDENCE]


def test_where_obstacles_are_drawn_the_rest_does_not_count(tmp_path):
    (tmp_path / 'o.yaml').write_text(f"""frames:
      7:
        floor: [{SQUARE}]
        obstacle: [[20, 20, 30, 20, 30, 30, 20, 30]]
    """)
    write(tmp_path / 'run', '000007.png', np.full((60, 80), FLOOR))
    score = score_floor_folders(tmp_path / 'run', tmp_path / 'o.yaml')
    # Borders: two pixels of the floor's 41 x 31, one of the obstacle's 11 x 11 and one around it.
    obstacle, floor = 9 * 9, 37 * 27 - 13 * 13
    assert score.pixels == obstacle + floor
    assert score.recall == score.false_floor_share == 1.0
    assert score.precision == pytest.approx(floor / (obstacle + floor))
    (tmp_path / 'o.yaml').write_text('frames: 3')
    with pytest.raises(InputError, match='no outlines'):
        score_floor_folders(tmp_path / 'run', tmp_path / 'o.yaml')
