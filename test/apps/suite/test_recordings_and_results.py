"""Recordings by URL, their digests, and results that are packed and kept."""

import io
import tarfile

import pytest

from segfloor_ros.apps.suite.result_files import (
    Cache,
    digest_of,
    find_recordings,
    local_copy,
    pack,
    unpack,
)
from segfloor_ros.core.errors import InputError


def test_a_url_is_copied_once_and_again_when_it_changed(tmp_path):
    drive = tmp_path / 'far' / 'drive'
    (drive / 'image_0').mkdir(parents=True)
    (drive / 'image_0' / '000000.png').write_bytes(b'1')
    bag = tmp_path / 'far' / 'bag.mcap'
    bag.write_bytes(b'first')
    copies = tmp_path / 'copies'
    copy = local_copy(f'file://{drive}', copies)
    assert copy.name == 'drive'
    assert (copy / 'image_0' / '000000.png').read_bytes() == b'1'
    first = local_copy(f'file://{bag}', copies)
    bag.write_bytes(b'other bytes')
    second = local_copy(f'file://{bag}', copies)
    assert (first.read_bytes(), second.read_bytes()) == (b'first', b'other bytes')
    second.write_bytes(b'kept')
    assert local_copy(f'file://{bag}', copies).read_bytes() == b'kept'
    assert find_recordings(f'file://{tmp_path}/far/*.mcap') == {'bag': f'file://{bag}'}


@pytest.mark.parametrize('url', ['file:///no/such/bag', 'nosuch://x/y'])
def test_a_url_that_leads_nowhere_is_named(tmp_path, url):
    with pytest.raises(InputError, match=url):
        local_copy(url, tmp_path)


@pytest.mark.parametrize(
    ('text', 'shown'),
    [
        ('https://me:s3cret@host/night.mcap: gone', 'https://host/night.mcap: gone'),
        ('https://host/b.mcap?a=b:c: gone', 'https://host/b.mcap: gone'),
        ('https://t0ken@host/a/b.mcap', 'https://host/a/b.mcap'),
        ("s3://k:a@b@bucket/night-*, 'x'", "s3://bucket/night-*, 'x'"),
        ('(https://host/b.mcap?X-Sig=a.b/c&d=e)', '(https://host/b.mcap)'),
        ('gs://bucket/night-?.mcap', 'gs://bucket/night-?.mcap'),
        ("invalid address 'me:s3cret@host:1'", "invalid address 'host:1'"),
        ('mail me@example.org: line 3', 'mail me@example.org: line 3'),
    ],
)
def test_errors_show_addresses_without_credentials(text, shown):
    assert str(InputError(text)) == shown


def test_a_signed_url_gives_no_name():
    signed = 'https://me:s3cret@host/night.mcap?sig=a.b/c'
    assert find_recordings(signed) == {'night': signed}


def test_a_digest_follows_names_and_content_and_not_the_place(tmp_path):
    def folder(name, **files):
        for file, text in files.items():
            path = tmp_path / name / 'in' / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return digest_of(tmp_path / name)

    digest = folder('one', a='1', b='2')
    assert folder('two', a='1', b='2') == digest
    assert len({digest, folder('three', a='1', b='3'), folder('four', a='1', c='2')}) == 3
    assert folder('five', a='1', b='2', **{'__pycache__/m.pyc': '5'}) == digest


def test_results_survive_packing_and_the_cache(tmp_path):
    out = tmp_path / 'out'
    (out / 'masks').mkdir(parents=True)
    (out / 'masks' / '0.png').write_bytes(bytes(range(256)))
    (out / 'map.yaml').write_text('x: 1')
    cache = Cache(tmp_path / 'cache')
    assert cache.get('key') is None
    cache.put('key', {'recall_percent': 93.5}, pack(out))
    cache.put('key', {'recall_percent': 1.0}, b'')  # who comes second finds it there
    measured, archive = cache.get('key')
    assert measured == {'recall_percent': 93.5}
    earlier = out / 'earlier.txt'
    earlier.write_text('of an earlier run')
    unpack(pack(out), tmp_path / 'new', {'more.txt': b'more'})
    assert (tmp_path / 'new' / 'more.txt').read_bytes() == b'more'
    earlier.unlink()
    unpack(archive, tmp_path / 'new')
    assert sorted(tmp_path.iterdir()) == [tmp_path / name for name in ('cache', 'new', 'out')]
    (tmp_path / 'new' / '.segfloor_result').unlink()
    assert digest_of(tmp_path / 'new') == digest_of(out)


def test_an_archive_cannot_write_elsewhere(tmp_path):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode='w') as archive:
        archive.addfile(tarfile.TarInfo('../outside'))
    with pytest.raises(ValueError, match='outside'):
        unpack(buffer.getvalue(), tmp_path / 'in' / 'new')
    assert not (tmp_path / 'outside').exists()
