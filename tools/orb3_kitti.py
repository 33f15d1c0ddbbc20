#!/usr/bin/env python3
"""ORB-SLAM3 on a rectified stereo recording in the layout of KITTI, in upstream's settings:
`tools/orb3_kitti.py VOCABULARY DIR --out PATH.txt`.

Install it by `pip install pyorbslam3==0.1.1 opencv-python-headless`; the libraries libgl1, libegl1
and libopengl0 must be there. A link to this file as `FOLDER/bin/orb3_kitti` makes it a runner of
`tools.published_peers`; `tools.vocabulary_text` writes a vocabulary.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

WIDE_PX = 1000
"""Images wider than this have upstream's settings of KITTI 04 to 12, others those of EuRoC."""

SETTINGS = """%YAML:1.0
Camera.type: "PinHole"
Camera.fx: {fx:.9f}
Camera.fy: {fy:.9f}
Camera.cx: {cx:.9f}
Camera.cy: {cy:.9f}
Camera.k1: 0.0
Camera.k2: 0.0
Camera.p1: 0.0
Camera.p2: 0.0
Camera.bf: {bf:.9f}
Camera.width: {width}
Camera.height: {height}
Camera.fps: {rate_hz:.3f}
Camera.RGB: 1
ThDepth: {far:.1f}
ORBextractor.nFeatures: {features}
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: {corner}
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.6
Viewer.KeyFrameLineWidth: 2.0
Viewer.GraphLineWidth: 1.0
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.7
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -100.0
Viewer.ViewpointZ: -0.1
Viewer.ViewpointF: 2000.0
"""
"""bf: baseline times focal length. ThDepth: points farther than so many baselines are far. The
viewer's values must be there, although none is shown. The newer format (`File.version`) fails here
with cameras of the type Rectified.
"""


@dataclass(frozen=True)
class Recording:
    """Frames with times (N,) in seconds; f, c: focal lengths and principal point in pixels."""

    folder: Path
    times_s: tuple[float, ...]
    f: tuple[float, float]
    c: tuple[float, float]
    baseline_m: float

    def image(self, camera: int, index: int) -> np.ndarray:
        """Return a grey image. Raises SystemExit where there is none."""
        path = self.folder / f'image_{camera}' / f'{index:06d}.png'
        found = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if found is None:
            raise SystemExit(f'{path}: no image')
        return np.asarray(found)

    @property
    def interval_s(self) -> float:
        """The mean time from one frame to the next."""
        return (self.times_s[-1] - self.times_s[0]) / max(len(self.times_s) - 1, 1) or 0.1


def read_recording(folder: Path) -> Recording:
    """Read calib.txt (P0, P1) and times.txt."""
    lines = [line.split() for line in (folder / 'calib.txt').read_text().splitlines() if line]
    P = {line[0]: np.array(line[1:], float).reshape(3, 4) for line in lines}
    left, right = P['P0:'], P['P1:']
    times_s = tuple(map(float, (folder / 'times.txt').read_text().split()))
    baseline_m = left[0, 3] / left[0, 0] - right[0, 3] / right[0, 0]
    f, c = (left[0, 0], left[1, 1]), (left[0, 2], left[1, 2])
    return Recording(folder, times_s, f, c, float(baseline_m))


def settings(recording: Recording) -> str:
    """Return the text of ORB-SLAM3's settings for a recording."""
    height, width = recording.image(0, 0).shape
    features, corner, far = (2000, 12, 40.0) if width > WIDE_PX else (1200, 20, 60.0)
    return SETTINGS.format(
        fx=recording.f[0],
        fy=recording.f[1],
        cx=recording.c[0],
        cy=recording.c[1],
        bf=recording.f[0] * recording.baseline_m,
        far=far,
        width=width,
        height=height,
        rate_hz=1 / recording.interval_s,
        features=features,
        corner=corner,
    )


def track(vocabulary: Path, recording: Recording, out: Path) -> str:
    """Track all frames at the recording's own pace, write the path (TUM), and return a line of what
    was found.
    """
    import pyorbslam3  # here: what reads the recording does without it

    file = out.with_name(f'{out.name}.orb3.yaml')
    file.write_text(settings(recording))
    slam = pyorbslam3.Slam(str(vocabulary), str(file), pyorbslam3.Sensor.STEREO)
    taken_s, tracked, changes = [], 0, 0
    ends_s = (*recording.times_s[1:], recording.times_s[-1] + recording.interval_s)
    for index, (time_s, end_s) in enumerate(zip(recording.times_s, ends_s, strict=True)):
        left, right = recording.image(0, index), recording.image(1, index)
        begin_s = time.perf_counter()
        tracked += slam.track_stereo(left, right, time_s).ok
        taken_s.append(time.perf_counter() - begin_s)
        changes += slam.map_changed()
        time.sleep(max(end_s - time_s - taken_s[-1], 0))
    slam.shutdown()
    slam.save_trajectory_tum(str(out))
    median_ms = 1000 * statistics.median(taken_s)
    counts = f'frames {len(taken_s)} tracked {tracked} map_changes {changes}'
    return f'orbslam3 {counts} median_ms {median_ms:.2f}'


def main() -> None:
    """Run ORB-SLAM3 over a recording. A loop or an adjustment of the whole map is a change."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('vocabulary', type=Path)
    parser.add_argument('recording', type=Path)
    parser.add_argument('--out', type=Path, required=True)
    arguments = parser.parse_args()
    print(track(arguments.vocabulary, read_recording(arguments.recording), arguments.out))


if __name__ == '__main__':
    main()
