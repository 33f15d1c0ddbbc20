from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

from segfloor_ros.messages.topics import NODES

DOCS = Path(__file__).resolve().parents[2] / 'docs'


@pytest.mark.parametrize('node', NODES)
def test_the_page_of_a_node_is_as_generated(node) -> None:
    spec = importlib.util.spec_from_file_location('generate', DOCS / 'generate.py')
    assert spec is not None and spec.loader is not None
    generate = importlib.util.module_from_spec(spec)
    sys.modules['generate'] = generate
    spec.loader.exec_module(generate)
    committed = (DOCS / 'nodes' / f'{node}.md').read_text()
    assert committed == generate.page(node), 'run: python docs/generate.py'
