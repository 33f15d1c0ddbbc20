"""The programs of the nodes: those that need readers of recordings or the simulator are apps."""

from __future__ import annotations

import importlib
from functools import partial

from segfloor_ros.core.starting import end_in_silence_on_signals, open_standard_streams

APPS = {
    'stereo_camera': 'segfloor_ros.apps.stereo_camera',
    'segfloor_pipeline': 'segfloor_ros.apps.segfloor_pipeline',
    'simulated_robot': 'segfloor_ros.apps.simulation.simulated_robot',
}


def program_of(node: str) -> str:
    """Return the module that runs a node."""
    return APPS.get(node, f'segfloor_ros.nodes.{node}')


def _run(node: str) -> None:
    """Run a node. An interrupt ends it with status 0, also while its modules are imported."""
    open_standard_streams()
    end_in_silence_on_signals(status=0)
    importlib.import_module(program_of(node)).main()


stereo_camera = partial(_run, 'stereo_camera')
stereo_slam = partial(_run, 'stereo_slam')
floor_segmentation = partial(_run, 'floor_segmentation')
cloud_labelling = partial(_run, 'cloud_labelling')
occupancy_grid = partial(_run, 'occupancy_grid')
segfloor_pipeline = partial(_run, 'segfloor_pipeline')
simulated_robot = partial(_run, 'simulated_robot')
segfloor_masks = partial(_run, 'segfloor_masks')
