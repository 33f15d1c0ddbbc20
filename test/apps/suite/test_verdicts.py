"""Bounds, baselines, JUnit and the page: worked out by hand."""

import numpy as np
import pytest
from junitparser import JUnitXml

from segfloor_ros.apps.suite.job import Outcome
from segfloor_ros.apps.suite.junit import junit
from segfloor_ros.apps.suite.measures import (
    Bound,
    Slack,
    SuiteResult,
    Verdict,
    agreement,
    bounds_of_baseline,
    check,
    measure_run,
    read_baseline,
    write_baseline,
)
from segfloor_ros.apps.suite.result_files import page
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from segfloor_ros.nodes.map_files import save_map

GOOD = {'tracked_percent': 100.0, 'path_error_m': 0.012, 'recall_percent': 93.0}


def test_measures_are_held_against_bounds():
    bounds = [
        Bound('tracked_percent', least=100),
        Bound('path_error_m', greatest=0.01),
        Bound('keyframes', 3, 9),
    ]
    verdicts = [Verdict(bound, GOOD.get(bound.measure)) for bound in bounds]
    assert [verdict.holds for verdict in verdicts] == [True, False, False]
    assert str(verdicts[1]) == 'path_error_m: 0.012 m, wanted at most 0.01 m'
    assert str(verdicts[2]) == (
        'keyframes: was not measured: no truth for it, wanted at least 3 and at most 9'
    )


def test_a_baseline_allows_what_is_better_and_little_that_is_worse():
    bounds = {bound.measure: bound for bound in bounds_of_baseline(
        {**GOOD, 'memory_peak_mb': 200.0, 'keyframes': 9.0, 'wall_s': 3.0},
        {'recall_percent': Slack(2.0), 'keyframes': Slack(1.0)},
    )}  # fmt: skip
    # The suite's slack, the measure's own, and a share of the baseline; times are not compared.
    assert bounds['recall_percent'].least == 91.0
    assert bounds['path_error_m'].greatest == pytest.approx(0.022)
    assert bounds['memory_peak_mb'].greatest == pytest.approx(240.0)
    assert (bounds['keyframes'].least, bounds['keyframes'].greatest) == (8.0, 10.0)
    assert 'wall_s' not in bounds
    assert bounds['recall_percent'].wanted == 'at least 91 % (baseline 93)'


def result() -> SuiteResult:
    bounds = (Bound('tracked_percent', least=99), Bound('path_error_m', greatest=0.01))
    good = check(Outcome('good', GOOD, seconds=2.5), bounds[:1])
    bad = check(Outcome('bad', GOOD), bounds)
    lost = check(Outcome('lost', {}, 'no map <came>'), bounds)
    return SuiteResult('nightly', [good, bad, lost])


def test_junit_has_a_case_for_each_map_and_each_bound(tmp_path):
    (tmp_path / 'junit.xml').write_bytes(junit(result()))
    document = JUnitXml.fromfile(str(tmp_path / 'junit.xml'))
    assert (document.tests, document.failures, document.errors, document.skipped) == (8, 1, 1, 2)
    (suite,) = document
    assert suite.name == 'nightly'
    cases = {(case.classname, case.name): case for case in suite}
    assert cases['nightly.good', 'map'].time == 2.5
    assert cases['nightly.good', 'tracked_percent'].is_passed
    (failure,) = cases['nightly.bad', 'path_error_m'].result
    assert failure.message == 'path_error_m: 0.012 m, wanted at most 0.01 m'
    (error,) = cases['nightly.lost', 'map'].result
    assert error.message == 'no map <came>'


def test_the_page_says_what_fails_and_links_the_reports(tmp_path):
    (tmp_path / 'good').mkdir()
    (tmp_path / 'good' / 'report.html').write_text('x')
    text = page(result(), tmp_path).decode()
    assert '1 of 3 recordings' in text
    assert '<a href="good/report.html">good</a>' in text
    assert 'bad/report.html' not in text
    assert 'no map &lt;came&gt;' in text
    assert '<span class="bad">0.012</span>' in text


def test_a_baseline_survives_the_round_trip(tmp_path):
    path = tmp_path / 'new' / 'baseline.json'
    write_baseline(result(), path)
    assert read_baseline(path) == {'good': GOOD, 'bad': GOOD}
    worse = Outcome('good', {**GOOD, 'recall_percent': 91.5})
    checked = check(worse, bounds_of_baseline(read_baseline(path)['good'], {}))
    assert checked.complaints == [
        'good: recall_percent: 91.5 %, wanted at least 92 % (baseline 93)'
    ]
    path.write_text('[]')
    with pytest.raises(InputError, match='not a baseline'):
        read_baseline(path)


def test_agreement_is_that_of_the_cells_known_in_both():
    def grid(rows, origin=(0.0, 0.0)):
        cells = {'.': FREE, '#': OCCUPIED, '?': UNKNOWN}
        return OccupancyGrid(
            np.array([[cells[c] for c in row] for row in rows], np.int8), 0.5, origin
        )

    reference = grid(['..#', '?.#'])
    assert agreement(reference, reference) == 1.0
    # The same place, a column cut off on the left: four cells are known in both, three are alike.
    assert agreement(grid(['.#', '##'], (0.5, 0.0)), reference) == 0.75
    assert np.isnan(agreement(grid(['?']), reference))


def test_a_map_from_elsewhere_is_measured_by_itself(tmp_path):
    cells = np.full((20, 30), FREE, np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = OCCUPIED
    save_map(OccupancyGrid(cells, 0.1, (-1.0, -1.0)), tmp_path / 'map.yaml')
    measured = measure_run(tmp_path, tmp_path / 'map.yaml', tmp_path / 'map.yaml')
    assert measured['known_area_m2'] == pytest.approx(6.0)
    assert measured['agreement_percent'] == 100.0
    assert measured['precision_percent'] == measured['recall_percent'] == 100.0
    assert 'tracked_percent' not in measured
