"""`tools.fuzz`: what it reports, and that nothing falls."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tools.fuzz import OUTCOMES, Case, chosen_cases
from tools.fuzz_damages import DAMAGES
from tools.fuzz_inputs import KINDS

REPOSITORY = Path(__file__).resolve().parents[2]


def fuzz(*words: str) -> subprocess.CompletedProcess[str]:
    """Run the tool in a process of its own: it forks."""
    command = [sys.executable, '-m', 'tools.fuzz', *words]
    return subprocess.run(
        command, capture_output=True, text=True, cwd=REPOSITORY, timeout=1500, check=False
    )


def counts(done: subprocess.CompletedProcess[str]) -> dict[str, int]:
    """Return the number of cases by outcome, from the last row of the table."""
    rows = [line for line in done.stdout.splitlines() if line.startswith('│ all')]
    cells = [cell.strip() for cell in rows[-1].split('│')[2:-3]]
    return {name: int(cell or 0) for name, cell in zip(OUTCOMES, cells, strict=True)}


def test_the_same_seed_chooses_the_same_cases():
    cases = chosen_cases(50, 3, ['mcap', 'IMU'], ['bits', 'empty'])
    assert cases == chosen_cases(50, 3, ['mcap', 'IMU'], ['bits', 'empty'])
    assert cases != chosen_cases(50, 4, ['mcap', 'IMU'], ['bits', 'empty'])
    assert len(cases) == 50
    assert {(c.kind, c.damage) for c in cases[:4]} == {
        ('mcap', 'bits'), ('mcap', 'empty'), ('IMU', 'bits'), ('IMU', 'empty'),
    }  # fmt: skip


@pytest.mark.parametrize('name', sorted(DAMAGES))
def test_a_damage_repeats(tmp_path, name):
    """The same random choices leave the same bytes, whatever the file holds."""
    left = []
    for folder in (tmp_path / 'a', tmp_path / 'b'):
        (folder / 'input').mkdir(parents=True)
        (folder / 'input' / 'other').write_bytes(b'other')
        file = folder / 'input' / 'file.yaml'
        file.write_bytes(b'a: [1, 2.5]\nb: {c: word}\n' * 3)
        DAMAGES[name](np.random.default_rng(7), file)
        left.append(file.stat().st_size if file.is_file() else None)
    assert left[0] == left[1]


@pytest.mark.slow
def test_a_damaged_file_is_refused_by_its_name():
    done = fuzz('--only', 'outlines,empty,1')
    assert done.returncode == 0, done.stdout + done.stderr
    assert counts(done)['refused'] == 1
    assert 'outlines.yaml: expected frames with outlines' in done.stdout


@pytest.mark.slow
def test_every_undamaged_input_is_taken():
    done = fuzz('--cases', str(len(KINDS)), '--damages', 'nothing')
    assert counts(done) == {name: len(KINDS) * (name == 'ok') for name in OUTCOMES}, done.stdout


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_of_three_hundred_damaged_inputs_none_falls():
    done = fuzz('--cases', '300', '--seed', '20')
    found = counts(done)
    assert done.returncode == 0, done.stdout
    assert sum(found.values()) == 300
    assert found['refused'] > 100
    assert found['ok'] > 50


def test_a_case_has_a_name():
    assert str(Case('saved map', 'bits', 3)) == 'saved map,bits,3'
