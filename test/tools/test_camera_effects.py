"""The table of what each effect of a camera costs: which scenes it renders."""

import dataclasses

from segfloor_ros.apps.simulation.scene_file import open_scene
from tools.camera_effects import DRIVE, effects_of


def differing(group, kind, depth):
    """Return what each row changes against the first one in a part of the scene."""
    rows = {
        name: dataclasses.asdict(group(open_scene('corridor1', (*DRIVE, *assignments))))
        for name, assignments in effects_of(kind, depth).items()
    }
    ideal = rows['none']
    return {name: {key for key in row if row[key] != ideal[key]} for name, row in rows.items()}


def test_each_row_has_one_effect_and_the_last_all_of_them():
    changed = differing(lambda scene: scene.camera, 'webcam', False)
    assert changed.pop('none') == set()
    everything = changed.pop('all')
    assert len(changed) == 14
    # What swings does so in each row; alone it changes nothing.
    assert all(row == {name, 'drift_s'} for name, row in changed.items())
    assert everything == {*changed, 'drift_s'}


def test_the_depth_of_a_camera_has_rows_of_its_own():
    changed = differing(lambda scene: scene.sensors.depth, 'kinect', True)
    assert changed.pop('none') == set()
    assert all(row == {name} for name, row in changed.items() if name != 'all')
    assert (
        {'step_px', 'dark_grey', 'flying_share', 'lag_s'}
        <= changed['all']
        == set(changed) - {'all'}
    )
