"""A suite's results on one page, with links to the report of each recording, and as JUnit XML.

The latter keeps to both schemas in use: that of Ant's JUnit task and the looser one of Jenkins's
xUnit plugin.
"""

from __future__ import annotations

import base64
import datetime
import html
import io
import socket
from pathlib import Path

import cv2
import numpy as np
from junitparser import Attr, Error, Failure, IntAttr, JUnitXml, Skipped, TestCase, TestSuite
from junitparser.junitparser import SystemErr, SystemOut

from segfloor_ros import __version__
from segfloor_ros.errors import InputError, printable
from segfloor_ros.evaluation.report import REPORT_NAME, html_page
from segfloor_ros.files.images import read_mask
from segfloor_ros.grid.map_file import UNKNOWN_PIXEL
from segfloor_ros.suite.measures import MEASURES, Bound, Checked, SuiteResult, number

COLUMNS = ('tracked_percent', 'path_error_m', 'precision_percent', 'recall_percent',
           'known_area_m2', 'time_ratio', 'memory_peak_mb')  # fmt: skip
THUMBNAIL_PX = 110
MARKS = """
td { vertical-align: middle; } td:first-child a { font-weight: 600; }
.ok { color: #1b7f3b; } .bad { color: #b3261e; } ul { margin: 0; padding-left: 18px; }
img { image-rendering: pixelated; border: 1px solid #e1e6ec; }
"""


def page(result: SuiteResult, folder: Path) -> bytes:
    """Return the page of a suite's folder, which holds a folder for each recording."""
    kept = sum(checked.holds for checked in result.recordings)
    names = ('recording', 'map', '', *COLUMNS)
    head = ''.join(f'<th>{_heading(name)}</th>' for name in names)
    rows = ''.join(_row(checked, folder) for checked in result.recordings)
    failed = ''.join(
        f'<li class="bad">{html.escape(printable(complaint))}</li>'
        for checked in result.recordings
        for complaint in checked.complaints
    )
    complaints = f'<h2>What fails</h2><ul>{failed}</ul>' if failed else ''
    about = f'{kept} of {len(result.recordings)} recordings are as they should be'
    table = f'<h2>Recordings</h2><table><tr>{head}</tr>{rows}</table>'
    return html_page(printable(result.name), about, complaints + table, MARKS).encode()


def _row(checked: Checked, folder: Path) -> str:
    name = html.escape(checked.name)
    link = f'{checked.name}/{REPORT_NAME}'
    has_map = not checked.problem  # what is there of an earlier check is not of this one
    if has_map and (folder / link).is_file():
        name = f'<a href="{html.escape(link)}">{name}</a>'
    failing = {v.bound.measure for v in checked.verdicts if not v.holds}
    state = f'<span class="{"ok" if checked.holds else "bad"}">{checked.state}</span>'
    picture = _thumbnail(folder / checked.name / 'map.pgm') if has_map else ''
    cells = [name, picture, state]
    for measure in COLUMNS:
        value = checked.measured.get(measure)
        text = '' if value is None else number(value)
        cells.append(f'<span class="bad">{text}</span>' if measure in failing else text)
    return '<tr>' + ''.join(f'<td>{cell}</td>' for cell in cells) + '</tr>'


def _heading(name: str) -> str:
    if name not in MEASURES:
        return name
    unit = MEASURES[name].unit
    words = name.removesuffix('_percent').removesuffix('_m2').removesuffix('_mb').removesuffix('_m')
    return html.escape(words.replace('_', ' ') + (f' {unit}' if unit else ''))


def _thumbnail(path: Path) -> str:
    """Return a small picture of what is known in a map, '' where there is none."""
    try:
        image = read_mask(path)
    except InputError:
        return ''
    left, top, width, height = cv2.boundingRect((image != UNKNOWN_PIXEL).astype(np.uint8))
    image = image[top : top + height, left : left + width] if width and height else image
    scale = THUMBNAIL_PX / max(image.shape)
    size = np.maximum(1, np.rint(scale * np.array(image.shape[::-1]))).astype(int)
    small = cv2.resize(image, (int(size[0]), int(size[1])), interpolation=cv2.INTER_AREA)
    data = base64.b64encode(bytes(cv2.imencode('.png', small)[1])).decode()
    return f'<img alt="map" src="data:image/png;base64,{data}">'


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
