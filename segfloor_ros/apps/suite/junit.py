"""Verdicts as JUnit XML, for the services that show test results.

It keeps to both schemas in use: that of Ant's JUnit task and the looser one of Jenkins's xUnit
plugin.
"""

from __future__ import annotations

import datetime
import io
import socket

from junitparser import Attr, Error, Failure, IntAttr, JUnitXml, Skipped, TestCase, TestSuite
from junitparser.junitparser import SystemErr, SystemOut

from segfloor_ros import __version__
from segfloor_ros.apps.suite.measures import Bound, Checked, SuiteResult
from segfloor_ros.core.errors import printable


class _Suite(TestSuite):
    """A suite among others, as Ant's schema wants it."""

    id = IntAttr()
    package = Attr()


def junit(result: SuiteResult) -> bytes:
    """Return a test case for each recording's map and for each of its bounds, as XML."""
    suite = _Suite(printable(result.name))
    suite.id, suite.package = 0, 'segfloor'
    suite.hostname = socket.gethostname()
    now = datetime.datetime.now(tz=datetime.timezone.utc)
    suite.timestamp = now.strftime('%Y-%m-%dT%H:%M:%S')
    suite.add_property('segfloor_ros', __version__)
    suite.add_testcases([case for c in result.recordings for case in _cases(suite.name, c)])
    complaints = [
        line for checked in result.recordings for line in map(printable, checked.complaints)
    ]
    for element, text in ((SystemOut(), ''), (SystemErr(), '\n'.join(complaints))):
        element.text = text
        suite.append(element)
    document = JUnitXml()
    document.append(suite)
    written = io.BytesIO()
    document.write(written, pretty=True)
    return written.getvalue()


def _cases(suite: str, checked: Checked) -> list[TestCase]:
    mapped = TestCase('map', f'{suite}.{checked.name}', round(checked.seconds, 3))
    if checked.problem:
        mapped.result = [Error(printable(checked.problem), 'no map')]
    cases = [mapped]
    for verdict in checked.verdicts:
        case = TestCase(_case_name(verdict.bound), f'{suite}.{checked.name}', 0.0)
        if checked.problem:
            case.result = [Skipped('there is no map')]
        elif not verdict.holds:
            case.result = [Failure(str(verdict), 'bound')]
        cases.append(case)
    return cases


def _case_name(bound: Bound) -> str:
    return f'{bound.measure} against the baseline' if bound.origin else bound.measure
