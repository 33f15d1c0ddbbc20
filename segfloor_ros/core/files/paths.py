"""Names of files and folders as people write them."""

from __future__ import annotations

from pathlib import Path

from segfloor_ros.core.errors import InputError


def user_path(name: str | Path) -> Path:
    """Return the path of a name that a user gives, with `~` and `~user` for home folders. Raises
    InputError for a name that cannot be one.
    """
    if '\0' in str(name):
        raise InputError(f'{name}: a name holds no null character')
    try:
        return Path(name).expanduser()
    except RuntimeError:
        raise InputError(f'{name}: there is no such user; write the whole path') from None
