"""Visual words and the index of places."""

import time

import numpy as np
import pytest

from segfloor_ros.core.slam.places.place_recognition import (
    BRANCHES,
    NUM_WORDS,
    PlaceIndex,
    Vocabulary,
)

RNG = np.random.default_rng(3)


@pytest.fixture(scope='module')
def vocabulary():
    return Vocabulary.load()


def descriptors(count):
    return RNG.integers(0, 256, (count, 32), dtype=np.uint8)


def flipped(descriptor, bits):
    """The same descriptors (N, 32) with some bits of each changed."""
    planes = np.unpackbits(descriptor, axis=1)
    for row in planes:
        row[RNG.choice(256, bits, replace=False)] ^= 1
    return np.packbits(planes, axis=1)


def test_a_word_is_the_nearest_branch_level_by_level():
    nodes = descriptors(BRANCHES + BRANCHES**2 + BRANCHES**3)
    words = Vocabulary(nodes).words(nodes[BRANCHES + BRANCHES**2 :][::997])
    assert ((words >= 0) & (words < NUM_WORDS)).all()
    first = nodes[:BRANCHES]
    looked_for = descriptors(50)
    nearest = np.unpackbits(looked_for[:, None] ^ first, axis=2).sum(axis=2).argmin(axis=1)
    np.testing.assert_array_equal(Vocabulary(nodes).words(looked_for) // BRANCHES**2, nearest)


def test_nodes_of_another_shape_are_refused():
    with pytest.raises(ValueError, match='nodes of 32 bytes'):
        Vocabulary(descriptors(7))


def test_the_shipped_vocabulary_is_small_and_its_words_are_all_in_use(vocabulary):
    words = vocabulary.words(descriptors(60000))
    assert words.max() < NUM_WORDS
    nodes = np.concatenate([level.reshape(-1, 32) for level in vocabulary._levels])
    assert nodes.nbytes < 1_000_000
    assert len(np.unique(nodes[-NUM_WORDS:], axis=0)) > 0.9 * NUM_WORDS


def test_the_view_itself_comes_first_and_a_disturbed_one_still_does(vocabulary):
    index, views = PlaceIndex(), [descriptors(800) for _ in range(12)]
    for k, view in enumerate(views):
        index.add(k, vocabulary.words(view))
    score = index.score(vocabulary.words(views[5]), 12)
    assert score[5] == pytest.approx(1.0)
    noisy = index.score(vocabulary.words(flipped(views[5], 8)), 12)
    assert noisy.argmax() == 5
    assert noisy[5] > 2 * np.sort(noisy)[-2]


def test_a_word_that_all_views_hold_weighs_nothing():
    index = PlaceIndex()
    index.add(0, np.array([1, 2, 3]))
    index.add(1, np.array([1, 4, 5]))
    score = index.score(np.array([1, 4]), 2)
    assert score[0] < 1e-6
    assert score[1] > 0.99


@pytest.mark.slow
def test_a_query_among_2000_keyframes_takes_milliseconds():
    index = PlaceIndex()
    for k in range(2000):
        index.add(k, RNG.integers(0, NUM_WORDS, 1000))
    words = RNG.integers(0, NUM_WORDS, 1000)
    took_s = []
    for _ in range(7):
        start_s = time.thread_time()
        index.score(words, 2000)
        took_s.append(time.thread_time() - start_s)
    assert min(took_s) < 0.005
