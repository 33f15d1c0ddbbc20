"""A suite's verdicts as JUnit XML, which GitHub, GitLab and Jenkins show."""

from __future__ import annotations

from pathlib import Path

from junitparser import Error, Failure, JUnitXml, Skipped, TestCase, TestSuite

from segfloor_ros.suite.bounds import Bound
from segfloor_ros.suite.verdicts import Checked, SuiteResult


def write_junit(result: SuiteResult, path: Path) -> None:
    """Write a test case for each recording's map and for each of its bounds."""
    suite = TestSuite(result.name)
    for checked in result.recordings:
        for case in _cases(result.name, checked):
            suite.add_testcase(case)
    document = JUnitXml()
    document.add_testsuite(suite)
    document.update_statistics()
    document.write(str(path), pretty=True)


def _cases(suite: str, checked: Checked) -> list[TestCase]:
    mapped = TestCase('map', f'{suite}.{checked.name}', round(checked.seconds, 3))
    if checked.problem:
        mapped.result = [Error(checked.problem)]
    cases = [mapped]
    for verdict in checked.verdicts:
        case = TestCase(_case_name(verdict.bound), f'{suite}.{checked.name}', 0.0)
        if checked.problem:
            case.result = [Skipped('there is no map')]
        elif not verdict.holds:
            case.result = [Failure(str(verdict))]
        cases.append(case)
    return cases


def _case_name(bound: Bound) -> str:
    return f'{bound.measure} against the baseline' if bound.origin else bound.measure
