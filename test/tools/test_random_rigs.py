"""The rigs that are drawn at random: the same ones each time, and scenes that can be rendered."""

import pytest
import yaml

from segfloor_ros.apps.simulation.scene_file import open_scene
from tools.random_rigs import KINDS, PLACES, make_rig

SEEDS = range(1, 41)


@pytest.fixture(scope='module')
def rigs():
    return [make_rig(seed) for seed in SEEDS]


def test_a_seed_always_draws_the_same_rig(rigs):
    assert make_rig(7) == rigs[6]
    assert len({rig.name for rig in rigs}) == len(rigs)


def test_forty_rigs_have_all_places_and_cameras_with_depth_and_without(rigs):
    words = [rig.name.split() for rig in rigs]
    assert {word[1] for word in words} == set(PLACES)
    assert {word[2] for word in words} == {kind or 'ideal' for kind in KINDS}
    assert {rig.depth for rig in rigs} == {True, False}


@pytest.mark.parametrize('index', range(0, len(SEEDS), 8))
def test_scenes_are_as_the_name_says(rigs, index, tmp_path):
    rig, file = rigs[index], tmp_path / 'scene.yaml'
    file.write_text(yaml.safe_dump(rig.scene))
    scene = open_scene(str(file))
    assert f'{scene.camera.width}x{scene.camera.height}' in rig.name
    assert f'{scene.camera.height_m:.2f} m {scene.camera.pitch_deg:.1f}°' in rig.name
    assert bool(scene.sensors.depth.max_m) == rig.depth
