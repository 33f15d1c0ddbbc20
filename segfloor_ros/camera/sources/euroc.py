"""EuRoC ASL folders: cam0 and cam1, each with data.csv, sensor.yaml and data/."""

from __future__ import annotations

from pathlib import Path

from segfloor_ros.camera.calibration import StereoCalibration
from segfloor_ros.camera.calibration_files import read_body_pose, read_calibration
from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.camera.sources.files import FilePair, FilePairSource, images_in
from segfloor_ros.camera.sources.found_calibration import given_calibration
from segfloor_ros.camera.sources.pairing import Stamped, StampPairing
from segfloor_ros.camera.sources.sensor_files import IMU, folder_sensors
from segfloor_ros.camera.sources.stamps import check_forward
from segfloor_ros.errors import InputError
from segfloor_ros.measurements import RecordedSensor

CAMERAS = ('cam0', 'cam1')
IMU_FOLDER = 'imu0'
INDEX = 'data.csv'
SENSOR = 'sensor.yaml'


def is_euroc(folder: Path) -> bool:
    """Whether `folder` (or its `mav0`) looks like an EuRoC sequence."""
    root = _root(folder)
    return any((root / cam / name).exists() for cam in CAMERAS for name in (INDEX, SENSOR))


def open_euroc(folder: Path, settings: StereoCameraSettings) -> FilePairSource:
    """Open an EuRoC ASL folder. Left and right are paired by their stamps.

    Raises InputError or CalibrationError.
    """
    root = _root(folder)
    left, right = (_read_index(root / camera) for camera in CAMERAS)
    names = (str(root / CAMERAS[0]), str(root / CAMERAS[1]))
    pairing: StampPairing[Path] = StampPairing(settings.pairing_tolerance_s, names, limit=None)
    matches = [
        *(pair for image in left for pair in pairing.add(0, image.stamp_ns, image.item)),
        *(pair for image in right for pair in pairing.add(1, image.stamp_ns, image.item)),
        *pairing.finish(),
    ]
    pairing.report()
    pairs = [
        FilePair(i, one.stamp_ns, one.item, other.item) for i, (one, other) in enumerate(matches)
    ]
    calibration = _calibration(root, settings)
    sensors = _sensors(root, calibration, settings)
    return FilePairSource(str(folder), pairs, calibration, settings.bit_depth, sensors)


def _root(folder: Path) -> Path:
    return folder / 'mav0' if (folder / 'mav0').is_dir() else folder


def _calibration(root: Path, settings: StereoCameraSettings) -> StereoCalibration:
    given = given_calibration(settings)
    left, right = (root / camera / SENSOR for camera in CAMERAS)
    return given if given is not None else read_calibration(left, right)


def _sensors(
    root: Path, calibration: StereoCalibration, settings: StereoCameraSettings
) -> list[RecordedSensor]:
    """The IMU of imu0 is turned into the rectified left optical frame by both `T_BS`."""
    imu, ignored = root / IMU_FOLDER / INDEX, settings.ignored_sensors
    if not imu.exists() or IMU in ignored:
        return folder_sensors(root, ignored, None, imu)
    T_body_left, T_body_imu = (read_body_pose(root / n / SENSOR) for n in (CAMERAS[0], IMU_FOLDER))
    R_left_imu = calibration.left.R @ T_body_left[:3, :3].T @ T_body_imu[:3, :3]
    return folder_sensors(root, ignored, R_left_imu, imu)


def _read_index(camera: Path) -> list[Stamped[Path]]:
    """Return the images of one camera with their stamps; without data.csv their names tell them."""
    if not (camera / 'data').is_dir():
        raise InputError(f'{camera / "data"}: no such folder; a stereo pair is cam0 and cam1')
    index = camera / INDEX
    if not index.exists():
        images = [path for path in images_in(camera / 'data') if path.stem.isdigit()]
        return [Stamped(int(path.stem), path) for path in images]
    present = {path.name for path in images_in(camera / 'data')}
    entries: list[Stamped[Path]] = []
    for number, line in enumerate(index.read_text(errors='replace').splitlines(), 1):
        if not line.strip() or line.startswith('#'):
            continue
        entry = _entry(camera, line, f'{index}, line {number}')
        check_forward(f'{index}, line {number}', [e.stamp_ns for e in entries[-1:]], entry.stamp_ns)
        if entry.item.name not in present:
            raise InputError(
                f'{index}, line {number}: {entry.item} does not exist; complete the copy, or '
                'remove the line'
            )
        entries.append(entry)
    return entries


def _entry(camera: Path, line: str, where: str) -> Stamped[Path]:
    stamp, _, name = line.partition(',')
    if not stamp.strip().isdigit():
        raise InputError(f'{where}: expected a stamp in ns and a file name')
    return Stamped(int(stamp), camera / 'data' / (name.strip() or f'{stamp.strip()}.png'))
