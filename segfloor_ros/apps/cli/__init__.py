"""The `segfloor` command.

In: the words of a command line. Out: files in a folder, tables, an exit status.
The way in is `main`, which loads a command when it is called.
"""

import os
import sys

import segfloor_ros
from segfloor_ros.core.starting import end_in_silence_on_signals, open_standard_streams
from segfloor_ros.core.threads import limit_threads

limit_threads()


def start() -> None:
    """Run the command line; without its libraries, end with one line and status 2."""
    open_standard_streams()
    end_in_silence_on_signals()
    if sys.argv[1:] == ['--version']:  # also where nothing else is installed
        return _print_version()
    try:
        from segfloor_ros.apps.cli.main import main as run
        from segfloor_ros.core.standard_error import own_standard_error
    except ModuleNotFoundError as error:
        if (error.name or '').startswith('segfloor_ros'):
            raise
        name = (error.name or '').partition('.')[0]
        print(
            f'segfloor: the command needs the Python package {name}, which is not installed: '
            f'apt install python3-{name}, or pip install {name} in a virtual environment; the ROS '
            'nodes do without it',
            file=sys.stderr,
        )
        sys.exit(2)
    own_standard_error()
    run()


def _print_version() -> None:
    try:
        print(f'segfloor_ros {segfloor_ros.__version__}', flush=True)
    except OSError as error:
        sys.stderr.write(f'segfloor: standard output: {error.strerror}\n')
        os._exit(1)
