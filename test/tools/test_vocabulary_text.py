"""The vocabulary as text for ORB-SLAM2 and ORB-SLAM3."""

import numpy as np
import pytest

from segfloor_ros.core.slam.places.place_recognition import BRANCHES, NUM_WORDS, Vocabulary
from tools.vocabulary_text import text, weights


@pytest.fixture(scope='module')
def nodes():
    total = BRANCHES + BRANCHES**2 + NUM_WORDS
    return np.random.default_rng(4).integers(0, 256, (total, 32), np.uint8)


class Tree:
    """Reads the text as those programs do."""

    def __init__(self, read):
        head, *lines = read.split('\n')
        branches, levels, *_ = map(int, head.split())
        assert branches <= 20
        # They keep pointers to nodes, so that these must fit into what the head reserves.
        assert len(lines) < (branches ** (levels + 1) - 1) // (branches - 1)
        assert len(lines) <= branches ** (levels + 1)
        self.children, self.word, self.byte, self.weight = {}, {}, {}, {}
        for own, line in enumerate(lines, 1):
            parent, is_word, *values = line.split()
            assert int(parent) < own and len(values) == 33
            self.children.setdefault(int(parent), []).append(own)
            self.byte[own] = np.array(values[:32], np.uint8)
            if int(is_word):
                self.word[own], self.weight[own] = len(self.word), float(values[32])

    def find(self, descriptor):
        node = 0
        while node in self.children:
            children = self.children[node]
            bits = [np.unpackbits(self.byte[child] ^ descriptor).sum() for child in children]
            node = children[int(np.argmin(bits))]
        return self.word[node], self.weight[node]


def test_the_text_finds_the_same_words(nodes):
    vocabulary = Vocabulary(nodes)
    weight = np.arange(NUM_WORDS) / 8
    tree = Tree(text(nodes, weight))
    assert len(tree.word) == NUM_WORDS
    descriptors = np.random.default_rng(5).integers(0, 256, (40, 32), np.uint8)
    for descriptor, word in zip(descriptors, vocabulary.words(descriptors), strict=True):
        assert tree.find(descriptor) == (word, weight[word])


def test_a_word_weighs_more_in_fewer_frames(nodes):
    vocabulary = Vocabulary(nodes)
    views = np.random.default_rng(6).integers(0, 256, (2, 32), np.uint8)
    common, rare = vocabulary.words(views)
    assert common != rare
    found = weights(vocabulary, [views[:1], views, views[[0, 0]]])
    assert found[common] == 0
    assert found[rare] == pytest.approx(np.log(2))
    others = np.delete(found, [common, rare])
    np.testing.assert_allclose(others, np.log(4))
