"""`segfloor check`: many recordings against bounds."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Generator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table
from rich.text import Text

from segfloor_ros.apps.cli.printing import console, print_error
from segfloor_ros.apps.cli.terminal import (
    Json,
    View,
    figure_table,
    json_alone,
    number_option,
    print_json,
)
from segfloor_ros.apps.cli.view import open_view, read_results, show_results
from segfloor_ros.apps.results_folder import OUTPUT_NAMES
from segfloor_ros.apps.suite.description import Suite, read_suite
from segfloor_ros.apps.suite.job import LOG, SAVED_MAP, Job, Outcome, outcomes, package_digest
from segfloor_ros.apps.suite.measures import (
    BASELINE,
    Baseline,
    Checked,
    SuiteResult,
    bounds_of_baseline,
    check,
    known_measures,
    number,
    read_baseline,
    write_baseline,
)
from segfloor_ros.apps.suite.result_files import MEASURED, pack, unpack
from segfloor_ros.core.errors import InputError, SettingsError, os_errors
from segfloor_ros.core.files.whole import read_json, read_text
from segfloor_ros.core.files.writing import (
    add_files,
    check_output,
    check_target,
    folder_in_the_making,
)
from segfloor_ros.core.geometry import Pose2d

COLUMNS = {
    'tracked_percent': 'tracked %',
    'path_error_m': 'error m',
    'precision_percent': 'prec. %',
    'recall_percent': 'recall %',
    'time_ratio': 'time',
}
LENGTHS = {'length_m': 'length m', 'true_length_m': 'true m'}
JUNIT, PAGE, FAILED = 'junit.xml', 'suite.html', 'failed.txt'
FILES = (*OUTPUT_NAMES, MEASURED, LOG, SAVED_MAP, FAILED)
"""In the folder of a recording."""


def check_suite(
    suite: Annotated[Path, typer.Argument(metavar='SUITE.yaml', help='Recordings and bounds.')],
    out: Annotated[Path, typer.Option('--out', help='Folder for the results.')],
    data: Annotated[
        Path | None,
        typer.Option(help='Folder of the recordings, of which those that are there are mapped.'),
    ] = None,
    jobs: Annotated[
        int, number_option('Recordings at a time, each in a process of this machine.', 1)
    ] = 1,
    scheduler: Annotated[
        str, typer.Option(help='Address of a Dask scheduler whose workers map the recordings.')
    ] = '',
    resume: Annotated[
        bool, typer.Option('--resume', help='Keep what an interrupted check has left in --out.')
    ] = False,
    baseline: Annotated[
        Path | None,
        typer.Option(help='Nothing may be worse than in this file by more than no_worse_by.'),
    ] = None,
    baseline_to_write: Annotated[
        Path | None,
        typer.Option('--write-baseline', help='Write the measures for a later --baseline.'),
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option(
            help='Folder for results, renderings and copies to use again; else ~/.cache/segfloor.'
        ),
    ] = None,
    no_cache: Annotated[
        bool, typer.Option('--no-cache', help='Map every recording, whatever the cache has.')
    ] = False,
    view: View = None,
    as_json: Json = False,
) -> None:
    """Map recordings and hold the results against bounds. Status 1: a bound failed.

    \b
    segfloor check suite.yaml --out checked --jobs 4
    segfloor check suites/euroc.yaml --data ~/euroc --out checked
    """
    # Imported here: without junitparser nothing is mapped.
    import segfloor_ros.apps.suite.junit  # noqa: F401

    described = read_suite(suite, data)
    for name in described.missing:
        print_error(f'{name}: is not in {data}, skipped')
    known = read_baseline(baseline) if baseline is not None else None
    _check_out(out, described)
    if baseline_to_write is not None:
        check_output(baseline_to_write, BASELINE, [baseline, suite], '--write-baseline')
    folder = (cache or _default_cache()).absolute()
    todo = _jobs(described, folder, not no_cache)
    found: dict[str, Checked] = {}
    with (
        json_alone(as_json),
        folder_in_the_making(out),
        open_view(view) as shown,
        contextlib.closing(_all_outcomes(todo, out, resume, jobs, scheduler)) as results,
    ):
        for job, outcome in results:
            bounds = list(job.entry.bounds)
            if known is not None:
                bounds += bounds_of_baseline(known.get(outcome.name, {}), job.entry.slacks)
            checked = check(outcome, bounds)
            found[checked.name] = checked
            _print_progress(checked, len(found), len(todo))
            if shown is not None and not outcome.problem:
                show_results(shown, read_results(out / outcome.name), outcome.name)
        result = SuiteResult(described.name, [found[entry.name] for entry in described.entries])
        _finish(result, out, described, known)
    if baseline_to_write is not None:
        write_baseline(result, baseline_to_write)
        with json_alone(as_json):
            console.print(f'baseline: {baseline_to_write}', soft_wrap=True)
    if as_json:
        print_json(_as_document(result))
    if not result.holds:
        raise typer.Exit(1)


def _as_document(result: SuiteResult) -> dict[str, Any]:
    recordings = [
        {'name': one.name, 'state': one.state, 'measured': one.measured, 'wrong': one.complaints}
        for one in result.recordings
    ]
    return {'name': result.name, 'holds': result.holds, 'recordings': recordings}


def _check_out(out: Path, suite: Suite) -> None:
    """Raise InputError unless all results can be written to a folder."""
    named = [(entry.input, entry.truth, entry.reference_map) for entry in suite.entries]
    check_target(out, (JUNIT, PAGE), [path for paths in named for path in paths])
    for entry in suite.entries:
        check_target(out / entry.name, FILES)


def _jobs(suite: Suite, cache: Path, reuse: bool) -> list[Job]:
    continued = {entry.continue_from for entry in suite.entries}
    jobs: dict[str, Job] = {}
    for entry in suite.entries:
        params = read_text(Path(entry.params)) if entry.params else ''
        origin = jobs[entry.continue_from].digest() if entry.continue_from else ''
        jobs[entry.name] = Job(entry, params, str(cache), reuse, entry.name in continued, origin)
    return list(jobs.values())


def _all_outcomes(
    todo: list[Job], out: Path, resume: bool, processes: int, scheduler: str
) -> Generator[tuple[Job, Outcome]]:
    """Yield jobs with what came of them; what is in `out` already comes first."""
    by_name = {job.entry.name: job for job in todo}
    read = (_read_outcome(job, out) for job in todo if resume)
    kept = {outcome.name: outcome for outcome in read if outcome is not None}
    yield from ((by_name[name], outcome) for name, outcome in kept.items())
    left = [job for job in todo if job.entry.name not in kept]
    with contextlib.closing(outcomes(left, kept, processes, scheduler)) as results:
        for outcome in results:
            _write(by_name[outcome.name], outcome, out)
            yield by_name[outcome.name], outcome


def _write(job: Job, outcome: Outcome, out: Path) -> None:
    if outcome.package not in ('', package_digest()):
        raise SettingsError(
            f'worker {outcome.worker} has another version of segfloor_ros than this machine; '
            'install the same on all'
        )
    folder = out / outcome.name
    with os_errors(f'{folder}: cannot be written'):
        if outcome.problem:
            # What is there of last time stays.
            add_files(folder, {FAILED: f'{outcome.problem}\n'.encode()})
            return
        record = {
            'job': job.digest(),
            'seconds': outcome.seconds,
            'start_pose': outcome.start_pose,
            'measured': outcome.measured,
        }
        measured = (json.dumps(record, indent=2) + '\n').encode()
        unpack(outcome.archive, folder, {MEASURED: measured})


def _read_outcome(job: Job, out: Path) -> Outcome | None:
    """Return what an earlier check found, None where it did not or with other parameters."""
    folder = out / job.entry.name
    try:
        record = read_json(folder / MEASURED, 'what a check has measured')
        if (folder / FAILED).exists() or record['job'] != job.digest():
            return None
        return Outcome(
            job.entry.name,
            known_measures(record['measured']),
            archive=pack(folder) if job.is_continued else b'',
            start_pose=_pose(record['start_pose']),
            seconds=float(record['seconds']),
            reused=True,
        )
    except (InputError, OSError, ValueError, LookupError, TypeError, AttributeError):
        return None


def _pose(values: Any) -> Pose2d | None:
    if values is None:
        return None
    x, y, yaw = (float(value) for value in values)
    return x, y, yaw


def _finish(result: SuiteResult, out: Path, described: Suite, baseline: Baseline | None) -> None:
    """Print the table and what fails, and write the files of the suite."""
    # Imported here: Matplotlib takes a second that other commands should not wait for.
    from segfloor_ros.apps.suite.junit import junit
    from segfloor_ros.apps.suite.result_files import page

    console.print(_table(result, described))
    for checked in result.recordings:
        for complaint in checked.complaints:
            print_error(complaint)
    if baseline is not None:
        for name in [e.name for e in described.entries if e.name not in baseline]:
            print_error(f"{name}: is not in the baseline, so only the suite's own bounds hold")
    with os_errors(f'{out}: cannot be written'):
        add_files(out, {JUNIT: junit(result), PAGE: page(result, out)})
    console.print(f'junit: {out / JUNIT}', soft_wrap=True)
    console.print(f'page: {out / PAGE}', soft_wrap=True)


def _print_progress(checked: Checked, done: int, total: int) -> None:
    origin = 'kept' if checked.reused else f'{checked.seconds:.0f} s'
    console.print(f'{done}/{total} {checked.name}: {checked.state} ({origin})')


def _table(result: SuiteResult, described: Suite) -> Table:
    methods = list(described.published)
    is_length = described.published_measure == 'length_m'
    columns = {**COLUMNS, **LENGTHS} if is_length else COLUMNS
    table = figure_table('recording', 'result', *columns.values(), *methods)
    if methods:
        sources = (f'{method}: {source}' for method, source in described.published.items())
        table.caption = f'{"length" if is_length else "error"} m of ' + '; '.join(sources)
    for entry, checked in zip(described.entries, result.recordings, strict=True):
        state = Text(checked.state, 'green' if checked.holds else 'red')
        values = [checked.measured.get(name) for name in columns]
        values += [entry.published.get(method) for method in methods]
        cells = ('' if value is None else number(value) for value in values)
        table.add_row(checked.name, state, *cells)
    return table


def _default_cache() -> Path:
    home = os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache'
    return Path(home) / 'segfloor'
