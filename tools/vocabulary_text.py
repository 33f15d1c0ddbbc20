"""Writes the vocabulary of place recognition as text for ORB-SLAM2 and ORB-SLAM3 (DBoW2):
`python -m tools.vocabulary_text OUT.txt RECORDING...`. A word weighs the more, the fewer frames of
the recordings have it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.geometry import Array
from segfloor_ros.core.slam.places import place_recognition as vocabulary
from segfloor_ros.core.slam.places.place_recognition import BRANCHES, LEVELS, NUM_WORDS, Vocabulary
from tools.train_vocabulary import views

HEAD = '10 5 0 0'
"""Branches, levels, L1 norm, tf-idf. The programs refuse more than 20 branches and only reserve
memory by the first two, which must suffice for all nodes. They match features within nodes four
levels above the last: here within the first."""


def weights(vocabulary: Vocabulary, descriptors: Sequence[NDArray[np.uint8]]) -> Array:
    """Return the weight (NUM_WORDS,) of each word: log(frames / frames that have it), both plus
    one. descriptors: (N, 32) of each frame.
    """
    count = np.zeros(NUM_WORDS)
    for descriptor in descriptors:
        count[np.unique(vocabulary.words(descriptor))] += 1
    return np.asarray(np.log((len(descriptors) + 1) / (count + 1)))


def text(nodes: NDArray[np.uint8], weight: Array) -> str:
    """Return a line for each node (N, 32), level by level: its parent, whether it is a word, its
    bytes and its weight. No newline ends it: the programs would make a node of an empty line.
    """
    lines, parent_of_level, first = [HEAD], [0], 0
    for level in range(1, LEVELS + 1):
        is_word, size = level == LEVELS, BRANCHES**level
        for i, node in enumerate(nodes[first : first + size]):
            last = weight[i] if is_word else 0
            parent = parent_of_level[i // BRANCHES]
            lines.append(f'{parent} {int(is_word)} {" ".join(map(str, node))} {last:.6f}')
        parent_of_level = list(range(first + 1, first + size + 1))
        first += size
    return '\n'.join(lines)


def main() -> None:
    """Write the shipped vocabulary with weights from the recordings named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('out', type=Path)
    parser.add_argument('recordings', nargs='+')
    arguments = parser.parse_args()
    file = resources.files('segfloor_ros.core.slam.places') / vocabulary.FILE
    with file.open('rb') as stream:
        nodes = np.load(stream, allow_pickle=False)
    found = [view for recording in arguments.recordings for view in views(recording)]
    arguments.out.write_text(text(nodes, weights(Vocabulary(nodes), found)))
    print(f'{len(found)} frames, {arguments.out.stat().st_size} bytes')


if __name__ == '__main__':
    main()
