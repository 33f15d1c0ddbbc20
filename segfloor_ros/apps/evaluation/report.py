"""The report of a run: one HTML page with everything in it, readable without a network."""

from __future__ import annotations

import base64
import html
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from segfloor_ros.apps.calibration import CalibrationResult
from segfloor_ros.apps.evaluation.map_score import MapScore, compare, overlay_png, score_map
from segfloor_ros.apps.evaluation.report_pictures import (
    ReportData,
    cloud_picture,
    coverage_picture,
    keyframe_pictures,
    map_picture,
    memory_picture,
    pair_picture,
    read_run,
    v_disparity_picture,
)
from segfloor_ros.apps.results_folder import (
    REPORT,
    SEMANTIC,
    STAGE_COLUMNS,
    memory_growth,
    stage_rows,
)
from segfloor_ros.core.errors import os_errors
from segfloor_ros.core.files.whole import read_bytes
from segfloor_ros.core.files.writing import MARK, add_files
from segfloor_ros.core.floor.pictures import MASK_COLOURS
from segfloor_ros.core.floor.plane.plane import LOOKS, SURE, SWAY

NO_TEXT = re.compile('[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]')
"""In names of files: what controls a terminal, and bytes that are not UTF-8."""

LOCALIZED = 'keyframes, all of the loaded map: the run only localised'

STYLE = Path(__file__).with_name('report.css')


def write_report(run: Path, truth: Path | None = None) -> Path:
    """Write report.html into the results folder of a run and return its path.

    truth: a scene folder or a true map to score against. The recording is opened again for the
    keyframes' images. Raises InputError naming what is missing.
    """
    data = read_run(run, truth)
    page = _page(data)
    path = run / REPORT
    with os_errors(f'{path}: cannot be written'):
        add_files(run, {REPORT: page})
    return path


def calibration_page(
    result: CalibrationResult, figures: list[tuple[str, str]], folder: Path
) -> bytes:
    """Return calibration.html for the files of a calibration in a folder.

    figures: names and values that the page begins with.
    """
    names = [', '.join(path.name for path in view.paths) for view in result.views]
    rows = [
        [name, *(f'{error:.3f}' for error in errors_px)]
        for name, errors_px in zip(names, result.view_errors_px, strict=True)
    ]
    sizes_px = np.linalg.norm(result.view_errors_px[:, :2], axis=1)
    shares = (sizes_px / sizes_px.max()).tolist()
    seen = 'Corners in the left and the right image; orange: those of the worst pair'
    content = [
        _fact_row([(value, name) for name, value in figures]),
        _section('What to do next', _list(result.advice) if result.advice else ''),
        _section('Left out', html.escape(result.left_out)),
        _section('Where the board was seen', _figure(coverage_picture(result), seen)),
        _section('Errors', _table(('pair', 'left px', 'right px', 'rows px', ''), rows, shares)),
        _section('The worst pair, rectified', _figure(pair_picture(result), names[0], 'jpeg')),
    ]
    about = 'Errors are RMS: of the corners in each image, of their rows after rectification.'
    return html_page(f'Segfloor: calibration of {folder.name}', about, ''.join(content))


def _page(data: ReportData) -> bytes:
    sections = [
        _facts(data),
        _section('What to do next', _list(advice(data))),
        _maps(data),
        _keyframes(data),
        _section('Floor profile', _v_disparity(data)),
        _section('Time per stage', _stages(data.summary)),
        _section('Memory', _memory(data.summary)),
        '<h2>Settings</h2><details><summary>as resolved</summary>'
        f'<pre>{html.escape(data.settings_text)}</pre></details>',
    ]
    about = 'An occupancy map from a stereo camera'
    return html_page(f'Segfloor: {data.name}', about, ''.join(sections))


def html_page(title: str, about: str, content: str, style: str = '') -> bytes:
    """Return a page with its content in HTML, in UTF-8. style: CSS beside that of all pages."""
    title = html.escape(title)
    text = (
        f'<!DOCTYPE html>\n<!-- {MARK} -->\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>{title}</title><style>{STYLE.read_text()}{style}</style></head><body>'
        f'<h1>{title}</h1><p class="sub">{html.escape(about)}</p>{content}</body></html>\n'
    )
    return NO_TEXT.sub(' ', text).encode()


def _facts(data: ReportData) -> str:
    summary = data.summary
    height_m, floor = summary['camera_height_m'], summary.get('floor')
    tracked = 100 * summary['tracked_frames'] / max(1, summary['frames'])
    facts = [
        (f'{summary["frames"]}', 'frames'),
        (f'{tracked:.1f} %', 'of them tracked'),
        (f'{_length_m(data):.1f} m', 'of path'),
        (f'{summary["keyframes"]}', 'keyframes' if len(data.keyframes) else LOCALIZED),
        (f'{summary["loops"]}', 'loops closed'),
        (f'{summary["map_updates"]}', 'map updates'),
        (f'{summary["frames_per_s"]:.1f}', 'frames per second'),
        *([] if height_m is None else [(f'{height_m:.3f} m', 'camera above the floor')]),
    ]
    if floor is not None and floor['planes']:
        facts.append((f'{floor["median_m"]:.3f} m', 'above it by single keyframes'))
    return _fact_row(facts) + _scores(data)


def _length_m(data: ReportData) -> float:
    return float(np.linalg.norm(np.diff(data.trajectory[:, :3, 3], axis=0), axis=1).sum())


def advice(data: ReportData) -> list[str]:
    """Return what the figures of a run ask for, the gravest first, each in a line."""
    summary = data.summary
    lines = [
        f'{fault["fault"].replace("_", " ")} ({fault["value"]:g} {fault["unit"]}): '
        f'{fault["remedy"]}'
        for fault in summary.get('input_faults', [])
    ]
    lines += summary.get('sensor_remarks', [])
    lines += _doubts(summary)
    if summary['camera_height_m'] is None:
        lines.append(
            'the mount of the camera stayed unknown, so there is no map: let it see level floor at '
            'the start, or give stereo_slam.camera_height_m, camera_pitch_rad and camera_roll_rad'
        )
    lost = ', '.join(f'{first} to {last}' for first, last in summary['lost_intervals'])
    if lost:
        lines.append(
            f'lost in the frames {lost}: look at these images; slower turns, more light, and '
            'walls with something on them in view help, and so do wheels or an IMU'
        )
    for submap in summary.get('submaps', []):
        if not submap['merged']:
            lines.append(
                f'the frames {submap["first_frame"]} to {submap["last_frame"]} are in no map: end '
                'the drive where it has been before, looking the same way'
            )
    if blind := summary.get('blind_frames', 0):
        lines.append(
            f'{blind} frames show too few features for a pose, which then came from wheels or '
            'gyroscope: more light, or a camera that sees more than plain walls'
        )
    if repeated := summary.get('repeated_frames', 0):
        lines.append(f'{repeated} images are the one before: the driver or the recorder is late')
    if skipped := summary.get('skipped_frames', 0):
        lines.append(f'{skipped} frames could not be read: is the recording whole?')
    failed = summary.get('failed_frames', 0) + summary.get('failed_keyframes', 0)
    if failed:
        lines.append(f'{failed} frames or keyframes failed: the log of the run says why')
    rate_hz = (len(data.times_s) - 1) / max(float(np.ptp(data.times_s)), 1e-9)
    if summary['frames_per_s'] < rate_hz:
        lines.append(
            f'{summary["frames_per_s"]:.1f} frames per second are fewer than the {rate_hz:.1f} of '
            'the camera: this machine would skip some on a robot; smaller images or fewer features '
            '(stereo_slam.num_features) are faster'
        )
    return lines or ['nothing: the figures are sound']


def _doubts(summary: Mapping[str, Any]) -> list[str]:
    """Return why the map may not be that of the whole drive, or not of the floor, each in a line.

    A robot sways, and floor segmentation expects each frame within `SWAY` of the mount. So much may
    the median of the heights above the planes of N keyframes differ, too, and where they are few by
    three of its standard deviations, 1.25 `SWAY` / sqrt(N) for normal values.
    """
    lines = []
    tracked, frames = summary['tracked_frames'], summary['frames']
    if tracked < frames:
        lines.append(
            f'{tracked} of {frames} frames ({int(100 * tracked / frames)}%) are in the map: it '
            'shows a part of the drive'
        )
    if summary.get('interrupted'):
        lines.append('the drive was cut short: the map shows what came before')
    height_m, floor = summary['camera_height_m'], summary.get('floor')
    if height_m is None or floor is None:
        return lines
    planes, looks = floor['planes'], floor['looks']
    if not looks:
        return lines
    if planes < min(LOOKS, looks):
        return [
            *lines,
            f'{planes} of {looks} keyframes show the plane of the floor: too few to check the '
            'height of the camera',
        ]
    sway_m, sigmas = SWAY[2] * height_m, SURE * 1.25 / math.sqrt(planes)
    if abs(floor['median_m'] - height_m) > sway_m * max(1, sigmas):
        lines.append(
            f'the mount says that the camera is {height_m:.3f} m above the floor, single keyframes '
            f'show {floor["median_m"]:.3f} m: measure it, and give stereo_slam.camera_height_m'
        )
    of_thirds = math.sqrt(2 * 3) * sigmas  # the difference of two medians of N / 3
    if abs(floor['last_m'] - floor['first_m']) > sway_m * max(1, of_thirds):
        lines.append(
            f'the height of the camera above the floor changes from {floor["first_m"]:.3f} to '
            f'{floor["last_m"]:.3f} m along the drive: is it fixed to the robot?'
        )
    return lines


def _scores(data: ReportData) -> str:
    """Return the scores against the truth, where there is one."""
    if data.truth is None:
        return ''
    facts = _map_facts(score_map(data.grid, data.truth))
    if data.truth_folder is not None and (data.truth_folder / 'poses.txt').is_file():
        facts.append(_path_fact(data.folder, data.truth_folder))
    return '<h2>Against the truth</h2>' + _fact_row(facts)


def _path_fact(run: Path, truth: Path) -> tuple[str, str]:
    # Imported here: evo is needed for this alone, and is an extra.
    try:
        from segfloor_ros.apps.evaluation.trajectory import match_files, score_trajectory
    except ModuleNotFoundError:
        return '–', "path error: pip install 'segfloor_ros[evaluate]'"
    path = score_trajectory(match_files(run, truth))
    return f'{path.ate_rmse_m:.3f} m', f'path error over {path.path_length_m:.1f} m'


def _map_facts(score: MapScore) -> list[tuple[str, str]]:
    return [
        (f'{100 * score.opened.precision.mean:.1f} %', 'road-map precision'),
        (f'{100 * score.opened.recall.mean:.1f} %', 'road-map recall'),
        (f'{100 * score.cells.free_precision:.1f} %', 'free cells right'),
        (f'{100 * score.cells.free_recall:.1f} %', 'floor found'),
    ]


def _maps(data: ReportData) -> str:
    figures = [_figure(map_picture(data), 'Map with the path of the robot')]
    classes = data.folder / SEMANTIC
    if classes.is_file():
        figures.append(_figure(read_bytes(classes), 'Classes that a network saw'))
    if data.truth is not None:
        overlay = overlay_png(compare(data.grid, data.truth))
        figures.append(_figure(overlay, 'Map laid on the true one'))
    figures.append(_figure(cloud_picture(data), 'Labelled cloud from above'))
    return f'<h2>Map</h2><div class="row">{"".join(figures)}</div>'


def _keyframes(data: ReportData) -> str:
    figures = [_figure(picture, name, 'jpeg') for name, picture in keyframe_pictures(data)]
    if not figures:
        return ''
    return f'<h2>Keyframes</h2>{_legend(MASK_COLOURS)}<div class="strip">{"".join(figures)}</div>'


def _legend(colours: Mapping[str, tuple[int, int, int]]) -> str:
    """Return what colours (BGR) stand for."""
    return '<p class="sub">{}</p>'.format(
        ' '.join(
            f'<span class="colour" style="background: rgb{colour[::-1]}"></span>{name}'
            for name, colour in colours.items()
        )
    )


def _list(lines: Sequence[str]) -> str:
    return '<ul class="next">{}</ul>'.format(
        ''.join(f'<li>{html.escape(line)}</li>' for line in lines)
    )


def _v_disparity(data: ReportData) -> str:
    picture = v_disparity_picture(data)
    caption = 'Pixels per image row and disparity, without obstacles; the line is the fitted floor'
    return _figure(picture, caption) if picture is not None else ''


def _stages(summary: dict[str, Any]) -> str:
    stages = summary['stages']
    longest = max([stage['p95_ms'] for stage in stages.values()] or [1.0])
    shares = [stage['p50_ms'] / longest for stage in stages.values()]
    return _table((*STAGE_COLUMNS, ''), stage_rows(stages), shares)


def _table(names: tuple[str, ...], rows: list[list[str]], shares: list[float]) -> str:
    """Return rows with a bar at the end of each, empty without rows. shares: of its full length."""
    head = ''.join(f'<th>{name}</th>' for name in names)
    lines = ''.join(
        f'<tr>{"".join(f"<td>{html.escape(cell)}</td>" for cell in row)}'
        f'<td class="bar"><div style="width:{100 * share:.1f}%"></div></td></tr>'
        for row, share in zip(rows, shares, strict=True)
    )
    return f'<div class="scroll"><table><tr>{head}</tr>{lines}</table></div>' if rows else ''


def _memory(summary: dict[str, Any]) -> str:
    memory = summary.get('rss_mb', {})
    if not memory:
        return ''
    facts = [
        (f'{memory["start"]:.0f} MB', 'at the start'),
        (f'{memory["peak"]:.0f} MB', 'at most'),
        (memory_growth(memory), 'more per map update'),
    ]
    picture = memory_picture(memory)
    drawn = _figure(picture, 'Memory over the map updates') if picture else ''
    return _fact_row(facts) + drawn


def _section(title: str, content: str) -> str:
    return f'<h2>{title}</h2>{content}' if content else ''


def _fact_row(facts: list[tuple[str, str]]) -> str:
    """Return values, each with what it is, side by side."""
    cells = (
        f'<div class="fact"><b>{html.escape(value)}</b><span>{html.escape(what)}</span></div>'
        for value, what in facts
    )
    return f'<div class="facts">{"".join(cells)}</div>'


def _figure(picture: bytes, caption: str, kind: str = 'png') -> str:
    data = base64.b64encode(picture).decode()
    text = html.escape(caption)
    return (
        f'<figure><img alt="{text}" src="data:image/{kind};base64,{data}">'
        f'<figcaption>{text}</figcaption></figure>'
    )
