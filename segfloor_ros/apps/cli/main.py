"""The `segfloor` command: its commands are loaded when they are called."""

from __future__ import annotations

import errno
import logging
import os
import signal
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Annotated

import typer

import segfloor_ros
from segfloor_ros.apps.cli.printing import SUFFIX, print_error
from segfloor_ros.core.errors import MapError, SegfloorError
from segfloor_ros.core.processes import terminated_like_interrupted
from segfloor_ros.core.standard_error import own_standard_error

COMMANDS = {
    'run': (
        'commands:run',
        'Map a recording: every frame, no ROS graph, the same result byte for byte.',
    ),
    'replay': ('commands:replay', 'Map a recording with the five ROS 2 nodes over DDS.'),
    'info': (
        'recordings:info',
        'Describe an input, and whether it can be mapped: topics or folders, rates, gaps, '
        'calibration, sensors, and faults that some dozens of pairs show, with remedies.',
    ),
    'view': (
        'recordings:view',
        'Show the results folder of a run, a recording or the nodes that run.',
    ),
    'explore': (
        'commands:explore',
        'Let a simulated robot explore a scene by the map that the nodes make, then drive to '
        'goals.',
    ),
    'simulate': (
        'commands:simulate',
        'Render a drive with exact truth: images, calibration, poses, map and floor masks.',
    ),
    'calibrate': (
        'recordings:calibrate',
        'Calibrate a stereo pair from pictures of a board: ROS calibration files and a report.',
    ),
    'convert': (
        'recordings:convert',
        'Convert a recording to a rosbag2 (mcap), or to a folder as of KITTI or TUM RGB-D.',
    ),
    'record': (
        'recordings:record',
        'Record topics of the live graph, or a camera of this machine, to a rosbag2 (mcap).',
    ),
    'benchmark': (
        'evaluate:benchmark',
        'Print the time of each step of a frame and of a keyframe, or the cost of the nodes.',
    ),
    'demo': (
        'commands:demo',
        'Map a recorded drive through a corridor with the five nodes and score the map.',
    ),
    'params': ('commands:params', 'List the parameter files that `--params NAME` finds.'),
    'check': (
        'check:check_suite',
        'Map recordings and hold the results against bounds. Status 1: a bound failed.',
    ),
    'evaluate': ('evaluate:app', 'Score a map, a trajectory or floor masks against the truth.'),
    'map': ('maps:app', 'Look at saved maps, compare, merge, prune and correct them.'),
}
"""Where each command is, and what it does, in the words of its own help."""

EXTRAS = {
    'evo': 'evaluate', 'distributed': 'cluster', 'fsspec': 'cluster', 'mujoco': 'sim',
    'onnxruntime': 'onnx', 'rerun': 'view', 'rclpy': 'ros',
}  # fmt: skip
"""The extra of setup.py that has a package; the others come with the wheel."""

BY_APT = {'matplotlib', 'numpy', 'scipy', 'yaml'}
"""Packages that Ubuntu has as python3-NAME."""

COMPLETION = '_SEGFLOOR_COMPLETE'
"""Set by the shell that asks how a line may go on."""


def program(words: Sequence[str] = tuple(COMMANDS)) -> typer.Typer:
    """Return the command line with the commands that are among the words of a line; of the others
    only what they do.
    """
    app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False)
    app.callback()(_options)
    for name, (where, summary) in COMMANDS.items():
        command = _load(where) if name in words else _described(summary)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name)
        else:
            app.command(name)(command)
    return app


def _load(where: str) -> Callable[..., None] | typer.Typer:
    """Return a command, and let bags be read and written by ROS where it is there."""
    import cv2

    from segfloor_ros.apps.recordings.ros_bag import use_rosbag2_py

    use_rosbag2_py()
    cv2.setNumThreads(-1)  # OpenCV with TBB asks the environment only then
    module, _, name = where.partition(':')
    command: Callable[..., None] | typer.Typer
    command = getattr(import_module(f'segfloor_ros.apps.cli.{module}'), name)
    return command


def _described(summary: str) -> Callable[[], None]:
    def command() -> None:
        pass

    command.__doc__ = summary
    return command


def _print_version(is_asked: bool) -> None:
    if is_asked:
        typer.echo(f'segfloor_ros {segfloor_ros.__version__}')
        raise typer.Exit


def _options(
    version: Annotated[
        bool,
        typer.Option(
            '--version', help='Print the version.', callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    """Occupancy maps for ground robots from a stereo camera alone.

    \b
    segfloor demo
    segfloor run drive.mcap --out result --report
    segfloor view result
    segfloor simulate corridor1 --out corridor1
    """


def main() -> None:
    """Run the command line."""
    first = next((word for word in sys.argv[1:] if not word.startswith('-')), '')
    run_app(lambda: program(tuple(COMMANDS) if COMPLETION in os.environ else (first,)))


def run_command(command: Callable[..., None]) -> None:
    """Run a single command as a program of its own."""
    alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    alone.command()(command)
    run_app(lambda: alone)


def with_optional_values(words: list[str]) -> list[str]:
    """Return the words of a command line with `--view=` for a `--view` without a file."""
    files = [*words, ''][1:]
    pairs = zip(words, files, strict=True)
    return ['--view=' if w == '--view' and not f.endswith(SUFFIX) else w for w, f in pairs]


def run_app(make_app: Callable[[], typer.Typer]) -> None:
    """Make a command line and run it; known errors print one line.

    Status 2: bad input; 1: no map came of it, or what is printed could not be written.
    """
    logging.basicConfig(format='segfloor: %(message)s', level=logging.WARNING)
    status: str | int | None = 0
    try:
        from segfloor_ros.apps.cli.help_panels import laid_out

        app = make_app()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        with terminated_like_interrupted():
            laid_out(app)(args=with_optional_values(sys.argv[1:]))
    except SystemExit as ended:
        status = ended.code
    except KeyboardInterrupt:
        status = 130
    except MapError as error:
        print_error(str(error))
        status = 1
    except SegfloorError as error:
        print_error(str(error))
        status = 2
    except ModuleNotFoundError as error:
        name = (error.name or '').partition('.')[0]
        if name == 'segfloor_ros' or not name:
            raise
        print_error(what_is_missing(name))
        status = 2
    except OSError as error:  # e.g. a name that is too long, or no space where is printed to
        where = str(error.filename)[:200] if error.filename else 'standard output'
        print_error(f'{where}: {error.strerror or error}')
        status = 2 if error.filename else 1
    sys.exit(_flushed(status))


def _flushed(status: str | int | None) -> str | int | None:
    """Return a status, or 1 where it is 0 and what was printed cannot be written."""
    try:
        sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if error.errno != errno.EPIPE:
            print_error(f'standard output: cannot be written ({error.strerror})')
        return status or 1
    return status


def what_is_missing(package: str) -> str:
    """Return what to install where a Python package is missing."""
    extra = EXTRAS.get(package)
    by_pip = f"pip install 'segfloor_ros[{extra}]'" if extra else f'pip install {package}'
    by_apt = f'apt install python3-{package}, or ' if package in BY_APT else ''
    return (
        f'the command needs the Python package {package}, which is not installed: {by_apt}{by_pip} '
        'in a virtual environment'
    )


if __name__ == '__main__':
    own_standard_error()
    main()
