"""The published scenes: rendered once, mapped, scored, shown beside the published figures."""

from __future__ import annotations

import json

import cv2
import pytest
from rich.console import Console

from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.simulation.scene_file import open_scene, shipped
from segfloor_ros.apps.simulation.world import RenderingError
from segfloor_ros.core.errors import SettingsError
from segfloor_ros.nodes.configuration import resolve
from tools.benchmark_published import as_document, published_table, run_scene
from tools.published_figures import PUBLISHED, parse_scenes

CONFIGURATION = resolve()


def test_an_unknown_scene_is_refused():
    with pytest.raises(SettingsError, match='did you mean corridor2'):
        parse_scenes('corridor1,coridor2')


def test_the_published_scenes_are_shipped():
    assert set(PUBLISHED) <= set(shipped())


@pytest.mark.slow
def test_a_scene_is_rendered_once_mapped_and_scored(tmp_path):
    steps = []

    def announce(description, total):
        steps.append((description, total))
        return lambda done: None

    def scene_result(*changes):
        steps.clear()
        small = ('camera.width=160', 'camera.height=120', *changes)
        scene = open_scene('corridor2', small)
        return run_scene('corridor2', scene, tmp_path, CONFIGURATION, 1, announce)

    way = 'path.waypoints=[[0, 0], [0.6, 0]]'
    try:
        first = scene_result(way)
    except RenderingError as error:
        pytest.skip(str(error))
    frames = first.workload.items
    assert steps == [('rendering corridor2', frames), ('mapping corridor2', frames)]
    assert first.workload.tracked == frames
    assert first.score.nodes == 20
    assert first.cell_m == load_map(tmp_path / 'map.yaml').resolution_m == 0.01
    assert load_map(tmp_path / 'recording' / 'map.yaml').resolution_m == 0.01
    assert first.score.observable_only
    assert first.score.raw.precision.mean > 0.8
    assert load_map(tmp_path / 'map.yaml').cells.size == first.workload.cells
    assert cv2.imread(str(tmp_path / 'overlay.png')) is not None

    second = scene_result(way)
    assert steps == [('mapping corridor2', frames)]
    assert second.score == first.score

    other = scene_result('path.waypoints=[[0, 0], [0.5, 0]]')
    assert [description for description, _ in steps] == ['rendering corridor2', 'mapping corridor2']
    assert other.workload.items < frames

    console = Console(record=True, width=80)
    console.print(published_table([first]))
    text = console.export_text()
    assert '…' not in text
    row = next(line for line in text.split('\n') if 'Segfloor *' in line)
    assert [cell.strip() for cell in row.split('│')[2:6]] == ['99.64', '97.23', '0.190', '0.073']
    row = next(line for line in text.split('\n') if 'here, raw' in line)
    assert float(row.split('│')[2]) == round(100 * first.score.raw.precision.mean, 2)
    document = json.loads(json.dumps(as_document([first])))
    assert document['scenes'][0]['score']['nodes'] == 20
    assert document['scenes'][0]['published']['figures'][0]['method'] == 'Segfloor'
