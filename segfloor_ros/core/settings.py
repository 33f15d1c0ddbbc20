"""Settings of the stages: one frozen dataclass per stage is the only source of names and defaults.

A stage declares its settings once, with `setting(...)` fields carrying description, unit and
range. The ROS parameters (names, descriptors, ranges), the checks of YAML files and of the
command line, and the tables in docs/ are all derived from that declaration. So is the robot: what
it drives over and under, declared once for all stages that judge heights.
"""

from __future__ import annotations

import builtins
import dataclasses
import difflib
import math
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from segfloor_ros.core.errors import SettingsError

Value = bool | int | float | str
S = TypeVar('S', bound='StageSettings')


UNITS = {'_m': 'm', '_s': 's', '_px': 'px', '_hz': 'Hz', '_rad': 'rad', '_mps': 'm/s'}
"""Of a setting by the end of its name, unless it says otherwise."""


CONSTANTS = (
    *('tracked_points', 'keyframe_min_frames', 'keyframe_motion_ratio', 'keyframe_turn_rad'),
    *('disparity_offset_sigma_px', 'height_sigma_m', 'max_mask_log_odds', 'max_height_log_odds'),
    *('coarse_above_px', 'obstacle_height_m', 'fill_support', 'fill_gap_m'),
    *('mask_dilation_px', 'jpeg_quality'),
)
GONE = dict.fromkeys(CONSTANTS, 'it is a constant now') | {
    'bit_depth': 'it follows from the brightest pixel so far',
    'num_disparities': 'it follows from camera and mount',
    'disparity_above_horizon': 'rows above the horizon are not matched',
    'level_ground': 'it brought no more than noise',
    'max_hit_error_m': 'it follows from resolution_m',
    'scan_gap_m': 'it follows from step_height_m',
}
"""Settings of earlier versions, and what became of them."""


def setting(default: Value, description: str, **facts: Any) -> Any:
    """Declare one setting of a stage. facts: of `SettingSpec`, beside name, type and default."""
    return dataclasses.field(default=default, metadata={'description': description, **facts})


@dataclasses.dataclass(frozen=True)
class SettingSpec:
    """What is known of one setting. within: the least and the greatest value, both inclusive;
    without it, or choices, anything of the type goes. live: it may change while a node runs; the
    others are read-only after the start.
    """

    name: str
    type: builtins.type
    default: Value
    description: str
    unit: str = ''
    within: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    live: bool = False

    def range_text(self) -> str:
        """Return the accepted values in words, e.g. `0.01 to 0.2 m`, or '' where anything of the
        type goes.
        """
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        if self.within is None:
            return ''
        unit = f' {self.unit}' if self.unit else ''
        return f'{self.within[0]:g} to {self.within[1]:g}{unit}'

    def check(self, value: Any, stage: str) -> Any:
        """Return `value` as this setting's type. Raises SettingsError naming parameter, value and
        range.
        """
        where = f'{stage}.{self.name}'
        if self.type is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, self.type) or (self.type is int and isinstance(value, bool)):
            raise SettingsError(f'{where} = {value!r}: expected {_TYPE_NAMES[self.type]}')
        if isinstance(value, float) and math.isinf(value):
            raise SettingsError(f'{where} = {value!r}: must be finite')
        if not self._accepts(value):
            raise SettingsError(
                f'{where} = {value!r} is out of range: {self.range_text() or "a number"}'
            )
        return value

    def _accepts(self, value: Any) -> bool:
        if isinstance(value, float) and math.isnan(value):
            # NaN stands for "not given" where it is the default, e.g. a height to be measured.
            return isinstance(self.default, float) and math.isnan(self.default)
        if self.within is not None:
            return bool(self.within[0] <= value <= self.within[1])
        return not self.choices or value in self.choices


_TYPE_NAMES = {bool: 'true or false', int: 'a whole number', float: 'a number', str: 'text'}


@dataclasses.dataclass(frozen=True)
class StageSettings:
    """Base of every stage's settings. Values are checked on construction; raises SettingsError."""

    def __post_init__(self) -> None:
        for spec in self.specs():
            checked = spec.check(getattr(self, spec.name), self.stage_name())
            object.__setattr__(self, spec.name, checked)

    @classmethod
    def stage_name(cls) -> str:
        """Return the stage's name, which is also its node's name: `StereoSlamSettings` →
        `stereo_slam`.
        """
        words = ''.join(f'_{c.lower()}' if c.isupper() else c for c in cls.__name__)
        return words.lstrip('_').removesuffix('_settings')

    @classmethod
    def specs(cls) -> list[SettingSpec]:
        """Return the settings of this stage in order of declaration."""
        types = typing.get_type_hints(cls)
        return [
            SettingSpec(
                f.name,
                types[f.name],
                typing.cast(Value, f.default),
                **{'unit': unit_of(f.name), **f.metadata},
            )
            for f in dataclasses.fields(cls)
        ]

    @classmethod
    def has(cls, name: str) -> bool:
        """Whether there is a setting of this name."""
        return any(spec.name == name for spec in cls.specs())

    @classmethod
    def from_mapping(cls: type[S], values: Mapping[str, Any]) -> S:
        """Build the settings from names and values. Raises SettingsError for an unknown name or a
        bad value.
        """
        known = [spec.name for spec in cls.specs()]
        for name in values:
            if name not in known:
                raise SettingsError(
                    f'unknown parameter {cls.stage_name()}.{name}{suggestion(name, known)}'
                )
        return cls(**values)

    def replaced(self: S, **changes: Any) -> S:
        """Return a copy with some values changed, checked like the original."""
        return type(self).from_mapping({**dataclasses.asdict(self), **changes})


def unit_of(name: str) -> str:
    """Return the unit that the end of a setting's name tells, '' where it tells none."""
    return next((unit for end, unit in UNITS.items() if name.endswith(end)), '')


def suggestion(name: str, known: list[str]) -> str:
    """Return `: did you mean X?`, or the list of known names when nothing is near; of a setting of
    earlier versions what became of it.
    """
    if name in GONE:
        return f': it is gone, {GONE[name]}; remove it'
    near = difflib.get_close_matches(name, known, n=1)
    return f': did you mean {near[0]}?' if near else ': known are ' + ', '.join(sorted(known))


@dataclass(frozen=True)
class RobotSettings(StageSettings):
    """Base of the settings of the stages that must know the robot, the same one in all of them."""

    robot_height_m: float = setting(
        1.0,
        'The robot passes under what hangs higher than this above the floor.',
        within=(0.05, 10.0),
        live=True,
    )
    step_height_m: float = setting(
        0.03,
        'The robot drives over what is lower than this; what stands higher is an obstacle.',
        within=(0.005, 0.5),
        live=True,
    )
    drop_height_m: float = setting(
        0.04,
        'What lies deeper than this below the floor is not floor.',
        within=(0.005, 0.5),
        live=True,
    )

    @property
    def robot(self) -> dict[str, float]:
        """The robot alone: height, step and drop in metres by name."""
        return {spec.name: getattr(self, spec.name) for spec in RobotSettings.specs()}


ROBOT_PARAMETERS = [spec.name for spec in RobotSettings.specs()]
