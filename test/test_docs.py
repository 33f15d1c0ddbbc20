"""The handwritten pages name what there is."""

import dataclasses
import json
import os
import re
import subprocess
import sys
import typing
from pathlib import Path

import pytest
import yaml

from segfloor_ros import __version__
from segfloor_ros.apps.simulation import scene as scene_module
from segfloor_ros.apps.simulation.scene import Scene
from segfloor_ros.apps.simulation.scene_file import scene_from_mapping, shipped
from segfloor_ros.apps.simulation.textures import GENERATORS
from segfloor_ros.nodes.configuration import NODE_SETTINGS, STAGE_SETTINGS, resolve
from tools import figures

DOCS = Path(__file__).resolve().parents[1] / 'docs'
PAGES = [DOCS.parent / 'README.md', DOCS.parent / 'CONTRIBUTING.md', *sorted(DOCS.rglob('*.md'))]
SIMULATION = (DOCS / 'simulation.md').read_text()


def fields_of(kind: type) -> dict[str, set[str]]:
    """Return the names of a description's entries and, below each, those of its parts."""
    found = {}
    for name, hint in typing.get_type_hints(kind, vars(scene_module)).items():
        inner = next(
            (k for k in (hint, *typing.get_args(hint)) if dataclasses.is_dataclass(k)), None
        )
        found[name] = {f.name for f in dataclasses.fields(inner)} if inner else set()
    return found


def table_rows(text: str) -> list[set[str]]:
    """Return the names in code style of every table row."""
    lines = [line for line in text.splitlines() if line.startswith('|')]
    return [set(re.findall(r'`([a-z0-9_]+)`', line)) for line in lines]


def test_the_simulation_page_lists_the_shipped_scenes() -> None:
    assert {frozenset({name}) for name in shipped()} <= {
        frozenset(row) for row in table_rows(SIMULATION)
    }


@pytest.mark.parametrize('entry', sorted(fields_of(Scene)))
def test_the_simulation_page_explains_every_entry_of_a_scene(entry) -> None:
    rows = [row for row in table_rows(SIMULATION) if entry in row]
    parts = fields_of(Scene)[entry]
    assert any(parts <= row for row in rows), parts


def test_the_simulation_page_names_the_textures() -> None:
    words = SIMULATION.partition('Textures: `')[2].partition('`')[0].split()
    assert words == list(GENERATORS)


def test_the_page_names_no_entry_that_does_not_exist() -> None:
    known = set().union(fields_of(Scene), *fields_of(Scene).values())
    nested = (
        scene_module.Vibration,
        scene_module.Wheels,
        scene_module.Imu,
        scene_module.DepthSensor,
    )
    known |= {field.name for kind in nested for field in dataclasses.fields(kind)}
    table = SIMULATION.partition('| entry | holds |')[2]
    assert set().union(*table_rows(table)) <= known


def test_the_scene_of_the_page_can_be_opened() -> None:
    values = yaml.safe_load(SIMULATION.partition('```yaml\n')[2].partition('```')[0])
    assert values.pop('like') in shipped()
    scene = scene_from_mapping(values, 'docs')
    assert scene.boxes[0].size == (0.6, 0.4, 0.3)


@pytest.mark.parametrize('page', PAGES, ids=lambda path: str(path.relative_to(DOCS.parent)))
def test_what_a_page_links_to_is_there(page) -> None:
    links = re.findall(r'\]\((?!https?:|#)([^)#]+)', page.read_text())
    assert [link for link in links if not (page.parent / link).exists()] == []


@pytest.mark.parametrize('page', PAGES, ids=lambda path: str(path.relative_to(DOCS.parent)))
def test_the_heading_that_a_page_links_to_is_there(page) -> None:
    links = re.findall(r'\]\((?!https?:)([^)#]*\.md|)#([^)]+)\)', page.read_text())
    missing = [
        (name, anchor)
        for name, anchor in links
        if anchor not in anchors((page.parent / name) if name else page)
    ]
    assert missing == []


def anchors(page) -> set[str]:
    """Return the names that headings of a page have in links."""
    headings = re.findall(r'^#+ (.*)$', page.read_text(), re.MULTILINE)
    plain = (re.sub(r'\[([^]]*)\]\([^)]*\)', r'\1', heading).lower() for heading in headings)
    return {re.sub(r'[^\w -]', '', heading).replace(' ', '-') for heading in plain}


def test_the_lifecycle_manager_of_the_page_manages_nodes_that_there_are() -> None:
    page = (DOCS / 'robot.md').read_text()
    manager = yaml.safe_load(page.partition('```yaml\n')[2].partition('```')[0])
    names = manager['lifecycle_manager_segfloor']['ros__parameters']['node_names']
    assert names == list(STAGE_SETTINGS)[1:]


def test_the_parameters_of_the_page_exist() -> None:
    known = {spec.name for settings in (*STAGE_SETTINGS.values(), *NODE_SETTINGS.values())
             for spec in settings.specs()}  # fmt: skip
    named = {'publish_period_s', 'max_waiting_frames', 'lossless', 'publish_odom_tf', 'map_frame',
             'odom_frame', 'base_frame', 'left_frame', 'right_frame', 'autostart'}  # fmt: skip
    page = (DOCS / 'robot.md').read_text()
    assert all(name in page for name in named)
    assert named <= known


BASIC = DOCS.parent / 'params' / 'basic.yaml'


def test_the_basic_settings_are_few_have_their_defaults_and_are_those_of_the_page() -> None:
    resolved = resolve(BASIC, ())
    known = resolve(None, ()).as_ros_parameters()
    assert str(resolved.as_ros_parameters()) == str(known)
    sections = {
        name.removeprefix('/**').removeprefix('/'): set(section['ros__parameters'])
        for name, section in yaml.safe_load(BASIC.read_text()).items()
    }
    of_all = sections.pop('')
    for node, names in sections.items():
        specs = (*STAGE_SETTINGS[node].specs(), *NODE_SETTINGS[node].specs())
        assert names <= {spec.name for spec in specs}
        assert len(names | of_all & {spec.name for spec in specs}) <= 12
    rows = table_rows((DOCS / 'settings.md').read_text())
    assert set().union(*rows) - STAGE_SETTINGS.keys() == set().union(of_all, *sections.values())


def test_a_user_can_read_the_pages_in_an_hour_and_a_half() -> None:
    assert sum(len(page.read_text().split()) for page in DOCS.glob('*.md')) <= 20_000


def test_each_camera_has_a_picture_and_a_launch_line() -> None:
    page = (DOCS / 'cameras.md').read_text()
    launch = (DOCS.parent / 'launch_configs' / 'segfloor.launch.py').read_text()
    cameras = launch.partition('CAMERAS = {')[2].partition('\n}\n')[0]
    known = set(re.findall(r"^    '(\w+)': {$", cameras, re.MULTILINE))
    assert set(re.findall(r'camera:=(\w+)', page)) == known
    with_depth = {f'camera_{name}.yaml' for name in known if name.endswith('_depth')}
    assert with_depth <= set(re.findall(r'\]\(\.\./params/([\w.]+)\)', page))
    for section in page.split('\n## ')[1:]:
        is_other = section.startswith('Any other')
        assert '```sh\n' in section and ('](images/cameras/' in section or is_other), section


@pytest.mark.parametrize('page', figures.PAGES, ids=lambda path: path.name)
def test_the_tables_of_the_pages_hold_the_figures_that_were_measured(page) -> None:
    text = page.read_text()
    assert figures.written(text) == text
    assert 'python -m tools.figures write' in text


def test_the_site_is_built_without_a_warning_and_has_every_page(tmp_path) -> None:
    pytest.importorskip('material', reason='mkdocs-material is not installed')
    words = [sys.executable, '-m', 'mkdocs', 'build', '--strict', '-q', '-d', str(tmp_path)]
    built = subprocess.run(words, cwd=DOCS.parent, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    pages = {path.relative_to(DOCS).with_suffix('.html') for path in DOCS.rglob('*.md')}
    renamed = {path.parent / 'index.html' if path.stem == 'README' else path for path in pages}
    assert renamed <= {path.relative_to(tmp_path) for path in tmp_path.rglob('*.html')}
    home = (tmp_path / 'index.html').read_text()
    assert 'images/demo.gif' in home
    assert 'site.css' in home
    assert (tmp_path / 'images' / 'demo.gif').stat().st_size < 3e6


@pytest.mark.slow
def test_the_workflow_publishes_each_version_of_the_site(tmp_path) -> None:
    pytest.importorskip('mike', reason='mike is not installed')
    source, origin, clone = DOCS.parent, tmp_path / 'origin', tmp_path / 'clone'
    if not (source / '.git').exists():
        pytest.skip('no git repository')
    subprocess.run(['git', 'clone', '-q', '--bare', source, origin], check=True)
    subprocess.run(['git', 'clone', '-q', origin, clone], check=True)
    job = yaml.safe_load((source / '.github' / 'workflows' / 'docs.yml').read_text())
    steps = [step for step in job['jobs']['publish']['steps'] if 'run' in step]
    programs = f'{Path(sys.executable).parent}:{os.environ["PATH"]}'
    for kind, name in (('branch', 'main'), ('tag', 'v9.8.7')):
        for step in steps:
            if 'pip install' in step['run'] or kind not in step.get('if', kind):
                continue
            environment = {**os.environ, 'GITHUB_REF_NAME': name, 'PATH': programs}
            command = ['bash', '-ec', step['run']]
            subprocess.run(command, cwd=clone, env=environment, check=True, capture_output=True)
    shown = ['git', 'show', 'gh-pages:versions.json']
    versions = json.loads(subprocess.run(shown, cwd=origin, capture_output=True, check=True).stdout)
    assert [(one['version'], one['aliases']) for one in versions] == [
        ('dev', []), ('9.8.7', ['latest'])
    ]  # fmt: skip


def test_how_to_cite_names_the_version() -> None:
    said = yaml.safe_load((DOCS.parent / 'CITATION.cff').read_text())
    assert said['version'] == __version__
