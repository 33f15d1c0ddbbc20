"""The `segfloor` command."""

from __future__ import annotations

import errno
import logging
import os
import signal
import sys
from collections.abc import Callable
from typing import Annotated

import cv2
import typer

import segfloor_ros
from segfloor_ros.apps.cli.check import check_suite
from segfloor_ros.apps.cli.commands import demo, explore, params, replay, run, simulate
from segfloor_ros.apps.cli.evaluate import app as evaluate
from segfloor_ros.apps.cli.evaluate import benchmark
from segfloor_ros.apps.cli.maps import app as maps
from segfloor_ros.apps.cli.recordings import calibrate, convert, info, record, view
from segfloor_ros.apps.cli.terminal import print_error
from segfloor_ros.apps.cli.view import SUFFIX
from segfloor_ros.apps.recordings.ros_bag import use_rosbag2_py
from segfloor_ros.core.errors import MapError, SegfloorError
from segfloor_ros.core.files.images import own_standard_error
from segfloor_ros.core.processes import terminated_like_interrupted

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False)
for command in (
    run,
    replay,
    info,
    view,
    explore,
    simulate,
    calibrate,
    convert,
    record,
    benchmark,
    demo,
    params,
):
    app.command()(command)
app.command('check')(check_suite)
app.add_typer(evaluate, name='evaluate')
app.add_typer(maps, name='map')


def _print_version(is_asked: bool) -> None:
    if is_asked:
        typer.echo(f'segfloor_ros {segfloor_ros.__version__}')
        raise typer.Exit


@app.callback()
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
    use_rosbag2_py()
    cv2.setNumThreads(-1)  # OpenCV with TBB asks the environment only then
    run_app(app)


def run_command(command: Callable[..., None]) -> None:
    """Run a single command as a program of its own."""
    program = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    program.command()(command)
    run_app(program)


def with_optional_values(words: list[str]) -> list[str]:
    """Return the words of a command line with `--view=` for a `--view` without a file."""
    files = [*words[1:], '']
    pairs = zip(words, files, strict=True)
    return ['--view=' if w == '--view' and not f.endswith(SUFFIX) else w for w, f in pairs]


def run_app(program: typer.Typer) -> None:
    """Run a command line; known errors print one line.

    Status 2: bad input; 1: no map came of it, or what is printed could not be written.
    """
    logging.basicConfig(format='segfloor: %(message)s', level=logging.WARNING)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    status: str | int | None = 0
    try:
        with terminated_like_interrupted():
            program(args=with_optional_values(sys.argv[1:]))
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


if __name__ == '__main__':
    own_standard_error()
    main()
