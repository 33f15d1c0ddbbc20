"""The package as colcon and pip see it: description, and a real build in a scratch workspace."""

from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from segfloor_ros import __version__
from segfloor_ros.apps.cli.main import EXTRAS

REPOSITORY = Path(__file__).resolve().parents[1]
NODES = ('stereo_camera', 'stereo_slam', 'floor_segmentation', 'cloud_labelling', 'occupancy_grid')
IMPORT_OF_KEY = {'python3-numpy': 'numpy', 'python3-opencv': 'cv2', 'python3-scipy': 'scipy',
                 'python3-yaml': 'yaml', 'python3-typer': 'typer', 'python3-rich': 'rich',
                 'python3-matplotlib': 'matplotlib'}  # fmt: skip
OF_EXTRAS = {
    'evo', 'rosbags', 'mujoco', 'junitparser', 'fsspec', 'distributed', 'rerun', 'onnxruntime',
    'mcap', 'zstandard',
}  # fmt: skip
"""What has no key of rosdep: commands that need one of them say so in one line."""
START_S = 60.0


def manifest() -> ET.Element:
    return ET.parse(REPOSITORY / 'package.xml').getroot()


DEPENDENCIES = {
    f'{kind}_depend' for kind in ('build', 'build_export', 'buildtool', 'buildtool_export',
                                  'exec', 'doc', 'test')
} | {'depend', 'conflict', 'replace'}  # fmt: skip
SEQUENCE = ('name', 'version', 'description', 'maintainer', 'license', 'url', 'author',
            'DEPENDENCY', 'group_depend', 'member_of_group', 'export')  # fmt: skip
ONCE, AT_LEAST_ONCE = {'name', 'version', 'description'}, {'maintainer', 'license'}
LIMITS = {f'version_{limit}' for limit in ('lt', 'lte', 'eq', 'gte', 'gt')}
ATTRIBUTES = {'version': {'compatibility'}, 'maintainer': {'email'}, 'author': {'email'},
              'license': {'file'}, 'url': {'type'}, 'group_depend': {'condition'},
              'member_of_group': {'condition'}} | dict.fromkeys(
                  DEPENDENCIES, LIMITS | {'condition'})  # fmt: skip
EMAIL = r'[-\w%+]+(\.[-\w%+]+)*@[-a-zA-Z0-9%]+(\.[-a-zA-Z0-9%]+)*\.[a-zA-Z]{2,}'


def faults_of(root: ET.Element) -> list[str]:
    """Return what the schema of package manifests of format 3 (REP 149) does not allow."""
    tags = ['DEPENDENCY' if child.tag in DEPENDENCIES else child.tag for child in root]
    faults = [f'{tag} is unknown' for tag in set(tags) - set(SEQUENCE)]
    known = [SEQUENCE.index(tag) for tag in tags if tag in SEQUENCE]
    faults += ['the elements are out of order'] if known != sorted(known) else []
    faults += [f'{tag} is not there once' for tag in ONCE if tags.count(tag) != 1]
    faults += [f'{tag} is missing' for tag in AT_LEAST_ONCE if tag not in tags]
    faults += ['export is there twice'] if tags.count('export') > 1 else []
    faults += [f'{e.tag} has no attribute {name}' for e in root
               for name in e.attrib.keys() - ATTRIBUTES.get(e.tag, set())]  # fmt: skip
    patterns = [
        (root.attrib.get('format', ''), '3'),
        (root.findtext('name', ''), r'[a-z](_?[a-z0-9]+)*'),
        (root.findtext('version', ''), r'(0|[1-9]\d*)(\.(0|[1-9]\d*)){2}'),
        *((e.attrib.get('email', ''), EMAIL) for e in root.iter('maintainer')),
        *((e.text or '', r'\S+') for e in root if e.tag in DEPENDENCIES),
    ]
    return faults + [f'{text!r} is not {wanted}' for text, wanted in patterns
                     if not re.fullmatch(wanted, text)]  # fmt: skip


def test_the_manifest_follows_the_schema_and_says_ament_python() -> None:
    root = manifest()
    assert faults_of(root) == []
    assert root.findtext('license') == 'Apache-2.0'
    assert root.findtext('export/build_type') == 'ament_python'
    assert (REPOSITORY / 'resource' / root.findtext('name', '')).exists()
    keys = [element.text for element in root if element.tag in DEPENDENCIES]
    assert len(keys) == len(set(keys))
    # rosdep's keys: ROS packages have no hyphen; those of Python begin like this.
    assert all(re.fullmatch(r'[a-z][a-z0-9_]*|python3-[a-z-]+', key or '') for key in keys)


@pytest.mark.parametrize(
    ('change', 'fault'),
    [
        (lambda root: root.set('format', '2'), "'2' is not 3"),
        (lambda root: root.remove(root.find('license')), 'license is missing'),
        (lambda root: ET.SubElement(root, 'exec_depend'), 'the elements are out of order'),
        (lambda root: ET.SubElement(root, 'run_depend'), 'run_depend is unknown'),
        (lambda root: root.find('maintainer').attrib.clear(), f"'' is not {EMAIL}"),
        (lambda root: root.find('name').set('lang', 'en'), 'name has no attribute lang'),
    ],
)
def test_faults_of_a_manifest_are_found(change, fault) -> None:
    root = manifest()
    change(root)
    assert fault in faults_of(root)


def test_the_manifest_is_what_the_build_tools_accept() -> None:
    package = pytest.importorskip('catkin_pkg.package', reason='catkin_pkg comes with colcon')
    warnings: list[str] = []
    parsed = package.parse_package(str(REPOSITORY / 'package.xml'), warnings=warnings)
    parsed.validate(warnings=warnings)
    assert warnings == []
    assert {d.name for d in parsed.test_depends} >= {'python3-pytest', 'python3-pytest-timeout'}


def test_one_version_everywhere() -> None:
    assert manifest().findtext('version') == __version__


def test_everything_imported_is_declared() -> None:
    keys = {element.text for element in manifest() if element.tag.endswith('depend')}
    declared = {IMPORT_OF_KEY.get(key or '', key) for key in keys}
    used = set()
    for path in (REPOSITORY / 'segfloor_ros').rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                used |= {alias.name.split('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                used.add(node.module.split('.')[0])
    foreign = used - set(sys.stdlib_module_names) - {'segfloor_ros'}
    assert foreign - declared - OF_EXTRAS == set()


def requirements_of_setup() -> dict[str, list[str]]:
    """Return `install_requires` and the extras of setup.py by name."""
    given = {
        keyword.arg: ast.literal_eval(keyword.value)
        for node in ast.walk(ast.parse((REPOSITORY / 'setup.py').read_text()))
        if isinstance(node, ast.Call)
        for keyword in node.keywords
        if keyword.arg in ('install_requires', 'extras_require')
    }
    return {'': given['install_requires'], **given['extras_require']}


def test_what_pip_installs_is_what_rosdep_installs() -> None:
    """Both lists are held against each other: what one brings for the nodes and the command, the
    other brings, too.
    """
    keys = {element.text for element in manifest() if element.tag == 'exec_depend'}
    by_rosdep = {IMPORT_OF_KEY[key] for key in keys if key in IMPORT_OF_KEY}
    module = {'pyyaml': 'yaml', 'opencv-python-headless': 'cv2'}
    found = requirements_of_setup()
    words = [re.split(r'[\[<>=; ]', word)[0].lower() for word in found['']]
    by_pip = {module.get(word, word) for word in words}
    assert by_rosdep == by_pip - OF_EXTRAS
    assert {'rviz2', 'ros2launch', 'rosbag2_storage_mcap', 'launch_ros'} <= keys


def test_the_extra_that_a_message_names_has_the_package_and_the_wheel_has_the_others() -> None:
    packages = {'rerun': 'rerun-sdk', 'rclpy': 'ros-jazzy-rclpy'}
    found = {
        extra: {re.split(r'[\[<>=;]', word)[0].lower() for word in words}
        for extra, words in requirements_of_setup().items()
    }
    for package, extra in EXTRAS.items():
        assert packages.get(package, package) in found[extra], package
    assert OF_EXTRAS - EXTRAS.keys() <= found['']


def test_the_changelog_has_this_release_first_and_short_entries() -> None:
    text = (REPOSITORY / 'CHANGELOG.md').read_text()
    assert re.findall(r'^## \[(\d.*?)\]', text, re.MULTILINE)[0] == __version__
    entries = [line for line in text.splitlines() if line.startswith('- ')]
    assert [entry for entry in entries if len(entry[2:].split()) > 25] == []
    assert not re.search(r'^ ', text, re.MULTILINE)  # an entry is one line


def test_no_page_and_no_description_has_a_placeholder() -> None:
    known = subprocess.run(
        ['git', 'ls-files', '*.md', '*.xml', '*.cff', '*.py', '*.yml', '*.toml', ':!test/*'],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
    ).stdout.split()
    words = ('example.' + 'org', 'URL_OF_' + 'THIS')
    for name in known:
        text = (REPOSITORY / name).read_text()
        assert [word for word in words if word in text] == [], name


def test_without_its_libraries_the_command_ends_with_one_line(tmp_path) -> None:
    (tmp_path / 'typer.py').write_text("raise ModuleNotFoundError('No typer', name='typer')\n")
    command = [sys.executable, '-c', 'from segfloor_ros.apps.cli import start; start()', '--help']
    found = subprocess.run(
        command,
        cwd=REPOSITORY,
        env={**os.environ, 'PYTHONPATH': str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=START_S,
    )
    assert found.returncode == 2
    assert found.stderr.startswith('segfloor: the command needs the Python package typer')
    assert 'apt install python3-typer' in found.stderr
    assert found.stderr.count('\n') == 1


def test_constraints_pin_every_requirement_exactly() -> None:
    lines = (REPOSITORY / 'constraints.txt').read_text().splitlines()
    pins = [line for line in lines if line and not line.startswith('#')]
    assert all(re.fullmatch(r'[a-z0-9.-]+==[\w.]+(; python_version .+)?', pin) for pin in pins)
    pinned = {pin.partition('==')[0] for pin in pins}
    requirements = [word for words in requirements_of_setup().values() for word in words]
    names = {re.split(r'[\[<>=;]', requirement)[0].lower() for requirement in requirements}
    wanted = names - {'segfloor_ros'}  # the extra `all` names the others
    assert {'numpy', 'ros-jazzy-rclpy', 'typer', 'mujoco', 'ruff'} <= wanted
    assert wanted <= pinned


@pytest.fixture(scope='module')
def workspace(tmp_path_factory) -> Path:
    """A colcon workspace with a copy of the package, built and installed."""
    if shutil.which('colcon', path=os.pathsep.join([_scripts(), os.environ['PATH']])) is None:
        pytest.skip('colcon is not installed')
    setuptools = int(importlib.metadata.version('setuptools').split('.')[0])
    if setuptools >= 80:
        pytest.skip('colcon needs setuptools < 80')
    workspace = tmp_path_factory.mktemp('workspace')
    ignored = shutil.ignore_patterns('.*', '__pycache__', 'build', 'install', 'log', '*.egg-info')
    shutil.copytree(REPOSITORY, workspace / 'src' / 'segfloor_ros', ignore=ignored)
    colcon = ['colcon', '--log-base', 'log', 'build', '--event-handlers', 'console_direct+']
    built = subprocess.run(
        colcon, cwd=workspace, env=_environment(), capture_output=True, text=True, timeout=240
    )
    assert built.returncode == 0, built.stdout + built.stderr
    return workspace


def installed(workspace: Path, command: str, **environment: str) -> subprocess.Popen[str]:
    """Start a command in a shell that has sourced the workspace, away from the sources."""
    script = f'. {workspace}/install/setup.sh && exec {command}'
    return subprocess.Popen(
        ['sh', '-c', script],
        cwd=workspace / 'install',
        env={**_environment(), **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.slow
def test_the_install_has_what_ros_looks_for(workspace) -> None:
    prefix = workspace / 'install' / 'segfloor_ros'
    for node in (*NODES, 'segfloor_pipeline', 'segfloor'):
        assert os.access(prefix / 'lib' / 'segfloor_ros' / node, os.X_OK), node
    share = prefix / 'share'
    assert (share / 'ament_index' / 'resource_index' / 'packages' / 'segfloor_ros').exists()
    assert (share / 'segfloor_ros' / 'package.xml').exists()
    for folder in ('launch_configs', 'params'):
        names = {path.name for path in (REPOSITORY / folder).iterdir() if path.is_file()}
        names |= {'fastdds.xml'} if folder == 'params' else set()
        assert {path.name for path in (share / 'segfloor_ros' / folder).iterdir()} == names
    assert os.access(prefix / 'bin' / 'segfloor', os.X_OK)
    (profiles,) = prefix.glob('lib/python*/site-packages/segfloor_ros/nodes/fastdds.xml')
    assert profiles.stat().st_size > 0


@pytest.mark.slow
def test_colcon_runs_the_tests(workspace) -> None:
    some = ['--pytest-args', 'test/core/test_geometry.py']
    colcon = ['colcon', '--log-base', 'log', 'test', '--return-code-on-test-failure', *some]
    tested = subprocess.run(
        colcon, cwd=workspace, env=_environment(), capture_output=True, text=True, timeout=240
    )
    assert tested.returncode == 0, tested.stdout + tested.stderr
    report = ET.parse(workspace / 'build' / 'segfloor_ros' / 'pytest.xml').getroot()
    (suite,) = report.iter('testsuite')
    assert int(suite.attrib['tests']) > 5
    assert (suite.attrib['failures'], suite.attrib['errors']) == ('0', '0')


@pytest.mark.slow
def test_the_installed_command_runs_from_the_install(workspace) -> None:
    out, errors = installed(workspace, 'segfloor --help').communicate(timeout=START_S)
    assert 'replay' in out, errors
    where = 'python -c "import segfloor_ros; print(segfloor_ros.__file__)"'
    out, errors = installed(workspace, where).communicate(timeout=START_S)
    assert str(workspace / 'install') in out, errors


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec('rclpy') is None, reason='needs ROS 2')
@pytest.mark.parametrize('node', NODES[1:])
def test_an_installed_node_starts_and_stops_on_interrupt(workspace, make_graph, node) -> None:
    graph = make_graph()
    path = workspace / 'install' / 'segfloor_ros' / 'lib' / 'segfloor_ros' / node
    process = installed(workspace, str(path), ROS_DOMAIN_ID=os.environ['ROS_DOMAIN_ID'])
    try:
        graph.until(lambda: graph.reports_any(node) or process.poll() is not None, node)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=START_S)
    finally:
        process.kill()
    assert process.returncode == 0, errors


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec('rclpy') is None, reason='needs ROS 2')
def test_an_installed_camera_without_input_says_so(workspace) -> None:
    path = workspace / 'install' / 'segfloor_ros' / 'lib' / 'segfloor_ros' / 'stereo_camera'
    process = installed(workspace, str(path))
    _, errors = process.communicate(timeout=START_S)
    assert process.returncode == 2
    assert 'stereo_camera.input is empty' in errors


def _scripts() -> str:
    return str(Path(sys.executable).parent)


def _environment() -> dict[str, str]:
    """The environment with this interpreter's scripts first, and without the sources."""
    environment = dict(os.environ)
    environment['PATH'] = os.pathsep.join([_scripts(), environment['PATH']])
    environment.pop('PYTHONPATH', None)
    return environment


def test_the_command_starts_without_libraries_that_few_of_its_parts_need() -> None:
    """Each takes a part of a second, in every process of a suite, too."""
    heavy = {
        'matplotlib',
        'evo',
        'mujoco',
        'distributed',
        'rerun',
        'junitparser',
        'scipy',
        'cv2',
        'numpy',
    }
    words = f'import sys, segfloor_ros.apps.cli.main; print(sorted({heavy} & sys.modules.keys()))'
    found = subprocess.run([sys.executable, '-c', words], capture_output=True, text=True)
    assert found.stdout.strip() == '[]', found.stderr


@pytest.mark.parametrize('package', ['segfloor_ros.apps.cli', 'segfloor_ros.nodes'])
@pytest.mark.parametrize(('given', 'expected'), [(None, 1), ('2', 2)])
def test_command_and_nodes_use_one_thread_of_opencv_unless_told_otherwise(package, given, expected):
    environment = {k: v for k, v in os.environ.items() if k != 'OPENCV_FOR_THREADS_NUM'}
    if given is not None:
        environment['OPENCV_FOR_THREADS_NUM'] = given
    printed = subprocess.run(
        [sys.executable, '-c', f'import {package}, cv2; print(cv2.getNumThreads())'],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert int(printed.stdout) == expected
