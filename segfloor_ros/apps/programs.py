"""The programs of the nodes: those that need readers of recordings or the simulator are apps."""

from __future__ import annotations

APPS = {
    'stereo_camera': 'segfloor_ros.apps.stereo_camera',
    'segfloor_pipeline': 'segfloor_ros.apps.segfloor_pipeline',
    'simulated_robot': 'segfloor_ros.apps.simulation.simulated_robot',
}


def program_of(node: str) -> str:
    """Return the module that runs a node."""
    return APPS.get(node, f'segfloor_ros.nodes.{node}')
