"""Makes the vocabulary of place recognition from recordings: python tools/train_vocabulary.py
RECORDING... The shipped one is made of rendered drives alone: `segfloor simulate` of the scenes
corridor1, complex_room, people and of a floor plan.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.apps.recordings import open_source
from segfloor_ros.core.slam.places import place_recognition as vocabulary
from segfloor_ros.core.slam.places.place_recognition import BRANCHES, LEVELS
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.tracking.images import FeatureExtractor
from segfloor_ros.nodes.configuration import resolve

FRAMES_PER_RECORDING = 80
STEPS = 12


def views(recording: str) -> list[NDArray[np.uint8]]:
    """Return the descriptors (N, 32) of each of the frames spread over a recording."""
    source = open_source(resolve(None, (), stereo_camera={'input': recording}).stereo_camera)
    every = max(1, (source.frame_count or 0) // FRAMES_PER_RECORDING)
    extractor = FeatureExtractor(StereoSlamSettings())
    return [
        extractor.extract(frame.left).descriptor
        for frame in source.frames()
        if frame.index % every == 0
    ]


def cluster(descriptor: NDArray[np.uint8], seed: int) -> tuple[NDArray[np.uint8], NDArray[np.intp]]:
    """Return `BRANCHES` binary centres (B, 32) and the one (N,) of each descriptor (N, 32): the
    bits that most of a cluster have.
    """
    if len(descriptor) <= BRANCHES:
        rows = np.arange(BRANCHES) % max(len(descriptor), 1)
        few = descriptor if len(descriptor) else np.zeros((1, 32), np.uint8)
        return few[rows], np.arange(len(descriptor))
    bits = np.unpackbits(descriptor, axis=1).astype(np.float32)
    cv2.setRNGSeed(seed)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, STEPS, 0.01)
    _, label, centre = cv2.kmeans(bits, BRANCHES, None, criteria, 1, cv2.KMEANS_PP_CENTERS)
    return np.packbits(centre > 0.5, axis=1), label.ravel().astype(np.intp)


def train(descriptor: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the nodes (N, 32) of the tree, level by level."""
    levels, groups = [], [descriptor]
    for _ in range(LEVELS):
        centres, children = [], []
        for seed, group in enumerate(groups):
            centre, label = cluster(group, seed)
            centres.append(centre)
            children += [group[label == branch] for branch in range(BRANCHES)]
        levels.append(np.concatenate(centres))
        groups = children
    return np.concatenate(levels)


def main() -> None:
    """Train on the recordings named and write the vocabulary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('recordings', nargs='+')
    default = Path(vocabulary.__file__).with_name(vocabulary.FILE)
    parser.add_argument('--out', type=Path, default=default)
    arguments = parser.parse_args()
    descriptor = np.concatenate([d for one in arguments.recordings for d in views(one)])
    np.save(arguments.out, train(descriptor), allow_pickle=False)
    print(f'{len(descriptor)} descriptors, {arguments.out.stat().st_size} bytes')


if __name__ == '__main__':
    main()
