"""The index of places: which keyframes hold the words of a view (Nister and Stewenius, Scalable
Recognition with a Vocabulary Tree, CVPR 2006: inverted files and tf-idf).
"""

from __future__ import annotations

from array import array

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array
from segfloor_ros.slam.vocabulary import NUM_WORDS


class PlaceIndex:
    """Keyframes by the words they hold. The budget of features is the same for every view, so a
    word counts once per view, and what weighs it is how rare it is in the map.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all keyframes."""
        self._keyframes = [array('i') for _ in range(NUM_WORDS)]
        self._words: dict[int, NDArray[np.int32]] = {}

    def __len__(self) -> int:
        return len(self._words)

    def add(self, keyframe: int, words: NDArray[np.int32]) -> None:
        """Take in a keyframe, by index, with the words (N,) of its features."""
        own = np.unique(words)
        self._words[keyframe] = own
        for word in own.tolist():
            self._keyframes[word].append(keyframe)

    def words_of(self, keyframe: int) -> NDArray[np.int32]:
        """Return the words (N,) of a keyframe, ascending."""
        return self._words.get(keyframe, np.zeros(0, np.int32))

    def remove(self, keyframe: int) -> None:
        """Forget a keyframe."""
        for word in self._words.pop(keyframe, np.zeros(0, np.int32)).tolist():
            self._keyframes[word].remove(keyframe)

    def score(self, words: NDArray[np.int32], count: int) -> Array:
        """Return how much of a view with words (N,) each keyframe (count,) holds, in [0, 1]: words
        weigh as much as they tell, log(keyframes / keyframes that hold the word).
        """
        own = [self._keyframes[word] for word in np.unique(words).tolist()]
        holders = np.array([len(keyframes) for keyframes in own], np.intp)
        weight = np.log((len(self) + 1.0) / (holders + 1.0)) + 1e-9
        found = [np.frombuffer(keyframes, np.int32) for keyframes in own if keyframes]
        if not found:
            return np.zeros(count)
        held = np.bincount(np.concatenate(found), np.repeat(weight, holders), minlength=count)
        return held[:count] / weight.sum()
