"""From true labels to a map: a network is fitted to a simulated drive, and sees another one."""

import numpy as np
import pytest
from command_line import segfloor_process
from small_network import FittedNetwork

from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.simulation import RecordingOptions, Simulation, record
from segfloor_ros.apps.simulation.solids import CLASSES
from segfloor_ros.apps.simulation.world import RenderingError
from segfloor_ros.core.grid.occupancy import OCCUPIED
from segfloor_ros.nodes.network_files import open_network

CAMERA = ['camera.width=320', 'camera.height=240']
STANDS_AT = (-0.4, -2.2)
PERSON, FLOOR = CLASSES.index('person'), CLASSES.index('floor')


def simulated(waypoints, people, seed):
    """A drive through the hall. people: where they stand, or walk from and to."""
    described = [{'points': points, 'start_s': start, 'texture': cloth}
                 for points, start, cloth in people]  # fmt: skip
    values = [*CAMERA, f'seed={seed}', f'path.waypoints={waypoints}', f'people={described}']
    try:
        return Simulation(open_scene('hall', values), labels=True)
    except RenderingError as error:
        pytest.skip(str(error))


@pytest.fixture(scope='module')
def network(tmp_path_factory):
    people = [
        ([[3.0, -2.2], [-3.2, -2.2]], 0.0, 'cloth'),
        ([[1.0, -1.2], [1.0, -2.6]], 0.5, 'cloth:3'),
    ]
    folder = tmp_path_factory.mktemp('network')
    with simulated([[-2.7, -1.9], [2.4, -1.6]], people, 20) as drive:
        chosen = range(0, drive.frame_count, 4)
        images = [drive.frame(index).left for index in chosen]
        labels = [drive.labels(index).labels for index in chosen]
    fitted = FittedNetwork(320, 240, CLASSES, moves=['person', 'car'], floor=['floor'])
    fitted.fit(images, labels, folder)
    return fitted.write(folder / 'small.onnx')


@pytest.mark.slow
def test_who_stands_beside_the_way_in_a_part_of_the_drive_is_not_in_the_map(network, tmp_path):
    people = [([list(STANDS_AT), [2.6, -2.4]], 60.0, 'cloth:3')]
    with simulated([[-2.6, -1.8], [-2.1, -1.8], [-2.2, 0.2]], people, 20) as drive:
        record(drive, tmp_path / 'drive', RecordingOptions(floor_every=0))
        truth, image = drive.labels(0).labels, drive.frame(0).left
    seen = open_network(network).infer(image).labels
    for number, least in ((FLOOR, 0.85), (PERSON, 0.5)):
        both = np.count_nonzero((seen == number) & (truth == number))
        assert both > least * np.count_nonzero(truth == number)
    ghosts = {}
    for name, words in (('with', ('--network', network)), ('without', ())):
        out = tmp_path / name
        done = segfloor_process('run', tmp_path / 'drive', '--out', out, *words)
        assert done.returncode == 0, done.stderr
        grid = load_map(out / 'map.yaml')
        row, column = np.nonzero(grid.cells == OCCUPIED)
        # The map begins where the drive does, and so do the world's axes.
        x = (column + 0.5) * grid.resolution_m + grid.origin_xy_m[0] - 2.6
        y = (row + 0.5) * grid.resolution_m + grid.origin_xy_m[1] - 1.8
        ghosts[name] = np.count_nonzero(np.hypot(x - STANDS_AT[0], y - STANDS_AT[1]) < 0.3)
    assert ghosts['without'] > 3 and ghosts['with'] <= ghosts['without'] // 3
