"""The notebook from a bag to a map: its cells run in order, as Jupyter runs them."""

import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pytest

from segfloor_ros.apps.map_files import load_map
from segfloor_ros.core.grid.occupancy import FREE

NOTEBOOK = Path(__file__).resolve().parents[1] / 'docs' / 'bag_to_map.ipynb'


def cells(kind: str) -> list[dict[str, Any]]:
    found = json.loads(NOTEBOOK.read_text())['cells']
    return [cell for cell in found if cell['cell_type'] == kind]


def test_the_notebook_holds_no_results_of_an_earlier_run() -> None:
    assert all(not cell['outputs'] and cell['execution_count'] is None for cell in cells('code'))


def test_a_map_without_a_height_of_the_camera_is_told(tmp_path, capsys) -> None:
    (cell,) = (c for c in cells('code') if 'camera_height_m' in ''.join(c['source']))
    for height_m in (None, 0.4):
        values = {'tracked_frames': 1, 'frames': 1, 'keyframes': 1, 'camera_height_m': height_m}
        (tmp_path / 'summary.json').write_text(json.dumps(values))
        exec(''.join(cell['source']), {'json': json, 'OUT': tmp_path})
    assert capsys.readouterr().out.splitlines()[1::2] == [
        'camera height unknown', 'camera 0.400 m above the floor',
    ]  # fmt: skip


@pytest.mark.slow
def test_the_cells_run_and_show_the_map_that_is_written(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    drawn: list[Any] = []
    monkeypatch.setattr(plt, 'show', lambda: drawn.append(plt.gcf()))
    plt.switch_backend('agg')
    names: dict[str, Any] = {}
    for cell in cells('code'):
        exec(''.join(cell['source']), names)
    assert '100 % of' in capsys.readouterr().out
    grid = load_map(tmp_path / 'bag_to_map' / 'map.yaml')
    assert names['free_m2'] == pytest.approx((grid.cells == FREE).sum() * grid.resolution_m**2)
    (line,) = drawn[0].axes[0].lines
    on_path = grid.cells[tuple(grid.cells_of(line.get_xydata()).T)]
    assert (on_path == FREE).mean() > 0.95, 'the path is drawn where the robot drove'
    assert len(drawn[1].axes) == 3
    plt.close('all')
