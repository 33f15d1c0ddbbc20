"""What the command line prints on, and its errors."""

from __future__ import annotations

from rich.console import Console

from segfloor_ros.core.errors import printable

SUFFIX = '.rrd'
"""Of the file of a view."""

console = Console(markup=False, highlight=False)
error_console = Console(stderr=True, soft_wrap=True, markup=False, highlight=False)


def print_error(message: str) -> None:
    """Print one line on standard error."""
    error_console.print(f'segfloor: {printable(message)}')
