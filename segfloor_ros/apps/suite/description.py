"""The description of a suite, as its YAML file says it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from segfloor_ros.apps.suite.measures import HIGHER, LOWER, MEASURES, Bound, Slack
from segfloor_ros.apps.suite.result_files import find_recordings, is_url
from segfloor_ros.core.errors import SegfloorError, SettingsError
from segfloor_ros.core.files.paths import user_path
from segfloor_ros.core.files.whole import number as finite_number
from segfloor_ros.core.settings import suggestion
from segfloor_ros.nodes.configuration import resolve
from segfloor_ros.nodes.yaml_files import Key, MarkedYaml, read_marked_yaml

RUN, REPLAY = 'run', 'replay'
RECORDING, SCENE, RESULTS = SOURCES = ('input', 'simulate', 'results')
SUITE_KEYS = ('name', 'defaults', 'recordings', 'about', 'published', 'published_measure')
PUBLISHED_MEASURES = ('path_error_m', 'length_m')
SHARED_KEYS = ('truth', 'reference_map', 'mode', 'rate', 'params', 'set', 'timeout_s', 'expect',
               'no_worse_by', 'no_map')  # fmt: skip
RECORDING_KEYS = (*SOURCES, 'seed', 'scene', 'name', 'continue_from', 'published')
PREVIOUS = 'previous'


@dataclass(frozen=True)
class Entry:
    """One recording of a suite.

    source: what `input` names: a recording (path or URL), a scene to simulate, or a results folder
    that is there already and only measured. scene_assignments: what differs from the scene. mode:
    `run`, or `replay` through the nodes at `rate`. truth, reference_map: paths or URLs; truth ''
    means the recording itself where it holds one. params: a parameter file, '' for none. slacks: by
    measure, for a baseline. continue_from: name of the recording whose map this one continues, ''
    for none. no_map: the path alone is measured. published: figures of others, by method.
    """

    name: str
    input: str
    source: str = RECORDING
    scene_assignments: tuple[str, ...] = ()
    mode: str = RUN
    rate: float = 0.0
    params: str = ''
    assignments: tuple[str, ...] = ()
    truth: str = ''
    reference_map: str = ''
    timeout_s: float = 3600.0
    bounds: tuple[Bound, ...] = ()
    slacks: Mapping[str, Slack] = field(default_factory=dict)
    continue_from: str = ''
    no_map: bool = False
    published: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Suite:
    """Recordings and what must hold for their maps. published: by method, where its figures are
    from and how they were aligned; published_measure: what they measure. missing: names of
    recordings that are not there.
    """

    name: str
    entries: tuple[Entry, ...]
    published: Mapping[str, str] = field(default_factory=dict)
    missing: tuple[str, ...] = ()
    published_measure: str = PUBLISHED_MEASURES[0]


def read_suite(path: Path, data: Path | None = None) -> Suite:
    """Read a suite. data: folder of its recordings, some of which may be missing; else they are
    where the suite is, all of them. Raises SettingsError naming the file, the line and what is
    wrong.
    """
    document = read_marked_yaml(path, SettingsError)
    values = _mapping(document, (), document.values, SUITE_KEYS)
    published = values.get('published') or {}
    measure = values.get('published_measure', PUBLISHED_MEASURES[0])
    if measure not in PUBLISHED_MEASURES:
        raise document.error(
            ('published_measure',),
            f'published_measure: {measure} is none of {", ".join(PUBLISHED_MEASURES)}',
        )
    defaults = _mapping(document, ('defaults',), values.get('defaults') or {}, SHARED_KEYS)
    recordings = values.get('recordings')
    if not isinstance(recordings, list) or not recordings:
        raise document.error(('recordings',), 'recordings: expected a list of recordings')
    entries: list[Entry] = []
    missing: list[str] = []
    for index, item in enumerate(recordings):
        key: Key = ('recordings', index)
        own = _mapping(document, key, item, RECORDING_KEYS + SHARED_KEYS)
        _mapping(document, (*key, 'published'), own.get('published') or {}, tuple(published))
        reader = _Reader(document, key, own, defaults, (data or path.parent).absolute())
        if data is not None and not reader.is_there():
            missing.append(str(own.get('name') or own[RECORDING]))
            continue
        for entry in reader.entries():
            entries.append(_continued(document, key, own.get('continue_from'), entry, entries))
        names = [entry.name for entry in entries]
        doubled = [name for name in names if names.count(name) > 1]
        if doubled:
            raise document.error(key, f'two recordings are called {doubled[0]}; give one a name')
    if not entries:
        raise SettingsError(f'{data}: has none of the recordings of {path}, e.g. {missing[0]}')
    name = str(values.get('name') or path.stem)
    return Suite(name, tuple(entries), published, tuple(missing), measure)


def _continued(
    document: MarkedYaml, key: Key, wanted: Any, entry: Entry, before: list[Entry]
) -> Entry:
    """Return an entry that continues the map of an earlier one, as `continue_from` says. The first
    one of a suite has no previous one, and starts a map.
    """
    names = [earlier.name for earlier in before]
    if not wanted or (wanted == PREVIOUS and not names):
        return entry
    name = names[-1] if wanted == PREVIOUS else str(wanted)
    if name not in names:
        raise document.error(
            (*key, 'continue_from'), f'continue_from: {name} is no earlier recording of the suite'
        )
    for one in (entry, before[names.index(name)]):
        if one.source == RESULTS or one.mode != RUN:
            raise document.error(
                (*key, 'continue_from'), f'continue_from: {one.name} is not mapped by mode run'
            )
    return replace(entry, continue_from=name)


@dataclass(frozen=True)
class _Reader:
    """Reads one item of `recordings`, which is several entries where its input is a pattern.
    _folder: of the recordings.
    """

    _document: MarkedYaml
    _key: Key
    _own: dict[str, Any]
    _defaults: dict[str, Any]
    _folder: Path

    def is_there(self) -> bool:
        """Whether there is a recording, where one is named."""
        try:
            return RECORDING not in self._own or bool(
                find_recordings(self._resolved(str(self._own[RECORDING])))
            )
        except SegfloorError:
            return False

    def entries(self) -> list[Entry]:
        """Return the entries."""
        shared: dict[str, Any] = {
            'mode': self._choice('mode', (RUN, REPLAY)),
            'rate': self._number('rate', 0.0, 0.0),
            'params': self._path('params'),
            'assignments': self._assignments('set'),
            'timeout_s': self._number('timeout_s', Entry.timeout_s, 1.0),
            'truth': self._path('truth'),
            'reference_map': self._path('reference_map'),
            'bounds': tuple(self._bounds()),
            'slacks': self._slacks(),
            'no_map': self._value('no_map') is True,
            'published': {
                method: self._limit((*self._key, 'published', method), value)
                for method, value in (self._own.get('published') or {}).items()
            },
        }
        self._check_parameters(shared['params'], shared['assignments'])
        given = [source for source in SOURCES if source in self._own]
        if len(given) != 1:
            raise self._error(
                (), 'expected one of input (a recording), simulate (a scene), results (a folder)'
            )
        if given[0] == SCENE:
            return [self._simulated(shared)]
        return self._found(given[0], shared)

    def _found(self, source: str, shared: dict[str, Any]) -> list[Entry]:
        for name in ('seed', 'scene'):
            if name in self._own:
                raise self._error((name,), f'{name} is for simulate, not for {source}')
        pattern = self._resolved(str(self._own[source]))
        try:
            found = find_recordings(pattern)
        except SegfloorError as error:
            raise self._error((source,), str(error)) from None
        given = self._own.get('name')
        if given and len(found) > 1:
            raise self._error(('name',), f'{given} would name {len(found)} recordings')
        return [
            Entry(_file_name(given or stem), path, source, **shared) for stem, path in found.items()
        ]

    def _simulated(self, shared: dict[str, Any]) -> Entry:
        from segfloor_ros.apps.simulation.scene_file import open_scene  # see job.py

        scene = str(self._own['simulate'])
        if '/' in scene or scene.endswith('.yaml'):
            scene = self._resolved(scene)
        words = self._assignments('scene')
        seed = self._own.get('seed')
        if seed is not None:
            if isinstance(seed, bool) or not isinstance(seed, int):
                raise self._error(('seed',), f'seed: {seed!r} is not a whole number')
            words += (f'seed={seed}',)
        try:
            open_scene(scene, words)
        except SegfloorError as error:
            raise self._error(('simulate',), str(error)) from None
        name = Path(scene).stem + (f'-{seed}' if seed is not None else '')
        return Entry(_file_name(self._own.get('name') or name), scene, SCENE, words, **shared)

    def _bounds(self) -> list[Bound]:
        bounds = []
        for key, name, wanted in self._by_measure('expect'):
            better = MEASURES[name].better
            if isinstance(wanted, dict):
                limits = _mapping(self._document, key, wanted, ('min', 'max'))
                least, greatest = (
                    self._limit((*key, end), limits[end]) if end in limits else default
                    for end, default in (('min', -math.inf), ('max', math.inf))
                )
                if least > greatest:
                    raise self._document.error(key, f'{name}: min {least:g} > max {greatest:g}')
                bounds.append(Bound(name, least, greatest))
            elif better == HIGHER:
                bounds.append(Bound(name, least=self._limit(key, wanted)))
            elif better == LOWER:
                bounds.append(Bound(name, greatest=self._limit(key, wanted)))
            else:
                raise self._document.error(key, f'{name}: expected {{min: …, max: …}}')
        return bounds

    def _slacks(self) -> dict[str, Slack]:
        slacks = {}
        for key, name, wanted in self._by_measure('no_worse_by'):
            text = str(wanted).strip()
            relative = text.endswith('%')
            value = self._limit(key, text.removesuffix('%').strip() if relative else wanted)
            if value < 0:
                raise self._document.error(key, f'{name}: {wanted} is negative')
            slacks[name] = Slack(value / 100 if relative else value, relative)
        return slacks

    def _by_measure(self, name: str) -> list[tuple[Key, str, Any]]:
        """Return key, measure and value of the defaults' and the recording's own entries."""
        found: dict[str, tuple[Key, str, Any]] = {}
        for key, source in ((('defaults', name), self._defaults), (self._at(name), self._own)):
            values = source.get(name) or {}
            for measure, value in _mapping(self._document, key, values, tuple(MEASURES)).items():
                found[measure] = ((*key, measure), measure, value)
        return list(found.values())

    def _limit(self, key: Key, value: Any) -> float:
        try:
            if isinstance(value, bool):
                raise ValueError
            return finite_number(str(value))
        except ValueError:
            raise self._document.error(key, f'{key[-1]}: {value!r} is not a number') from None

    def _value(self, name: str) -> Any:
        return self._own[name] if name in self._own else self._defaults.get(name)

    def _choice(self, name: str, choices: tuple[str, ...]) -> str:
        value = self._value(name) or choices[0]
        if value not in choices:
            raise self._error((name,), f'{name}: {value} is not one of {", ".join(choices)}')
        return str(value)

    def _number(self, name: str, default: float, least: float) -> float:
        value = self._value(name)
        found = default if value is None else self._limit(self._at(name), value)
        if found < least:
            raise self._error((name,), f'{name}: {value} is below {least:g}')
        return found

    def _path(self, name: str) -> str:
        value = self._value(name)
        if not value:
            return ''
        path = self._resolved(str(value))
        if not is_url(path) and not Path(path).exists():
            raise self._error((name,), f'{name}: {path} does not exist')
        return path

    def _assignments(self, name: str) -> tuple[str, ...]:
        """Return `a.b=value` of mappings or lists, the defaults' first."""
        words: list[str] = []
        for source in (self._defaults, self._own):
            values = source.get(name) or {}
            if isinstance(values, dict):
                words += [f'{key}={_word(value)}' for key, value in values.items()]
            elif isinstance(values, list):
                words += [str(value) for value in values]
            else:
                raise self._error((name,), f'{name}: expected stage.parameter: value')
        return tuple(words)

    def _check_parameters(self, params: str, assignments: tuple[str, ...]) -> None:
        try:
            resolve(Path(params) if params else None, assignments)
        except SegfloorError as error:
            raise self._error(('set',) if assignments else ('params',), str(error)) from None

    def _resolved(self, text: str) -> str:
        """Return a path, relative to the folder of the recordings, in full; a URL as it is."""
        if is_url(text):
            return text
        return str(self._folder / user_path(text))

    def _at(self, name: str) -> Key:
        own: Key = (*self._key, name)
        return own if name in self._own else ('defaults', name)

    def _error(self, key: Key, message: str) -> SegfloorError:
        at = self._at(str(key[0])) if key else self._key
        return self._document.error(at, message)


def _mapping(document: MarkedYaml, key: Key, values: Any, known: tuple[str, ...]) -> dict[str, Any]:
    """Return a mapping with known keys only."""
    if not isinstance(values, dict):
        what = f'{key[-1]}: ' if key and isinstance(key[-1], str) else ''
        raise document.error(key, f'{what}expected {", ".join(known[:3])}, … with values')
    for name in values:
        if name not in known:
            raise document.error((*key, name), f'unknown {name}{suggestion(name, list(known))}')
    return values


def _word(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _file_name(name: Any) -> str:
    """Return a name that can be a folder's."""
    return ''.join(c if c.isalnum() or c in '-_.' else '-' for c in str(name)).strip('.') or 'drive'
