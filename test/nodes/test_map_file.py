from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from segfloor_ros.apps.map_files import load_map
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from segfloor_ros.nodes.map_files import save_map

# Three rows, four columns, no symmetry: a transposed, flipped or turned copy differs.
CELLS = np.array([[0, 100, 0, -1], [100, 0, 0, 0], [-1, -1, 100, 0]], np.int8)
GRID = OccupancyGrid(CELLS, 0.05, (-1.25, 0.4))


def write_map(folder: Path, pixels: np.ndarray, **changes: object) -> Path:
    cv2.imwrite(str(folder / 'm.pgm'), pixels)
    description = {'image': 'm.pgm', 'resolution': 0.1, 'origin': [0.0, 0.0, 0.0], **changes}
    path = folder / 'm.yaml'
    path.write_text(yaml.safe_dump({k: v for k, v in description.items() if v is not None}))
    return path


def test_round_trip(tmp_path: Path) -> None:
    save_map(GRID, tmp_path / 'map.yaml')
    loaded = load_map(tmp_path / 'map.yaml')
    np.testing.assert_array_equal(loaded.cells, CELLS)
    assert loaded.cells.dtype == np.int8
    assert loaded.resolution_m == 0.05
    assert loaded.origin_xy_m == (-1.25, 0.4)


def test_files_are_those_of_map_server(tmp_path: Path) -> None:
    save_map(GRID, tmp_path / 'map.yaml')
    # The last row of the grid (largest y) is the top row of the image.
    expected = b'P5\n4 3\n255\n' + bytes([205, 205, 0, 254, 0, 254, 254, 254, 254, 0, 254, 205])
    assert (tmp_path / 'map.pgm').read_bytes() == expected
    assert yaml.safe_load((tmp_path / 'map.yaml').read_text()) == {
        'image': 'map.pgm',
        'mode': 'trinary',
        'resolution': 0.05,
        'origin': [-1.25, 0.4, 0.0],
        'negate': 0,
        'occupied_thresh': 0.65,
        'free_thresh': 0.196,
    }
    assert sorted(p.name for p in tmp_path.iterdir()) == ['map.pgm', 'map.yaml']


def test_trinary_sorts_probabilities_by_the_thresholds(tmp_path: Path) -> None:
    grid = OccupancyGrid(np.array([[0, 19, 20, 65, 66, 100, -1]], np.int8), 0.1, (0.0, 0.0))
    save_map(grid, tmp_path / 'map.yaml')
    loaded = load_map(tmp_path / 'map.yaml').cells
    np.testing.assert_array_equal(loaded, [[0, 0, -1, -1, 100, 100, -1]])


def test_raw_keeps_every_value(tmp_path: Path) -> None:
    values = np.array([[0, 1, 42], [99, 100, -1]], np.int8)
    pixels = np.where(values < 0, 255, values)[::-1].astype(np.uint8)
    path = write_map(tmp_path, pixels, mode='raw')
    np.testing.assert_array_equal(load_map(path).cells, values)


def test_scale_is_linear_between_the_thresholds(tmp_path: Path) -> None:
    # Occupancy 1 - 204/255 = 0.2 and 1 - 102/255 = 0.6 with thresholds 0.1 and 0.9.
    pixels = np.array([[255, 204, 102, 0]], np.uint8)
    path = write_map(tmp_path, pixels, mode='scale', free_thresh=0.1, occupied_thresh=0.9)
    np.testing.assert_array_equal(load_map(path).cells, [[0, 12, 62, 100]])


def test_negate_turns_black_into_free(tmp_path: Path) -> None:
    path = write_map(tmp_path, np.array([[254, 0, 128]], np.uint8), negate=1)
    np.testing.assert_array_equal(load_map(path).cells, [[100, 0, -1]])


def test_colour_images_are_averaged_and_transparency_is_unknown_in_scale(tmp_path: Path) -> None:
    pixels = np.zeros((1, 3, 4), np.uint8)
    pixels[0, :, 3] = [255, 255, 0]
    pixels[0, 1, :3] = 255
    cv2.imwrite(str(tmp_path / 'm.png'), pixels)
    path = write_map(tmp_path, np.zeros((1, 1), np.uint8), image='m.png', mode='scale')
    np.testing.assert_array_equal(load_map(path).cells, [[100, 0, -1]])


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'resolution': None}, 'resolution is missing'),
        ({'resolution': -0.1}, 'resolution -0.1 m'),
        ({'resolution': 'wide'}, 'not a number'),
        ({'origin': [1.0, 2.0]}, 'three numbers'),
        ({'origin': 3}, 'not a number'),
        ({'origin': [0.0, 0.0, 0.5]}, 'turned by 0.5 rad'),
        ({'mode': 'colour'}, "mode 'colour'"),
        ({'free_thresh': 0.7}, 'free_thresh < occupied_thresh'),
        ({'image': 'other.pgm'}, 'other.pgm'),
    ],
)
def test_malformed_maps_are_refused_by_name(
    tmp_path: Path, changes: dict[str, object], words: str
) -> None:
    path = write_map(tmp_path, np.zeros((2, 2), np.uint8), **changes)
    with pytest.raises(InputError, match=words) as error:
        load_map(path)
    assert str(tmp_path) in str(error.value)


@pytest.mark.parametrize('text', ['- a\n- b\n', 'image: [', ''])
def test_a_file_that_is_no_map_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / 'm.yaml'
    path.write_text(text)
    with pytest.raises(InputError, match=r'm\.yaml'):
        load_map(path)


def test_a_missing_file_and_a_broken_image_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'gone\.yaml: cannot be read'):
        load_map(tmp_path / 'gone.yaml')
    path = write_map(tmp_path, np.zeros((2, 2), np.uint8))
    (tmp_path / 'm.pgm').write_bytes(b'P5\n100')
    with pytest.raises(InputError, match=r'm\.pgm'):
        load_map(path)


def test_saving_where_one_cannot_write_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('mine')
    with pytest.raises(InputError, match='cannot be written'):
        save_map(GRID, tmp_path / 'file' / 'map.yaml')
    assert list(tmp_path.iterdir()) == [tmp_path / 'file']


def test_an_image_that_was_changed_by_hand_is_not_replaced(tmp_path: Path) -> None:
    save_map(GRID, tmp_path / 'map.yaml')
    save_map(GRID, tmp_path / 'map.yaml')
    image = tmp_path / 'map.pgm'
    image.write_bytes(image.read_bytes()[:-1] + b'\x00')
    before = image.read_bytes()
    with pytest.raises(InputError, match='is no image of a map that segfloor wrote'):
        save_map(GRID, tmp_path / 'map.yaml')
    assert image.read_bytes() == before


def test_a_grid_knows_where_its_cells_lie_whatever_its_origin_and_shape() -> None:
    cells = np.array([[FREE, FREE, OCCUPIED], [UNKNOWN, FREE, FREE]], np.int8)
    grid = OccupancyGrid(cells, 0.1, (-3.0, 2.0))
    at = grid.cells_of(np.array([[-2.75, 2.05], [-2.95, 2.15], [-3.01, 2.05], [-2.95, 2.21]]))
    assert at.tolist() == [[0, 2], [1, 0], [0, -1], [2, 0]]
    assert grid.holds(at).tolist() == [True, True, False, False]
    assert cells[tuple(at[:2].T)].tolist() == [OCCUPIED, UNKNOWN]
    assert grid.centres_of(at[:2]) == pytest.approx(np.array([[-2.75, 2.05], [-2.95, 2.15]]))
    np.testing.assert_array_equal(grid.cells_of(grid.centres_of(grid.all_cells)), grid.all_cells)
    assert cells[tuple(grid.all_cells.T)].tolist() == cells.ravel().tolist()
    assert grid.extent_m == pytest.approx((-3.0, -2.7, 2.0, 2.2))
    assert grid.area_m2(cells == FREE) == pytest.approx(0.04)
    assert grid.away_m(cells == OCCUPIED)[1, 0] == pytest.approx(0.1 * np.hypot(1, 2))
    assert grid.picture.tolist() == [[205, 254, 254], [254, 254, 0]]
