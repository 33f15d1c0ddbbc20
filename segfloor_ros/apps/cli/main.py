"""The `segfloor` command."""

from __future__ import annotations

import logging
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

    Status 2: bad input; 1: no map came of it.
    """
    logging.basicConfig(format='segfloor: %(message)s', level=logging.WARNING)
    try:
        with terminated_like_interrupted():
            program(args=with_optional_values(sys.argv[1:]))
    except MapError as error:
        print_error(str(error))
        sys.exit(1)
    except SegfloorError as error:
        print_error(str(error))
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == '__main__':
    own_standard_error()
    main()
