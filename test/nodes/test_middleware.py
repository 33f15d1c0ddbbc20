"""What the node processes ask of Fast DDS."""

import os
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from node_chain import NodeChain

from segfloor_ros.nodes.messages.topics import CLOUD, NAMED_BY, PROFILES, prepare_middleware

STEREO_PAIR_BYTES = 2 * 1226 * 370


def segment_bytes() -> int:
    tree = ET.parse(PROFILES)
    (size,) = (e.text for e in tree.iter() if e.tag.endswith('}segment_size'))
    return int(size or 0)


def shared_memory_of(process_id: int) -> list[int]:
    """Return the sizes of the shared memory that a process has mapped for its messages."""
    sizes = []
    for line in Path(f'/proc/{process_id}/maps').read_text().splitlines():
        if '/dev/shm/fastrtps_' in line and 'port' not in line:
            first, last = (int(word, 16) for word in line.split()[0].split('-'))
            sizes.append(last - first)
    return sizes


@pytest.mark.skipif(not Path('/dev/shm').is_dir(), reason='needs shared memory')
def test_a_node_has_shared_memory_for_several_stereo_pairs(make_graph, tmp_path, monkeypatch):
    monkeypatch.delenv(NAMED_BY, raising=False)
    graph = make_graph()
    chain = NodeChain(graph, tmp_path)
    try:
        chain.start(CLOUD)
        assert max(shared_memory_of(chain.pid(CLOUD))) >= segment_bytes()
    finally:
        chain.stop()
    assert segment_bytes() > 4 * STEREO_PAIR_BYTES
    # Fast DDS complains about a file that it does not understand.
    assert 'XML' not in chain.log(CLOUD)


@pytest.mark.parametrize('name', [NAMED_BY, 'FASTDDS_BUILTIN_TRANSPORTS'])
def test_what_the_user_has_chosen_stays(monkeypatch, tmp_path, name) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(NAMED_BY, raising=False)
    monkeypatch.setenv(name, 'mine')
    prepare_middleware()
    assert os.environ[name] == 'mine'
    assert (NAMED_BY in os.environ) is (name == NAMED_BY)
    monkeypatch.delenv(name)
    (tmp_path / 'DEFAULT_FASTRTPS_PROFILES.xml').touch()
    prepare_middleware()
    assert NAMED_BY not in os.environ
    (tmp_path / 'DEFAULT_FASTRTPS_PROFILES.xml').unlink()
    monkeypatch.setenv(NAMED_BY, '')
    prepare_middleware()
    assert os.environ[NAMED_BY] == str(PROFILES)
