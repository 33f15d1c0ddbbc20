"""The exceptions of the package. All share one root, so that a program can print one line and
stop.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

_CREDENTIALS = re.compile(r"""(?<=://)[^/\s]*@|[^\s/:@'"]+:[^\s/@]+@""")
_SIGNED = re.compile(r"""(://[^\s?]*)\?[^\s'",)]*=(?:[^\s'",):]|:(?=\S))*""")


def without_credentials(text: str) -> str:
    """Return a text without `user:password@` of its addresses and the queries of its URLs, which
    may sign them.
    """
    return _SIGNED.sub(r'\1', _CREDENTIALS.sub('', text))


class SegfloorError(Exception):
    """Root of every error whose message is meant for the user: what, where, what to do. An address
    is shown without its credentials.
    """

    def __init__(self, message: str = '') -> None:
        super().__init__(without_credentials(message))


class InputError(SegfloorError):
    """A recording or message cannot be read: missing, empty, inconsistent or of an unknown kind."""


class CalibrationError(SegfloorError):
    """A camera calibration is missing, incomplete or impossible."""


class SettingsError(SegfloorError):
    """A parameter is unknown, of the wrong type or out of its range."""


class MapError(SegfloorError):
    """No map could be made, or a map file cannot be read."""


def printable(text: str) -> str:
    """Return a text in one line, with blanks for what no terminal, page or XML file shows."""
    return ''.join(c if c.isprintable() else ' ' for c in text)


@contextmanager
def about(name: str) -> Iterator[None]:
    """Have errors of the block say what they are about."""
    try:
        yield
    except SegfloorError as error:
        if name in str(error):
            raise
        raise type(error)(f'{name}: {error}') from error


@contextmanager
def os_errors(what: str, advice: str = '') -> Iterator[None]:
    """Turn an error of the operating system into one line: what is wrong, why, what to do. Raises
    InputError.
    """
    try:
        yield
    except OSError as error:
        raise InputError(f'{what} ({error.strerror}){advice}') from None


class CorruptImageError(InputError):
    """The data of one image is damaged; the rest of the recording may be fine."""
