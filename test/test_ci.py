"""The project's own CI, and the files that docs/ci.md gives to copy."""

import ast
import importlib
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from segfloor_ros.apps.suite.description import read_suite
from segfloor_ros.apps.suite.measures import MEASURES

REPOSITORY = Path(__file__).resolve().parents[1]
PAGE = (REPOSITORY / 'docs' / 'ci.md').read_text()
SCRIPTS = sorted(p for p in (REPOSITORY / '.ci').iterdir() if not p.suffix)


WORKFLOWS = REPOSITORY / '.github' / 'workflows'


def steps_of(workflow: str) -> list[dict[str, Any]]:
    jobs = yaml.safe_load((WORKFLOWS / f'{workflow}.yml').read_text())['jobs'].values()
    return [step for job in jobs for step in job['steps']]


@pytest.mark.parametrize('workflow', ['pip', 'ros', 'release'])
def test_workflows_call_scripts_that_there_are(workflow) -> None:
    words = ' '.join(step.get('run', '') for step in steps_of(workflow))
    called = re.findall(r'\.ci/([\w-]+)', words)
    assert called
    assert set(called) <= {script.name for script in SCRIPTS}


@pytest.mark.parametrize('form', sorted(WORKFLOWS.parent.glob('ISSUE_TEMPLATE/*.yml')))
def test_the_forms_of_issues_ask_for_what_there_is(form) -> None:
    asked = yaml.safe_load(form.read_text())
    assert asked['name'] and asked['description']
    fields = [field for field in asked['body'] if field['type'] != 'markdown']
    assert len({field['id'] for field in fields}) == len(fields) >= 2
    assert all(field['attributes']['label'] for field in fields)
    named = re.findall(r'docs/[\w./]+\.md', form.read_text())
    assert all((REPOSITORY / page).is_file() for page in named)


def test_what_is_published_is_what_was_built_and_tried_and_no_token_is_kept() -> None:
    text = (WORKFLOWS / 'release.yml').read_text()
    build, publish = yaml.safe_load(text)['jobs'].values()
    assert publish['needs'] == 'build' and publish['permissions'] == {'id-token': 'write'}
    uploaded, downloaded = build['steps'][-1]['with'], publish['steps'][0]['with']
    assert uploaded == downloaded
    assert 'secrets.' not in text


def test_the_slow_tests_run_every_night() -> None:
    workflow = yaml.safe_load((WORKFLOWS / 'nightly.yml').read_text())
    assert workflow[True]['schedule'][0]['cron'].endswith('* * *')  # YAML reads `on` as true
    assert any('make test-slow' in step.get('run', '') for step in steps_of('nightly'))


def test_both_containers_are_built() -> None:
    jobs = yaml.safe_load((WORKFLOWS / 'containers.yml').read_text())['jobs']
    built = {one['file'] for one in jobs['build']['strategy']['matrix']['include']}
    assert built == {path.name for path in (REPOSITORY / 'docker').glob('*Dockerfile')}


@pytest.mark.parametrize('script', SCRIPTS, ids=lambda path: path.name)
def test_scripts_can_be_run(script) -> None:
    assert script.stat().st_mode & 0o111
    shell = script.read_text().splitlines()[0].removeprefix('#!')
    assert subprocess.run([shell, '-n', script]).returncode == 0


def test_the_launch_test_can_be_read() -> None:
    module = ast.parse((REPOSITORY / '.ci' / 'bag_test.launch.py').read_text())
    names = [node.name for node in module.body if isinstance(node, ast.FunctionDef)]
    assert 'generate_test_description' in names
    ours = [
        node
        for node in module.body
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith('segfloor_ros')
    ]
    assert ours
    for node in ours:
        there = importlib.import_module(str(node.module))
        assert all(hasattr(there, alias.name) for alias in node.names), node.module


def test_the_suite_of_the_demo_can_be_read() -> None:
    suite = read_suite(REPOSITORY / '.ci' / 'demo.yaml')
    assert [entry.mode for entry in suite.entries] == ['run', 'replay']


def test_the_files_of_the_page_can_be_copied(tmp_path) -> None:
    suite, github, gitlab = re.findall(r'```yaml\n(.*?)```', PAGE, re.DOTALL)
    for name in ('bags/warehouse.mcap', 'bags/night-1', 'bags/night-2', 'drives/aisle'):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / 'maps').mkdir()
    (tmp_path / 'maps' / 'warehouse.yaml').touch()
    (tmp_path / 'suite.yaml').write_text(suite)
    names = [entry.name for entry in read_suite(tmp_path / 'suite.yaml').entries]
    assert names == ['warehouse', 'night-1', 'night-2', 'aisle', 'corridor2-7']
    assert 'segfloor check' in yaml.safe_load(github)['jobs']['bags']['steps'][4]['run']
    assert yaml.safe_load(gitlab)['bags']['artifacts']['reports'] == {'junit': 'results/junit.xml'}


def test_the_page_lists_every_measure() -> None:
    rows = re.findall(r'^\| `(\w+)` \|', PAGE, re.MULTILINE)
    assert rows == list(MEASURES)
