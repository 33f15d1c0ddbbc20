"""What the stages cost: time, memory and throughput on generated data of growing size.

Each workload is a process of its own, so that its memory is not filled from what others left.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import platform
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import cv2
import numpy as np

from segfloor_ros import __version__
from segfloor_ros.benchmark.chain import MeasuredStages, Workload
from segfloor_ros.benchmark.corridor import CAMERA, MOUNT, Corridor, CorridorImages
from segfloor_ros.configuration import Configuration
from segfloor_ros.errors import SegfloorError, SettingsError

IMAGES = 'images'
JSON_VERSION = 1

Progress = Callable[[int], None]
"""Told how many steps are done."""


@dataclasses.dataclass(frozen=True)
class BenchmarkPlan:
    """What to measure. sizes: numbers of keyframes for labelling and grid. frames: image pairs
    for all stages. seed: of the generated data. threads: of OpenCV; one compares best.
    """

    sizes: tuple[int, ...] = (10, 100, 1000)
    frames: int = 100
    seed: int = 0
    threads: int = 1


def parse_sizes(text: str) -> tuple[int, ...]:
    """Return the numbers of keyframes in `10,100,1000`. Raises SettingsError."""
    try:
        sizes = tuple(int(part) for part in text.split(','))
    except ValueError:
        sizes = (0,)
    if min(sizes) < 1:
        raise SettingsError(f'--sizes {text}: expected numbers of keyframes, e.g. 10,100,1000')
    return sizes


def run_benchmark(
    plan: BenchmarkPlan, configuration: Configuration, announce: Callable[[str, int], Progress]
) -> list[Workload]:
    """Measure all stages on images, then labelling and grid at every size, each in a process of
    its own. announce: told the name of a workload and its number of steps; returns whom to tell how
    many are done.
    """
    workloads = [
        run_apart(measure_images, plan, configuration, on_progress=announce('images', plan.frames))
    ]
    for size in plan.sizes:
        report = announce(f'{size} keyframes', size)
        workloads.append(run_apart(measure_map, plan, size, configuration, on_progress=report))
    return workloads


def measure_images(
    plan: BenchmarkPlan, configuration: Configuration, on_progress: Progress
) -> Workload:
    """Measure all stages on generated stereo images."""
    cv2.setNumThreads(plan.threads)
    stages = MeasuredStages(CAMERA, configuration, MOUNT)
    for frame in CorridorImages(plan.frames, plan.seed).drive():
        stages.process(frame)
        on_progress(stages.frames)
    return stages.workload(IMAGES)


def measure_map(
    plan: BenchmarkPlan, keyframes: int, configuration: Configuration, on_progress: Progress
) -> Workload:
    """Measure labelling and grid on a number of generated keyframes."""
    cv2.setNumThreads(plan.threads)
    stages = MeasuredStages(CAMERA, configuration, MOUNT)
    for done, keyframe in enumerate(Corridor(keyframes, plan.seed).drive(), start=1):
        stages.update_map(keyframe)
        on_progress(done)
    return stages.workload(f'{keyframes} keyframes')


def as_document(plan: BenchmarkPlan, workloads: list[Workload]) -> dict[str, Any]:
    """Return plan, machine and figures as plain numbers for a JSON file."""
    return {
        'version': JSON_VERSION,
        'segfloor_ros': __version__,
        'machine': machine(),
        'plan': dataclasses.asdict(plan),
        'workloads': [dataclasses.asdict(workload) for workload in workloads],
    }


def machine() -> dict[str, str]:
    """Return what the figures depend on besides the program."""
    return {
        'system': platform.platform(),
        'processor': platform.processor() or platform.machine(),
        'python': platform.python_version(),
        'numpy': np.__version__,
        'opencv': cv2.__version__,
    }


def run_apart(work: Callable[..., Any], *arguments: Any, on_progress: Progress) -> Any:
    """Return `work(*arguments, on_progress)`, done by a new process.

    work: a function of a module; its arguments and result are pickled. Its known errors are raised
    here. Raises SegfloorError when the process ends early.
    """
    context = multiprocessing.get_context('spawn')
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(sender, work, arguments), daemon=True)
    process.start()
    sender.close()
    try:
        while True:
            kind, value = receiver.recv()
            if kind == 'result':
                return value
            if kind == 'error':
                raise value
            on_progress(value)
    except EOFError:
        process.join()
        raise SegfloorError(
            f'a process of the benchmark ended early (status {process.exitcode}); '
            'if memory is short, choose smaller --sizes'
        ) from None
    finally:
        process.terminate()
        process.join()


def _serve(sender: Connection, work: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    try:
        sender.send(('result', work(*arguments, lambda done: sender.send(('progress', done)))))
    except SegfloorError as error:
        sender.send(('error', error))
