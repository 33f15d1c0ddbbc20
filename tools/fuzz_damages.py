"""Damages: what may happen to a file between who wrote it and who reads it. Each takes a random
generator and a path, and leaves something else there.
"""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

Rng = np.random.Generator

WORDS = (
    '', '-1', '0', '1', '-0.0', '1e400', '-1e400', '1e308', '1e-320', 'nan', '.nan', 'inf', '.inf',
    '-.inf', '9223372036854775807', '9223372036854775808', '-9223372036854775809', '4294967296',
    '99999999999999999999999999', '1403636579763555527', '-99.9', '0x7fffffff', '1_000', '1:60',
    '1:30', '2024-02-31', '2024-01-01T00:00:00Z', '²', '١', '½', 'true', 'null', '~', 'x',
    'o[red]x', '[/red]', '{}', '[]', '[1, 2]', '{a: 1}', '*a', '&a [*a]', '<<: 3',
    '!!python/name:os.system', '!!binary aGk=', '%', '@', '`', '"', "'", '\\',
    '../../etc/passwd', '/dev/zero', '/', '.', '..',
    'none.png', '%s%n', '\x1b[31mred', '\x07', '\u202e', '\ufeff', '\ud7ff', '[' * 3000, '{' * 500,
    '9' * 5000, 'a' * 100_000, '1 ' * 1000, '- ' * 2000,
)  # fmt: skip
"""Words that readers stumble over."""

VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 3, 10**6, 2**31, 2**32, 2**53, 2**63, -(2**63), 10**30, 10**400,
    0.0, -0.0, 0.5, 1e-300, 1e-9, 1e9, 1e20, 1e300, float('inf'), float('-inf'), float('nan'), '',
    'x', '1', '1e400', 'nan', '²', '1:60', 'o[red]x', '\x1b[31m', 'a\nb', 'a\0b', '/dev/zero', '..',
    '2024-02-31', [], {}, [[]], [1], [None], ['x'], {'a': 1}, {'': None}, [0.0] * 3, [1e308] * 16,
    list(range(1000)), [[[[[[[[[[1]]]]]]]]]],
)  # fmt: skip


def _bytes(change: Callable[[Rng, bytearray], bytes | bytearray]) -> Callable[[Rng, Path], None]:
    def damage(rng: Rng, path: Path) -> None:
        path.write_bytes(change(rng, bytearray(path.read_bytes())))

    return damage


def _text(change: Callable[[Rng, str], str]) -> Callable[[Rng, Path], None]:
    def damage(rng: Rng, path: Path) -> None:
        text = path.read_bytes().decode('latin-1')
        path.write_bytes(change(rng, text).encode('utf-8', errors='surrogatepass'))

    return damage


def _span(rng: Rng, data: bytearray) -> slice:
    at = int(rng.integers(len(data) + 1))
    longest = min(len(data), 1 << int(rng.integers(1, 12)))
    return slice(at, at + int(rng.integers(1, max(2, longest))))


def _flip_bits(rng: Rng, data: bytearray) -> bytearray:
    for _ in range(int(rng.integers(1, 20)) if data else 0):
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    return data


def _overwrite(rng: Rng, data: bytearray) -> bytearray:
    span = _span(rng, data)
    size = len(data[span])
    choice = int(rng.integers(4))
    data[span] = (bytes(size), b'\xff' * size, rng.bytes(size), b'\x7f' * size)[choice]
    return data


def _number(rng: Rng, data: bytearray) -> bytearray:
    """Write a large or small binary number somewhere: lengths and counts are among them."""
    size = int(rng.choice([2, 4, 8]))
    value = int(rng.choice([0, 1, 2**15, 2 ** (8 * size - 1) - 1, 2 ** (8 * size - 1)]))
    raw = value.to_bytes(size + 1, 'little')[:size]
    at = int(rng.integers(max(1, len(data) - size)))
    data[at : at + size] = raw if rng.random() < 0.5 else raw[::-1]
    return data


def _insert(rng: Rng, data: bytearray) -> bytearray:
    at = int(rng.integers(len(data) + 1))
    data[at:at] = rng.bytes(int(rng.integers(1, 200)))
    return data


def _remove(rng: Rng, data: bytearray) -> bytearray:
    del data[_span(rng, data)]
    return data


def _repeat(rng: Rng, data: bytearray) -> bytearray:
    span = _span(rng, data)
    data[span.stop : span.stop] = data[span] * int(rng.integers(1, 20))
    return data


def _swap(rng: Rng, data: bytearray) -> bytearray:
    first, second = sorted((_span(rng, data), _span(rng, data)), key=lambda s: int(s.start))
    return data[: first.start] + data[second] + data[first.stop : second.start] + data[first]


def _words(rng: Rng, text: str) -> str:
    """Put hostile words in the place of some words or numbers."""
    found = list(re.finditer(r'[^\s,:\[\]{}=]+', text))
    count = int(rng.integers(1, 4)) if found else 0
    for place in sorted(rng.integers(max(1, len(found)), size=count))[::-1]:
        match = found[int(place)]
        text = text[: match.start()] + _word(rng) + text[match.end() :]
    return text


def _word(rng: Rng) -> str:
    return WORDS[int(rng.integers(len(WORDS)))]


def _lines(rng: Rng, text: str) -> str:
    """Drop, double, swap or add lines."""
    lines = text.split('\n')
    a, b = (int(rng.integers(len(lines))) for _ in range(2))
    choice = int(rng.integers(5))
    if choice == 0:
        del lines[a]
    elif choice == 1:
        lines.insert(b, lines[a])
    elif choice == 2:
        lines[a], lines[b] = lines[b], lines[a]
    elif choice == 3:
        lines.insert(a, _word(rng))
    else:
        lines = lines[:a] + [' ' * int(rng.integers(1, 9)) + line for line in lines[a:]]
    return '\n'.join(lines)


def _encoding(rng: Rng, path: Path) -> None:
    """Save a text as another editor does."""
    text = path.read_bytes().decode('latin-1')
    codings = ('utf-8-sig', 'utf-16', 'utf-16-be', 'utf-32', 'cp037')
    choice = int(rng.integers(len(codings) + 2))
    if choice < len(codings):
        path.write_bytes(text.encode(codings[choice]))
    elif choice == len(codings):
        path.write_bytes(text.replace('\n', '\r\n').encode('latin-1'))
    else:
        path.write_bytes(text.replace('\n', '\r').encode('latin-1') + b'\x1a')


def _places(value: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value)
    inner = [(*here, key) for key, _ in items] if isinstance(value, (dict, list)) else []
    items = value.items() if isinstance(value, dict) else enumerate(value)
    deeper = [
        place
        for key, item in (items if isinstance(value, (dict, list)) else ())
        if isinstance(item, (dict, list))
        for place in _places(item, (*here, key))
    ]
    return inner + deeper


def _structure(rng: Rng, path: Path) -> None:
    """Change values of a YAML or JSON file: other types, huge numbers, missing, renamed."""
    text = path.read_bytes().decode('latin-1')
    try:
        document = json.loads(text) if path.suffix == '.json' else yaml.safe_load(_plain(text))
    except (ValueError, yaml.YAMLError):
        document = None
    if not isinstance(document, (dict, list)):
        path.write_text(_words(rng, text))
        return
    for _ in range(int(rng.integers(1, 3))):
        places = _places(document)
        if not places:
            break
        *way, last = places[int(rng.integers(len(places)))]
        holder = document
        for key in way:
            holder = holder[key]
        choice = int(rng.integers(10))
        if choice == 0:
            del holder[last]
        elif choice == 1 and isinstance(holder, dict):
            holder[_word(rng)[:50]] = holder.pop(last)
        elif choice == 2:
            holder[last] = [holder[last]]
        elif choice == 3 and isinstance(holder[last], list):
            holder[last] = holder[last] * 2 if rng.random() < 0.5 else holder[last][:-1]
        else:
            holder[last] = VALUES[int(rng.integers(len(VALUES)))]
    if path.suffix == '.json':
        path.write_text(_json(document))
    else:
        path.write_text(yaml.safe_dump(document, allow_unicode=True))


def _json(document: Any) -> str:
    kept = sys.get_int_max_str_digits()
    sys.set_int_max_str_digits(0)
    try:
        return json.dumps(document, default=str)
    finally:
        sys.set_int_max_str_digits(kept)


def _plain(text: str) -> str:
    return re.sub('(?m)^%YAML:', '#', text)


def _aliases(rng: Rng, path: Path) -> None:
    """Put a bomb of aliases, one that holds itself, or deep nesting into a text."""
    levels = int(rng.integers(3, 30))
    bomb = 'b0: &b0 [x, x, x]\n' + ''.join(
        f'b{i}: &b{i} [{", ".join([f"*b{i - 1}"] * 9)}]\n' for i in range(1, levels)
    )
    deep = '{"a": ' * levels * 100 + '1' + '}' * levels * 100
    own = 'a: &a {b: *a}\n'
    merged = 'a: &a {<<: *a, x: 1}\n' if rng.random() < 0.5 else '<<: 3\n'
    chosen = (bomb, deep, own, merged, '[' * levels * 300)[int(rng.integers(5))]
    old = path.read_bytes().decode('latin-1')
    path.write_text(chosen + old if rng.random() < 0.5 else old + '\n' + chosen)


def _picture(rng: Rng, path: Path) -> None:
    """Put another picture in the place: of other size, depth, channels or format."""
    size = (1, 2, 7, 64, 160, 3000)[int(rng.integers(6))]
    shape: tuple[int, ...] = (size, size + int(rng.integers(3)))
    kinds = ((np.uint8, '.png'), (np.uint16, '.png'), (np.float32, '.tiff'), (np.uint8, '.jpg'),
             (np.float32, '.exr'), (np.uint16, '.tiff'), (np.uint8, '.bmp'))  # fmt: skip
    kind, suffix = kinds[int(rng.integers(len(kinds)))]
    channels = int(rng.choice([1, 3, 4]))
    if channels > 1 and kind == np.uint8 and suffix == '.png':
        shape = (*shape, channels)
    image = (rng.random(shape) * (255 if kind == np.uint8 else 60_000)).astype(kind)
    if kind == np.float32 and rng.random() < 0.5:
        image[:] = np.nan
    try:
        done, data = cv2.imencode(suffix, image)
    except cv2.error:
        done = False
    path.write_bytes(data.tobytes() if done else b'')


def _png(rng: Rng, path: Path) -> None:
    """Change a PNG within its chunks, with right checksums."""
    data = path.read_bytes()
    if not data.startswith(b'\x89PNG'):
        return _bytes(_number)(rng, path)
    chunks, at = [], 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], 'big')
        chunks.append((data[at + 4 : at + 8], bytearray(data[at + 8 : at + 8 + length])))
        at += 12 + length
    choice, (_, header) = int(rng.integers(5)), chunks[0]
    if choice == 0:
        sizes = (0, 1, 50_000, 2**31 - 1, 2**32 - 1)
        header[0:4] = sizes[int(rng.integers(5))].to_bytes(4, 'big')
        header[4:8] = sizes[int(rng.integers(5))].to_bytes(4, 'big')
    elif choice == 1:
        header[8 + int(rng.integers(5))] = int(rng.integers(256))
    elif choice == 2:
        name, body = chunks[int(rng.integers(len(chunks)))]
        _overwrite(rng, body)
    elif choice == 3:
        kind = (b'tRNS', b'iCCP', b'PLTE', b'gAMA', b'eXIf', b'zTXt')[int(rng.integers(6))]
        chunks.insert(1, (kind, bytearray(rng.bytes(int(rng.integers(0, 300))))))
    else:
        del chunks[int(rng.integers(1, len(chunks)))]
    out = data[:8]
    for name, body in chunks:
        crc = zlib.crc32(name + bytes(body))
        out += len(body).to_bytes(4, 'big') + name + bytes(body) + crc.to_bytes(4, 'big')
    path.write_bytes(out)
    return None


def _archive(rng: Rng, path: Path) -> None:
    """Change a member of a zip, with right checksums: numbers, shapes, kinds, the header."""
    if not zipfile.is_zipfile(path):
        return _bytes(_number)(rng, path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = sorted(members)[int(rng.integers(len(members)))]
    choice = int(rng.integers(6))
    if name.endswith('.json') or choice == 0:
        name = next(n for n in members if n.endswith('.json'))
        side = path.with_name('header.json')
        side.write_bytes(members[name])
        _structure(rng, side)
        members[name] = side.read_bytes()
        side.unlink()
    elif choice == 1:
        del members[name]
    elif choice == 2:
        members[name] = bytes(_flip_bits(rng, bytearray(members[name])))
    elif choice == 3:
        members[name] = bytes(1 << int(rng.integers(10, 29)))
    else:
        members[name] = _other_array(rng, members[name])
    with zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED) as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return None


def _other_array(rng: Rng, content: bytes) -> bytes:
    array = np.load(io.BytesIO(content))
    choice = int(rng.integers(6))
    if array.size and choice < 3:
        at = np.unravel_index(int(rng.integers(array.size)), array.shape)
        values: tuple[float, ...] = (0, 1, -1, 10**9)
        if array.dtype.kind == 'f':
            values = (np.nan, np.inf, -np.inf, 1e30, 0.0)
        with np.errstate(all='ignore'):
            array[at] = np.array(values[int(rng.integers(len(values)))]).astype(array.dtype)
    elif choice == 3:
        array = array[: len(array) // 2] if array.ndim else array
    elif choice == 4:
        array = array.astype((np.float64, np.int8, np.uint64, np.complex64)[int(rng.integers(4))])
    else:
        array = array.reshape(-1)
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def _no_file(rng: Rng, path: Path) -> None:
    """Put something else in the place of a file."""
    path.unlink()
    choice = int(rng.integers(7))
    if choice == 0:
        os.mkfifo(path)
    elif choice == 1:
        path.symlink_to('/dev/zero')
    elif choice == 2:
        path.mkdir()
    elif choice == 3:
        path.symlink_to(path.name)
    elif choice == 4:
        path.symlink_to('/nowhere')
    elif choice == 5:
        path.symlink_to('/dev/null')


def _huge(rng: Rng, path: Path) -> None:
    """Lengthen a file by zeros that take no room on the disk."""
    with path.open('r+b') as file:
        file.truncate(1 << int(rng.integers(20, 33)))


def _other_file(rng: Rng, path: Path) -> None:
    """Put another file of the same input in the place."""
    others = sorted(p for p in path.parents[1].rglob('*') if p.is_file() and p != path)
    if others:
        shutil.copy(others[int(rng.integers(len(others)))], path)


def _locked(rng: Rng, path: Path) -> None:
    path.chmod(0)


DAMAGES: dict[str, Callable[[Rng, Path], None]] = {
    'nothing': lambda rng, path: None,
    'bits': _bytes(_flip_bits),
    'truncated': _bytes(lambda rng, data: data[: int(rng.integers(len(data) + 1))]),
    'empty': _bytes(lambda rng, data: b''),
    'overwritten': _bytes(_overwrite),
    'binary number': _bytes(_number),
    'inserted': _bytes(_insert),
    'removed': _bytes(_remove),
    'repeated': _bytes(_repeat),
    'swapped': _bytes(_swap),
    'random': _bytes(lambda rng, data: rng.bytes(int(rng.integers(1, 3000)))),
    'words': _text(_words),
    'lines': _text(_lines),
    'encoding': _encoding,
    'structure': _structure,
    'values': _structure,
    'aliases': _aliases,
    'picture': _picture,
    'chunks': _png,
    'members': _archive,
    'no file': _no_file,
    'huge': _huge,
    'other file': _other_file,
    'no permission': _locked,
}
