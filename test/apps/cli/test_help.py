"""What the command line says about itself."""

import re
import shlex
from pathlib import Path

import pytest
import typer
from command_line import segfloor
from rich.text import Text

from segfloor_ros.apps.cli.help_panels import ADVANCED, BASIC, lay_out
from segfloor_ros.apps.cli.main import COMMANDS, program
from segfloor_ros.apps.cli.terminal import params_file, shipped_params
from segfloor_ros.apps.simulation.scene_file import open_scene, shipped
from segfloor_ros.core.errors import InputError
from segfloor_ros.nodes.configuration import resolve


def commands(group, name=''):
    """Yield the commands below a group with their names."""
    for word, command in getattr(group, 'commands', {}).items():
        words = f'{name} {word}'.strip()
        yield words, command
        yield from commands(command, words)


ALL = dict(commands(typer.main.get_command(program())))
SINGLE = {name: command for name, command in ALL.items() if not hasattr(command, 'commands')}


@pytest.mark.parametrize('name', ALL)
def test_no_word_of_a_help_is_taken_for_markup(name):
    for parameter in ALL[name].params:
        words = getattr(parameter, 'help', None) or ''
        assert Text.from_markup(words).plain == words, parameter.name


@pytest.mark.parametrize('name', SINGLE)
def test_a_help_shows_eight_options_at_most_before_the_advanced_ones(name):
    lay_out(SINGLE[name], name)
    options = [p for p in SINGLE[name].params if p.opts[0].startswith('-')]
    basic = {p.opts[0] for p in options if p.rich_help_panel is None}
    assert len(basic) <= 8
    if name in BASIC:
        assert basic == {*BASIC[name].split()}
        assert {p.rich_help_panel for p in options} == {None, ADVANCED}


@pytest.mark.parametrize('name', COMMANDS)
def test_a_command_is_described_in_the_words_of_its_own_help(name):
    own = ' '.join(ALL[name].help.partition('\n\n')[0].split())
    assert COMMANDS[name][1] == own


@pytest.mark.parametrize('name', SINGLE)
def test_a_help_opens_with_examples_that_the_command_takes(name):
    examples = re.findall('^segfloor .*', SINGLE[name].help, re.M)
    assert examples[0].startswith(f'segfloor {name}')
    for example in examples:
        words = shlex.split(example.partition(' > ')[0])[1:]
        command = next(SINGLE[n] for n in (words[0], ' '.join(words[:2])) if n in SINGLE)
        known = {option for p in command.params for option in p.opts}
        assert {word for word in words if word.startswith('--')} <= known, example


def test_the_example_of_simulate_can_be_run_again_beside_what_came_of_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'corridor1').mkdir()
    assert open_scene('corridor1') == open_scene(str(shipped()['corridor1']))
    with pytest.raises(InputError, match='is a folder'):
        open_scene('.')


def test_scenes_are_listed_with_a_line_each():
    done = segfloor('simulate', '--list')
    assert done.returncode == 0
    assert re.search('hall .*A hall of eight by six metres', done.stdout)


def test_shipped_parameters_are_found_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = shipped_params()
    assert {'kitti', 'euroc', 'library', 'camera_realsense'} <= names.keys()
    assert 'nav2' not in names
    assert params_file(Path('kitti')) == names['kitti']
    done = segfloor('params')
    assert re.search(r'kitti\s.*A car with a roof-high stereo camera', done.stdout)
    done = segfloor('run', 'nothing', '--params', 'kiti', '--out', 'out')
    assert done.returncode == 2
    assert '--params kiti: no such file, and none of this name is shipped' in done.stderr
    assert 'kitti' in done.stderr
    done = segfloor('run', 'nothing', '--params', 'kitti', '--out', 'out')
    assert 'nothing' in done.stderr
    assert '--params' not in done.stderr


def test_a_file_of_ones_own_wins_over_a_shipped_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'kitti').write_text('/**:\n  ros__parameters: {num_features: 700}\n')
    assert resolve(params_file(Path('kitti'))).stereo_slam.num_features == 700
