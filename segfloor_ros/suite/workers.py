"""Who does the jobs of a suite: this process, processes of this machine, or a Dask cluster."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from typing import Any

from segfloor_ros.errors import SettingsError
from segfloor_ros.suite.job import Job, Outcome, do_job

CONNECT_S = 10


def outcomes(
    jobs: list[Job], kept: Mapping[str, Outcome], processes: int = 1, scheduler: str = ''
) -> Iterator[Outcome]:
    """Yield what comes of the jobs, as they finish. A job that continues a map comes after the one
    that makes it. kept: outcomes by name of jobs that were done before. scheduler: address of a
    Dask scheduler, whose workers do the jobs; else so many processes of this machine. Raises
    SettingsError.
    """
    if scheduler or processes > 1:
        with _client(processes, scheduler) as client:
            yield from _distributed(client, jobs, kept)
        return
    done = dict(kept)
    for job in jobs:
        done[job.entry.name] = do_job(job, done.get(job.entry.continue_from))
        yield done[job.entry.name]


def _distributed(client: Any, jobs: list[Job], kept: Mapping[str, Outcome]) -> Iterator[Outcome]:
    """A worker that dies has its job done again by another one (Dask sees to that, a few times)."""
    from distributed import as_completed

    futures: dict[str, Any] = {}
    for job in jobs:
        origin = job.entry.continue_from
        futures[job.entry.name] = client.submit(
            do_job, job, futures.get(origin, kept.get(origin)), pure=False
        )
    names = {future.key: name for name, future in futures.items()}
    finished = as_completed(list(futures.values()))
    futures.clear()
    for future in finished:
        if future.status == 'finished':
            outcome = future.result()
        else:
            outcome = Outcome(names[future.key], {}, problem=f'{future.exception()}')
        # The cluster need not keep what is here now, unless a job that waits needs it.
        future.release()
        yield outcome


@contextlib.contextmanager
def _client(processes: int, scheduler: str) -> Iterator[Any]:
    # Read when Dask is imported, here and in the workers: what matters is in the outcomes.
    os.environ.setdefault('DASK_LOGGING__DISTRIBUTED', 'critical')
    try:
        import distributed
    except ImportError:
        raise SettingsError(
            "--jobs and --scheduler need Dask: pip install 'segfloor_ros[cluster]'"
        ) from None
    with contextlib.ExitStack() as stack:
        address: Any = scheduler
        if not scheduler:
            address = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=processes,
                    threads_per_worker=1,
                    memory_limit=0,
                    dashboard_address='127.0.0.1:0',
                )
            )
        try:
            client = distributed.Client(address, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise SettingsError(f'--scheduler {scheduler}: cannot be reached ({error})') from None
        yield stack.enter_context(client)
