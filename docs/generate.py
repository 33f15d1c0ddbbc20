"""Writes the pages of the nodes from the declared topics and settings: python docs/generate.py."""

from __future__ import annotations

import math
from pathlib import Path

import yaml
from topic_texts import ABOUT

from segfloor_ros.core.settings import SettingSpec
from segfloor_ros.nodes.configuration import NODE_SETTINGS, STAGE_SETTINGS
from segfloor_ros.nodes.messages.topics import (
    CAMERA,
    CLOUD,
    DIAGNOSTICS,
    FLOOR,
    GRID,
    MASKS,
    NODES,
    PACED_BY,
    ROBOT,
    SLAM,
    Topic,
    describe_policies,
    published_by,
    subscribed_by,
)

PAGES = Path(__file__).parent / 'nodes'
BASIC = yaml.safe_load((Path(__file__).parents[1] / 'params' / 'basic.yaml').read_text())
"""The parameters that most robots need, by section; all others are advanced."""

PURPOSE = {
    CAMERA: """\
Plays a recording or reads a device and publishes every stereo pair as recorded, with its own stamp
and calibration. It begins once all four topics have a subscriber. On a robot with a camera driver
it is not needed: remap the driver's topics to those that `stereo_slam` subscribes to.""",
    SLAM: """\
Tracks every stereo pair, adds keyframes, and keeps a sparse map of points with stable ids. While
tracking is lost it publishes no pose, and `/diagnostics` says why. Where the camera sits on the
robot comes from the parameters, else from tf (`base_link` to the frame of the left image), else it
is measured from the floor the camera sees; until then images and results are held back, and all of
them follow.

On tf (REP-105) it broadcasts `map` → `odom` → `base_link` with the stamps of the images it tracked,
and on `/tf_static` the mount where tf lacks it; where the camera's frame has a parent already,
the root of that tree is put on the base. With `publish_odom_tf: false` another node owns `odom` →
`base_link`, e.g. robot_localization with wheels and IMU: `map` → `odom` is then what lies between
that node's base and the one SLAM sees at the same time, and stays as it was while tracking is lost.
Let such a filter use the velocity of `odometry`: the covariance of its pose grows along the way.
tf needs tf2_msgs, which ROS has; with pip wheels `make` builds it.""",
    FLOOR: """\
Computes the disparity of every keyframe and marks the pixels that show floor.""",
    CLOUD: """\
Labels every point of the sparse map as floor or obstacle, by the masks of the keyframes that see it
and by its height.""",
    GRID: """\
Builds the occupancy grid from the labelled points, the rays to floor points and the floor scans. It
follows every later correction of the keyframes.""",
    ROBOT: """\
A differential-drive robot in a rendered scene (MuJoCo), in place of a camera's driver. It takes
`cmd_vel`, slips and collides, and publishes what its camera, wheels and IMU measure, and the truth.
It needs the extra `sim`. [How to explore](../explore.md) with it.""",
    MASKS: """\
Runs a segmentation network on every keyframe, and on the newest left image when it is free. Late
masks count: they remove points of their keyframe. The floor of a keyframe waits for its mask while
this node runs.
[The network's files](../semantics.md).""",
}

PAUSE, RESET = ('`~/pause`', '`std_srvs/srv/SetBool`'), ('`~/reset`', '`std_srvs/srv/Trigger`')
PAUSING = 'Pause (true): receive and process nothing, keep the map. Resume (false).'
NEW_MAP = 'Drop the map and begin with an empty one at the next keyframe.'

SERVICES = {
    CAMERA: [
        (*PAUSE, 'Pause (true) or resume (false) the recording.'),
        (*RESET, 'Begin with the first frame again.'),
    ],
    SLAM: [
        (*PAUSE, PAUSING),
        (
            *RESET,
            'Drop the map and begin with that of `load_map`, or an empty one. The other nodes drop '
            'theirs (`keyframe/map_start`). The same happens when the stamps '
            'of the images go back by more than half a second, as when a recording is played '
            'again.',
        ),
        (
            '`~/load_map`',
            '`std_srvs/srv/Trigger`',
            'Continue the map of the file `load_map`; a file that is no map changes nothing.',
        ),
        (
            '`~/save_map`',
            '`std_srvs/srv/Trigger`',
            'Write the whole map, with the parts of the other nodes, to the file `save_map`.',
        ),
        (
            '`~/prune_map`',
            '`std_srvs/srv/Trigger`',
            'Prune the file `save_map`, as `segfloor map prune` does; the map in use stays as it '
            'is until `~/load_map`.',
        ),
        (
            '`~/map_info`',
            '`std_srvs/srv/Trigger`',
            'Return what the map in use holds, as JSON: keyframes, points, loops, and the drives '
            'that made it.',
        ),
    ],
    ROBOT: [
        (*PAUSE, 'Pause (true) or resume (false) its time.'),
        (*RESET, 'Put the robot back to where it started.'),
    ],
    MASKS: [
        (*PAUSE, 'Pause (true): process no image. Resume (false).'),
        (*RESET, 'Drop the images that wait.'),
    ],
    FLOOR: [(*PAUSE, PAUSING), (*RESET, NEW_MAP)],
    CLOUD: [(*PAUSE, PAUSING), (*RESET, NEW_MAP)],
    GRID: [
        (*PAUSE, PAUSING),
        (*RESET, NEW_MAP),
        (
            '`save_map`',
            '`std_srvs/srv/Trigger`',
            'Write the map to `map_file` in the format of Nav2’s map_server.',
        ),
    ],
}

MANAGED = """\
The node is managed: `ros2 lifecycle set` and lifecycle managers configure, activate, deactivate and
clean it up. By default it does the first two itself (`autostart`). Deactivated it keeps its map and
receives nothing; cleaned up it has no topics and no map. It makes no bond: give Nav2's lifecycle
manager `bond_timeout: 0.0`."""

ON_DEMAND = """\
While nobody listens to what it publishes, its status included, it receives nothing (state `idle` in
its health)."""

STATUS = {
    CAMERA: 'One status per pair sent (`frame_index`), and `stereo_camera: recording` at its end '
    '(`frames`, `skipped`).',
    SLAM: 'One status per frame: OK while tracking, WARN while the mount is measured, ERROR while '
    'lost, with the reason. Values: `tracked`, `keyframe`, `matches`, `reference_keyframe_ns` (the '
    'keyframe a pose is relative to), `lost_s` (for how long), `recovered_after_s` (once), '
    '`in_map_s` (for how long the place in the map has been known), `place_sigma_m` and '
    '`place_sigma_rad` (how well, one sigma), '
    '`submap` (1: mapped in a submap that was merged later), `blind` (1: no image shows the pose), '
    '`repeated` (1: the image is the one before), `loops` (closed so far), '
    '`moving` (how many points are seen to move), '
    '`input_faults` (JSON), `remarks` (what seems wrong with a sensor), '
    '`processing_ms`, `rss_mb`.',
    FLOOR: 'One status per keyframe: OK, or ERROR with the reason, e.g. which topic has not '
    'delivered. Values: `processing_ms`, `rss_mb`.',
    CLOUD: 'One status per keyframe: OK, or ERROR with the reason, e.g. which topic has not '
    'delivered. Values: `points`, `processing_ms`, `rss_mb`.',
    GRID: 'One status per keyframe: OK, or ERROR with the reason, e.g. which topic has not '
    'delivered. Values: `processing_ms`, `rss_mb`.',
    ROBOT: 'One status per frame sent (`frame_index`).',
    MASKS: 'One status per image processed.',
}


def page(node: str) -> str:
    """Return the page of a node in Markdown."""
    stage = (STAGE_SETTINGS.get(node) or NODE_SETTINGS[node]).specs()
    names = {spec.name for spec in stage}
    own = [spec for spec in NODE_SETTINGS[node].specs() if spec.name not in names]
    sections = [
        f'# {node}',
        PURPOSE[node],
        '## Subscribes to',
        _topics(subscribed_by(node, alternatives=True))
        or f'Nothing (at rate 0 or lossless: {", ".join(f"`{name}`" for name in PACED_BY)}).',
        '## Publishes',
        _topics([*published_by(node, alternatives=True), DIAGNOSTICS], are_published=True),
        STATUS[node] + ' Once a second `connections` lists the subscribers of each topic, and '
        '`health` has the state of the node: `state`, `rate_hz` and `delay_s` of each input, how '
        'many keyframes or frames were `processed`, `failed` or `dropped`, `processing_ms`, '
        '`rss_mb`, and in words what is wrong and the remedy.',
    ]
    sections += ['## Services', _table(('service', 'type', 'what it does'), SERVICES[node])]
    sections += [MANAGED]
    if node in (SLAM, FLOOR, CLOUD):
        sections += [ON_DEMAND]
    if node in STAGE_SETTINGS:
        names_of = [BASIC.get(section, {}) for section in (f'/**/{node}', '/**')]
        basic = [name for values in names_of for name in values.get('ros__parameters', {})]
        specs = {spec.name: spec for spec in (*stage, *own)}
        first = [specs.pop(name) for name in basic if name in specs]
        sections += ['## Basic parameters', _parameters(first)]
        sections += ['## Advanced parameters', _parameters(list(specs.values()))]
    else:
        sections += ['## Parameters', _parameters([*stage, *own])]
    if own and node in STAGE_SETTINGS:
        of_node = ', '.join(f'`{spec.name}`' for spec in own)
        sections.append(f'`segfloor run` ignores what only the node has: {of_node}.')
    sections.append(
        'Live parameters can be set while the node runs; the others are read at its start.'
    )
    return '\n\n'.join(sections) + '\n'


def _topics(topics: list[Topic], are_published: bool = False) -> str:
    profiles = [t.offered if are_published else t.profile for t in topics]
    rows = [
        (
            f'`{t.name}`',
            f'`{t.type_name}`',
            f'{describe_policies(profile)}, depth {profile.depth}',
            ABOUT[t.name],
        )
        for t, profile in zip(topics, profiles, strict=True)
    ]
    return _table(('topic', 'type', 'QoS', 'what it holds'), rows) if rows else ''


def _parameters(specs: list[SettingSpec]) -> str:
    rows = [
        (
            f'`{spec.name}`',
            _value(spec),
            spec.unit or '–',
            spec.range_text().removesuffix(f' {spec.unit}') or '–',
            'yes' if spec.live else 'no',
            spec.description,
        )
        for spec in specs
    ]
    return _table(('parameter', 'default', 'unit', 'range', 'live', 'meaning'), rows)


def _value(spec: SettingSpec) -> str:
    if isinstance(spec.default, float) and math.isnan(spec.default):
        return '`.nan`'
    if isinstance(spec.default, bool):
        return f'`{str(spec.default).lower()}`'
    return f'`{spec.default}`' if spec.default != '' else "`''`"


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, tuple('---' for _ in head), *rows]
    return '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines)


def main() -> None:
    """Write all pages."""
    PAGES.mkdir(exist_ok=True)
    for node in (*NODES, ROBOT, MASKS):
        (PAGES / f'{node}.md').write_text(page(node))


if __name__ == '__main__':
    main()
