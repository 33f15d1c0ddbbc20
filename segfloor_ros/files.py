"""Files that are read whole, or written whole in place of an older one."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import yaml

from segfloor_ros.errors import InputError, SegfloorError


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Write a file beside its target and move it into place at the end of the block; after an error
    nothing is left of it. Raises OSError.
    """
    written = path.with_name(f'.{path.name}.{os.getpid()}.part')
    try:
        with written.open('wb') as file:
            yield file
        written.replace(path)
    finally:
        written.unlink(missing_ok=True)


def read_yaml(
    path: Path, expected: str, error_type: type[SegfloorError] = InputError
) -> dict[str, Any]:
    """Return the mapping that a YAML file holds. expected: what it should be, in words. Raises an
    error of a type that names the file and what is wrong with it.
    """
    try:
        document = yaml.safe_load(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise error_type(f'{path}: cannot be read ({error.strerror})') from None
    except UnicodeDecodeError as error:
        raise error_type(f'{path}, byte {error.start}: is not UTF-8; save it as that') from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        line = getattr(getattr(error, 'problem_mark', None), 'line', 0) + 1
        raise error_type(f'{path}, line {line}: not valid YAML') from None
    if not isinstance(document, dict):
        raise error_type(f'{path}: expected {expected}')
    return document
