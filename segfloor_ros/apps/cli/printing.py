"""What the command line prints on, and its errors."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.text import Text

from segfloor_ros.core.errors import printable

SUFFIX = '.rrd'
"""Of the file of a view."""


class PlainConsole(Console):
    """A console that passes no control characters of names on to the terminal."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text as it is shown."""
        return super().render_str('\n'.join(map(printable, text.split('\n'))), **options)


console = PlainConsole(markup=False, highlight=False)
error_console = PlainConsole(stderr=True, soft_wrap=True, markup=False, highlight=False)


def print_error(message: str) -> None:
    """Print one line on standard error."""
    error_console.print(f'segfloor: {printable(message)}')
