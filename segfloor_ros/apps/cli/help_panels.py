"""Which options a help shows first, and which in a panel of their own."""

from __future__ import annotations

from typing import Any

import typer

BASIC = {
    'run': '--out --report --view --params --set --every --save-map --load-map',
    'replay': '--out --report --view --params --set --rate --save-map --load-map',
    'explore': '--out --robot --goals --seed --start-in --goal --minutes',
    'simulate': '--out --camera --set --list',
    'calibrate': '--out --square --board --marker --dictionary --check --from',
    'convert': '--layout --images --truth --json --params --set --every --frames',
    'check': '--out --data --jobs --baseline --write-baseline --resume --view --json',
    'evaluate map': '--trajectory --align --overlay --json',
}
"""Of commands with many options, those that a help shows first."""

ADVANCED = 'Advanced options'


def laid_out(app: typer.Typer) -> Any:
    """Return the command line of an app, with the options in their panels."""
    command = typer.main.get_command(app)
    lay_out(command)
    return command


def lay_out(command: Any, name: str = '') -> None:
    """Put the options of a command line that are not `BASIC` into a panel of their own."""
    for word, inner in getattr(command, 'commands', {}).items():
        lay_out(inner, f'{name} {word}'.strip())
    for option in command.params:
        if name in BASIC and option.opts[0].startswith('-') and option.name != 'help':
            is_basic = bool({*option.opts} & {*BASIC[name].split()})
            option.rich_help_panel = None if is_basic else ADVANCED
