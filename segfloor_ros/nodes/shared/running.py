"""Runs nodes until they are interrupted, on a middleware that is set up for stereo images."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from segfloor_ros.errors import SegfloorError, SettingsError
from segfloor_ros.node_settings import NODE_SETTINGS

PROFILES = Path(__file__).parents[1] / 'fastdds.xml'
"""Shared memory for stereo images and prompt repetition of what was lost, for Fast DDS, the
default middleware of ROS 2 Jazzy. Other middlewares do not read it.
"""

NAMED_BY = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_OTHERS = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTDDS_BUILTIN_TRANSPORTS')
_IN_FOLDER = ('DEFAULT_FASTRTPS_PROFILES.xml', 'DEFAULT_FASTDDS_PROFILES.xml')

INTERRUPT_HEARD_S = 0.2

HELP = ('-h', '--help')

M_ARENA_MAX = -8
"""Of glibc's malloc.h."""


def prepare_middleware() -> None:
    """Let Fast DDS take `PROFILES` in this process, unless the user has chosen otherwise. Before
    `rclpy.init`.
    """
    is_chosen = any(os.environ.get(name) for name in (NAMED_BY, *_OTHERS))
    if not is_chosen and not any(Path(name).exists() for name in _IN_FOLDER):
        os.environ[NAMED_BY] = str(PROFILES)


def run_node(make_node: Callable[[], Node]) -> None:
    """Run a node until it is interrupted (status 0); bad parameters or input end it with one
    line and status 2.
    """
    run_nodes(lambda: [make_node()])


def check_arguments(arguments: Sequence[str]) -> None:
    """End the process on arguments that are not of ROS: with help on --help and -h, with one line
    and status 2 on others.
    """
    program, *others = remove_ros_args(list(arguments))
    if any(word in HELP for word in others):
        print(help_text(Path(program).stem))
        sys.exit(0)
    if others:
        print(
            f'segfloor: unknown argument {others[0]}; parameters are given as --ros-args -p '
            'NAME:=VALUE, and --help lists them',
            file=sys.stderr,
        )
        sys.exit(2)


def help_text(program: str) -> str:
    """Return what a node's program takes, with the parameters of the node."""
    lines = [
        f'usage: {program} [--ros-args [-p NAME:=VALUE] [--params-file FILE] [-r FROM:=TO]]',
        '',
    ]
    for node in [program] if program in NODE_SETTINGS else NODE_SETTINGS:
        lines.append(f'parameters of {node}:')
        for spec in NODE_SETTINGS[node].specs():
            unit = f' {spec.unit}' if spec.unit else ''
            lines.append(f'  {spec.name} (default {spec.default!r}{unit}): {spec.description}')
    return '\n'.join(lines)


def _share_one_heap() -> None:
    """Let all threads of this process take their memory from one heap: each of its own keeps what
    it once needed. Where there is no glibc, nothing changes.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, 1)


def _begin_ros(arguments: Sequence[str]) -> None:
    try:
        check_arguments(arguments)
        rclpy.init()
    except Exception as error:  # of several kinds, for arguments and files that rcl cannot read
        text = ' '.join(str(error).split()).partition(', at ')[0]
        raise SettingsError(f'ROS does not take the arguments: {text}') from None


def _interrupt(number: int, frame: object) -> None:
    """End the process in order. A second interrupt must not break off what the first has begun."""
    signal.signal(signal.SIGINT, _ignore)
    raise KeyboardInterrupt


def _ignore(number: int, frame: object) -> None:
    """Not SIG_IGN: rclpy gives back the handler that it found to Python."""


def run_nodes(make_nodes: Callable[[], Sequence[Node]]) -> None:
    """Run nodes in one executor, like `run_node`."""
    logging.basicConfig(format='segfloor: %(message)s', level=logging.WARNING)
    status = 0
    nodes: Sequence[Node] = ()
    signal.signal(signal.SIGINT, _interrupt)
    try:
        _share_one_heap()
        prepare_middleware()
        _begin_ros(sys.argv)
        executor = SingleThreadedExecutor()
        nodes = make_nodes()
        for node in nodes:
            executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except SegfloorError as error:
        print(f'segfloor: {error}', file=sys.stderr)
        status = 2
    except Exception:
        # An interrupt takes the middleware away under whatever is being done at that moment, and
        # may be heard of a little later than what it broke.
        with contextlib.suppress(KeyboardInterrupt):
            time.sleep(INTERRUPT_HEARD_S)
        if rclpy.ok():
            raise
    finally:
        signal.signal(signal.SIGINT, _ignore)
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
        # Python gives its own handlers up before it ends.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.exit(status)
