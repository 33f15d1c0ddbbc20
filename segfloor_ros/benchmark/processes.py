"""Work in a process of its own, so that its memory is not filled from what others left behind."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from segfloor_ros.errors import SegfloorError

Progress = Callable[[int], None]
"""Told how many steps are done."""


def run_apart(work: Callable[..., Any], *arguments: Any, on_progress: Progress) -> Any:
    """Return `work(*arguments, on_progress)`, done by a new process.

    work: a function of a module; its arguments and result are pickled. Its known errors are raised
    here. Raises SegfloorError when the process ends early.
    """
    context = multiprocessing.get_context('spawn')
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(sender, work, arguments), daemon=True)
    process.start()
    sender.close()
    try:
        while True:
            kind, value = receiver.recv()
            if kind == 'result':
                return value
            if kind == 'error':
                raise value
            on_progress(value)
    except EOFError:
        process.join()
        raise SegfloorError(
            f'a process of the benchmark ended early (status {process.exitcode}); '
            'if memory is short, choose smaller --sizes'
        ) from None
    finally:
        process.terminate()
        process.join()


def _serve(sender: Connection, work: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    try:
        sender.send(('result', work(*arguments, lambda done: sender.send(('progress', done)))))
    except SegfloorError as error:
        sender.send(('error', error))
