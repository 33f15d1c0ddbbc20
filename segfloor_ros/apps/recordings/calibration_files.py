"""Calibration files: of ROS camera_calibration, EuRoC (sensor.yaml), Kalibr (camchain.yaml) and
KITTI (calib.txt); read, written, and found beside a recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from segfloor_ros.apps.recordings.extrinsics import calibration_from_extrinsics
from segfloor_ros.apps.recordings.other_calibrations import SUFFIXES, form_of, read_other
from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.errors import CalibrationError
from segfloor_ros.core.files.whole import number, read_lines
from segfloor_ros.core.files.writing import MARK
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.nodes.yaml_files import read_yaml

KALIBR_NAMES = ('camchain.yaml', 'dso/camchain.yaml')
"""Both cameras are in one file; TUM-VI has it in `dso`."""

OTHER_SIZE = 2**0.5
"""A principal point farther off by this factor, both ways, is nearer to the middle of images of
twice or half the size."""

FILE_NAMES = (
    ('left.yaml', 'right.yaml'),
    ('left.yml', 'right.yml'),
    ('left_camera.yaml', 'right_camera.yaml'),
    ('camera_left.yaml', 'camera_right.yaml'),
    ('left/left.yaml', 'right/right.yaml'),
    ('left/camera.yaml', 'right/camera.yaml'),
    ('calibration/left.yaml', 'calibration/right.yaml'),
    ('calib/left.yaml', 'calib/right.yaml'),
    *((name, name) for name in KALIBR_NAMES),
    ('cam0/sensor.yaml', 'cam1/sensor.yaml'),
)


def read_calibration(left: Path, right: Path, is_rectified: bool = False) -> StereoCalibration:
    """Read a pair of ROS camera calibration files or of EuRoC sensor files, or one file of Kalibr,
    twice. is_rectified: for images that are rectified already.

    Raises CalibrationError naming the file when one is missing, incomplete or impossible.
    """
    paths = [*dict.fromkeys((left, right))]
    if form_of(*paths) is not None:
        found = read_other(*paths)
        return found.rectified() if is_rectified else found
    documents = _read(left), _read(right)
    if all('T_BS' in document for document in documents):
        return _from_euroc(left, right, *documents)
    if all('cam1' in document for document in documents):
        return _from_kalibr(left, documents[0])
    eyes = (_ros_eye(d, str(path)) for d, path in zip(documents, (left, right), strict=True))
    return StereoCalibration(*(eye.rectified() if is_rectified else eye for eye in eyes))


def read_kitti_calibration(
    path: Path, width: int, height: int, cameras: tuple[int, int] = (0, 1)
) -> StereoCalibration:
    """Read the projections P0 and P1 (or P2 and P3) of a KITTI odometry `calib.txt`.

    The file does not tell the image size. Geiger et al., Vision meets Robotics, IJRR 2013.
    """
    return StereoCalibration(*(read_kitti_eye(path, width, height, camera) for camera in cameras))


def read_kitti_eye(path: Path, width: int, height: int, camera: int) -> EyeCalibration:
    """Read the projection of one camera of a KITTI odometry `calib.txt`."""
    rows = {}
    for _, line in read_lines(_present(path), CalibrationError):
        name, colon, numbers = line.partition(':')
        if colon:
            rows[name.strip()] = numbers.split()
    name = f'P{camera}'
    if name not in rows:
        raise CalibrationError(f'{path}: no line {name}: with the projection of camera {camera}')
    P = _numbers(rows[name], 12, f'{path}, {name}').reshape(3, 4)
    in_x, in_y = 2 * P[:2, 2] / (width, height)
    if min(in_x, in_y) > OTHER_SIZE or max(in_x, in_y) * OTHER_SIZE < 1:
        raise CalibrationError(
            f'{path}, {name}: the principal point ({P[0, 2]:g}, {P[1, 2]:g}) is the middle of '
            f'images of about {2 * P[0, 2]:.0f}x{2 * P[1, 2]:.0f}, these are {width}x{height}; use '
            'the calibration of images of this size'
        )
    return EyeCalibration.of_rectified(width, height, P, f'{path}, {name}')


def read_eye_calibration(path: Path) -> EyeCalibration:
    """Read one ROS camera calibration file, of which the projection may be missing, or the left
    camera of a file of another form. Raises CalibrationError.
    """
    if form_of(path) is not None:
        return read_other(path).left
    document = dict(_read(path))
    if 'camera_matrix' in document:
        K = _matrix(document['camera_matrix'], 9, f'{path}, camera_matrix').reshape(3, 3)
        P = _matrix(document.get('projection_matrix', [0.0]), None, f'{path}, projection_matrix')
        if not P.any():
            document['projection_matrix'] = {'data': np.hstack([K, np.zeros((3, 1))])}
    return _ros_eye(document, str(path))


def read_body_pose(path: Path) -> Array:
    """Return T_BS (4, 4) of an EuRoC sensor.yaml: from the sensor's frame to the body's.

    Raises CalibrationError.
    """
    return _body_pose(_read(path), path)


def _body_pose(document: Mapping[str, Any], path: Path) -> Array:
    if 'T_BS' not in document:
        raise CalibrationError(f'{path}: T_BS is missing; an EuRoC sensor.yaml has it')
    return _matrix(document['T_BS'], 16, f'{path}, T_BS').reshape(4, 4)


def ros_calibration(eye: EyeCalibration, camera_name: str) -> str:
    """Return one eye as the text of a ROS camera calibration file; numbers are exact."""

    def matrix(values: Array, rows: int) -> dict[str, Any]:
        return {'rows': rows, 'cols': values.size // rows, 'data': values.ravel().tolist()}

    document = {
        'image_width': eye.width,
        'image_height': eye.height,
        'camera_name': camera_name,
        'camera_matrix': matrix(eye.K, 3),
        'distortion_model': eye.distortion_model,
        'distortion_coefficients': matrix(eye.D, 1),
        'rectification_matrix': matrix(eye.R, 3),
        'projection_matrix': matrix(eye.P, 3),
    }
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)
    return f'# {MARK}\n{text}'


def write_ros_calibration(path: Path, eye: EyeCalibration, camera_name: str) -> None:
    """Write one eye as a ROS camera calibration file."""
    path.write_text(ros_calibration(eye, camera_name))


def _ros_eye(document: Mapping[str, Any], origin: str) -> EyeCalibration:
    for key in ('image_width', 'image_height', 'camera_matrix', 'projection_matrix'):
        if key not in document:
            raise CalibrationError(
                f'{origin}: {key} is missing; a stereo calibration in the form of ROS '
                'camera_calibration has it'
            )
    distortion = document.get('distortion_coefficients', {'data': []})
    rectification = document.get('rectification_matrix', {'data': np.eye(3).ravel().tolist()})
    return EyeCalibration(
        _whole(document['image_width'], f'{origin}, image_width'),
        _whole(document['image_height'], f'{origin}, image_height'),
        _matrix(document['camera_matrix'], 9, f'{origin}, camera_matrix'),
        _matrix(distortion, None, f'{origin}, distortion_coefficients'),
        _matrix(rectification, 9, f'{origin}, rectification_matrix'),
        _matrix(document['projection_matrix'], 12, f'{origin}, projection_matrix'),
        str(document.get('distortion_model', 'plumb_bob')),
        origin,
    )


def _from_euroc(
    left: Path, right: Path, left_document: Mapping[str, Any], right_document: Mapping[str, Any]
) -> StereoCalibration:
    """Burri et al., The EuRoC micro aerial vehicle datasets, IJRR 2016: T_BS maps the sensor's
    points into the body frame.
    """
    eyes, poses = [], []
    for path, document in ((left, left_document), (right, right_document)):
        eyes.append(_euroc_eye(document, str(path)))
        poses.append(_body_pose(document, path))
    return calibration_from_extrinsics(eyes[0], eyes[1], invert(poses[1]) @ poses[0])


def _from_kalibr(path: Path, document: Mapping[str, Any]) -> StereoCalibration:
    """Furgale et al., Unified temporal and spatial calibration for multi-sensor systems, IROS 2013:
    T_cn_cnm1 maps points of the camera before into this one.
    """
    left, right = (_kalibr_camera(path, document, name) for name in ('cam0', 'cam1'))
    if 'T_cn_cnm1' not in right:
        raise CalibrationError(f'{path}, cam1: T_cn_cnm1 is missing; calibrate both cameras in one')
    T_right_left = _matrix(right['T_cn_cnm1'], 16, f'{path}, T_cn_cnm1').reshape(4, 4)
    eyes = _euroc_eye(left, f'{path}, cam0'), _euroc_eye(right, f'{path}, cam1')
    return calibration_from_extrinsics(*eyes, T_right_left)


def _kalibr_camera(path: Path, document: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    camera = document.get(name)
    if not isinstance(camera, dict):
        raise CalibrationError(f'{path}: {name} is missing; a camchain.yaml of Kalibr has it')
    return camera


def read_kalibr_imu(path: Path) -> Array:
    """Return T_cam_imu (4, 4) of the left camera in a file of Kalibr: from the IMU's frame to the
    raw left one. Raises CalibrationError.
    """
    camera = _kalibr_camera(path, _read(path), 'cam0')
    if 'T_cam_imu' not in camera:
        raise CalibrationError(
            f'{path}, cam0: T_cam_imu is missing; calibrate the IMU, too, or --ignore imu'
        )
    return _matrix(camera['T_cam_imu'], 16, f'{path}, T_cam_imu').reshape(4, 4)


def _euroc_eye(document: Mapping[str, Any], origin: str) -> EyeCalibration:
    for key in ('resolution', 'intrinsics'):
        if key not in document:
            raise CalibrationError(
                f'{origin}: {key} is missing; an EuRoC sensor.yaml and a camchain.yaml have it'
            )
    lens = document.get('camera_model', 'pinhole')
    if lens != 'pinhole':
        raise CalibrationError(
            f'{origin}: unknown camera model {lens}; calibrate it as pinhole, of a fisheye with '
            'the distortion model equidistant'
        )
    width, height = (
        _numbers(document['resolution'], 2, f'{origin}, resolution').astype(int).tolist()
    )
    fu, fv, cu, cv = _numbers(document['intrinsics'], 4, f'{origin}, intrinsics')
    K = np.array([[fu, 0.0, cu], [0.0, fv, cv], [0.0, 0.0, 1.0]])
    words = ('distortion_coefficients', 'distortion_coeffs')
    word = next((word for word in words if word in document), words[0])
    D = _numbers(document.get(word, []), None, f'{origin}, {word}')
    model = str(document.get('distortion_model', 'plumb_bob'))
    return EyeCalibration.of_raw((width, height), K, D, model, origin)


def _read(path: Path) -> Mapping[str, Any]:
    return read_yaml(_present(path), 'a calibration: names and values', CalibrationError)


def _present(path: Path) -> Path:
    if not path.exists():
        raise CalibrationError(
            f'{path}: the calibration is missing; put it there, or give '
            'stereo_camera.left_calibration and stereo_camera.right_calibration'
        )
    return path


def _matrix(value: Any, count: int | None, where: str) -> Array:
    return _numbers(value.get('data') if isinstance(value, dict) else value, count, where)


def _numbers(value: Any, count: int | None, where: str) -> Array:
    """Return a list of numbers, or of lists of them, or a text of numbers, as one array (N,)."""
    try:
        numbers = np.array([number(str(v)) for v in np.ravel(value).tolist()], np.float64)
    except (TypeError, ValueError):
        raise CalibrationError(f'{where}: expected finite numbers') from None
    if count is not None and numbers.size != count:
        raise CalibrationError(f'{where}: expected {count} numbers, found {numbers.size}')
    return numbers


def _whole(value: Any, where: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise CalibrationError(f'{where} = {value!r}: expected a whole number')
    return value


def given_calibration(
    settings: StereoCameraSettings, is_rectified: bool = False
) -> StereoCalibration | None:
    """Return the calibration that the settings name, or None when they name none. is_rectified:
    the images are rectified already, by their own projections.

    Raises CalibrationError, also when only one of the two files is given.
    """
    left, right = settings.left_calibration, settings.right_calibration
    if not left and not right:
        return None
    if left and not right and holds_both(Path(left)):
        right = left
    if not left or not right:
        raise CalibrationError(
            'stereo_camera.left_calibration and stereo_camera.right_calibration belong together; '
            f'only {left or right} is given'
        )
    return read_calibration(Path(left), Path(right), is_rectified)


def holds_both(path: Path) -> bool:
    """Whether one file has the calibration of both cameras. Raises CalibrationError."""
    return form_of(_present(path)) is not None or (
        path.suffix in ('.yaml', '.yml') and 'cam1' in _read(path)
    )


def given_left_calibration(settings: StereoCameraSettings) -> EyeCalibration | None:
    """Return the calibration that the settings name for the left camera alone, of a depth camera;
    None when they name none. Raises CalibrationError.
    """
    name = settings.left_calibration
    return read_eye_calibration(Path(name)) if name else None


def _both_in(folder: Path) -> list[Path]:
    """Return the files of a folder that hold the calibration of both cameras."""
    found = []
    for path in sorted(folder.iterdir() if folder.is_dir() else ()):
        with suppress(CalibrationError, OSError):  # of another kind
            is_one = path.suffix.lower() in SUFFIXES and path.is_file()
            if is_one and path.stat().st_size < MOST_BYTES:
                found += [path] if holds_both(path) else []
    return found


MOST_BYTES = 1 << 18
"""Of a calibration that is looked for."""


def find_calibration(
    name: str, folders: Sequence[Path], settings: StereoCameraSettings
) -> StereoCalibration:
    """Return the calibration the settings name, else the first found in `folders`.

    Raises CalibrationError saying where one was expected.
    """
    given = given_calibration(settings)
    if given is not None:
        return given
    for folder in folders:
        for left, right in FILE_NAMES:
            if (folder / left).exists() or (folder / right).exists():
                return read_calibration(folder / left, folder / right)
        others = _both_in(folder)
        if len(others) > 1:
            names = ', '.join(path.name for path in others)
            raise CalibrationError(
                f'{folder}: holds several calibrations ({names}); name one of them by '
                'stereo_camera.left_calibration'
            )
        if others:
            return read_calibration(others[0], others[0])
    raise CalibrationError(
        f'{name}: no calibration; put left.yaml and right.yaml (ROS camera_calibration) into '
        f'{folders[0]}, or give stereo_camera.left_calibration and right_calibration'
    )
