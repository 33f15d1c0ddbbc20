"""Visual words: a tree of binary descriptors, found by hierarchical clustering (Galvez-Lopez and
Tardos, Bags of Binary Words for Fast Place Recognition, IEEE T-RO 2012, section III).

The shipped tree was made by `tools/train_vocabulary.py` from rendered drives alone.
"""

from __future__ import annotations

from importlib import resources

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.slam.tracking.features import hamming

FILE = 'vocabulary.npy'
BRANCHES = 30
LEVELS = 3
NUM_WORDS = BRANCHES**LEVELS


class Vocabulary:
    """A tree with `BRANCHES` children at each node. nodes: (N, 32) uint8, level by level; the
    children of node i of a level are the nodes i * BRANCHES, ... of the next.
    """

    def __init__(self, nodes: NDArray[np.uint8]) -> None:
        ends = np.cumsum([BRANCHES**level for level in range(1, LEVELS + 1)])
        if nodes.shape != (ends[-1], 32):
            raise ValueError(f'a vocabulary has {ends[-1]} nodes of 32 bytes, not {nodes.shape}')
        self._levels = [
            level.reshape(-1, BRANCHES, 32) for level in np.split(nodes, ends[:-1].tolist())
        ]

    @staticmethod
    def load() -> Vocabulary:
        """Read the shipped vocabulary."""
        with (resources.files('segfloor_ros.slam.places') / FILE).open('rb') as file:
            return Vocabulary(np.load(file, allow_pickle=False))

    def words(self, descriptor: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Return the word (N,) of each descriptor (N, 32), in [0, NUM_WORDS)."""
        node = np.zeros(len(descriptor), np.intp)
        for children in self._levels:
            distance = hamming(descriptor[:, None], children[node])
            node = node * BRANCHES + distance.argmin(axis=1)
        return node.astype(np.int32)
