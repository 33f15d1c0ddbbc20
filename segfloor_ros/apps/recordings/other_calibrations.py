"""Calibrations of both cameras in one file, as other tools write them: ZED, ROS ost.txt, OAK,
Basalt, ORB-SLAM, OpenCV FileStorage, KITTI raw.

`FORMS` is the table: what each form is called, how it is recognised, and what reads it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from segfloor_ros.apps.recordings.extrinsics import calibration_from_extrinsics
from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.errors import CalibrationError
from segfloor_ros.core.files.whole import json_object, number, read_lines, read_text
from segfloor_ros.core.geometry import Array, invert, make_transform
from segfloor_ros.core.quaternions import transform_from_quaternion
from segfloor_ros.nodes.yaml_files import read_yaml

Size = tuple[int, int]
"""Width and height of images."""

Document = Mapping[str, Any]

ZED_SIZES = {
    '2K': (2208, 1242),
    'FHD': (1920, 1080),
    'FHD1200': (1920, 1200),
    'HD': (1280, 720),
    'HD1200': (1920, 1200),
    'SVGA': (960, 600),
    'VGA': (672, 376),
}
SUFFIXES = ('.yaml', '.yml', '.json', '.conf', '.txt')


class Form(NamedTuple):
    """A form of calibration files: its name, one of the keys that all of its files have, and what
    reads a document for images of a size, None where the file says it.
    """

    name: str
    keys: tuple[str, ...]
    read: Callable[[_Reader], StereoCalibration]


class _Reader:
    """The values of one file by name; errors name the file and the value."""

    def __init__(
        self, path: Path, values: Document, size: Size | None, cameras: tuple[str, str]
    ) -> None:
        self.path, self.values, self.size, self.cameras = path, values, size, cameras

    def error(self, words: str) -> CalibrationError:
        return CalibrationError(f'{self.path}: {words}')

    def has(self, *keys: str) -> bool:
        return all(key in self.values for key in keys)

    def numbers(self, key: str, count: int | None = None, of: Any = None) -> Array:
        """Return the numbers (N,) of a value, or of `of` in its place."""
        value = self.values.get(key) if of is None else of
        value = value.get('data') if isinstance(value, dict) else value
        if value is None:
            raise self.error(f'{key} is missing')
        try:
            found = np.array([number(str(v)) for v in np.ravel(value).tolist()], np.float64)
        except (TypeError, ValueError):
            raise self.error(f'{key}: expected finite numbers') from None
        if count is not None and found.size != count:
            raise self.error(f'{key}: expected {count} numbers, found {found.size}')
        return found

    def first(self, *names: str) -> str:
        """Return the first of some names that the file has."""
        for name in names:
            if name in self.values:
                return name
        raise self.error(f'{names[0]} is missing')

    def image_size(self, *keys: str) -> Size:
        """Return the size of the images by two keys, or as it was given."""
        if self.has(*keys):
            width, height = (int(self.numbers(key, 1)[0]) for key in keys)
            return width, height
        if self.size is None:
            raise self.error(
                'does not say the size of its images; convert it: segfloor calibrate --from '
                f'{self.path} --size WIDTHxHEIGHT --out FOLDER'
            )
        return self.size

    def eye(self, size: Size, K: Array, D: Array, model: str, side: str) -> EyeCalibration:
        return EyeCalibration.of_raw(size, K, D, model, f'{self.path}, {side}')

    def raw_pair(
        self, size: Size, intrinsics: list[tuple[Array, Array, str]], T_right_left: Array
    ) -> StereoCalibration:
        """Return the pair of two raw cameras: K (3, 3), distortion and model of each."""
        left, right = (
            self.eye(size, *one, side) for one, side in zip(intrinsics, SIDES, strict=True)
        )
        return calibration_from_extrinsics(left, right, T_right_left)


SIDES = ('left', 'right')


def _K(fx: float, fy: float, cx: float, cy: float) -> Array:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _zed(file: _Reader) -> StereoCalibration:
    """`SN….conf`: of each resolution; lengths in mm, rotations as a vector in rad."""
    found = {name.rpartition('.')[0][len('LEFT_CAM_') :] for name in file.values if '.fx' in name}
    sizes = {ZED_SIZES[name]: name for name in sorted(found & ZED_SIZES.keys())}
    if not sizes:
        raise file.error('holds no resolution of a ZED (LEFT_CAM_HD, …)')
    size = file.size or (next(iter(sizes)) if len(sizes) == 1 else None)
    if size not in sizes:
        listed = ', '.join(f'{width}x{height}' for width, height in sizes)
        raise file.error(
            f'holds calibrations of images of {listed}; convert that of yours: segfloor calibrate '
            f'--from {file.path} --size WIDTHxHEIGHT --out FOLDER'
        )
    mode = sizes[size]

    def values(section: str, *names: str) -> list[float]:
        return [float(file.numbers(f'{section}.{name}', 1)[0]) for name in names]

    intrinsics = []
    for side in ('LEFT', 'RIGHT'):
        section = f'{side}_CAM_{mode}'
        D = values(section, 'k1', 'k2', 'p1', 'p2', 'k3')
        K = _K(*values(section, 'fx', 'fy', 'cx', 'cy'))
        intrinsics.append((K, np.array(D), 'plumb_bob'))
    turn = values('STEREO', f'RX_{mode}', f'CV_{mode}', f'RZ_{mode}')
    place_m = [
        -1e-3 * float(file.numbers(f'STEREO.{key}', 1)[0]) if file.has(f'STEREO.{key}') else 0.0
        for key in ('Baseline', 'TY', 'TZ')
    ]
    T = make_transform(cv2.Rodrigues(np.array(turn))[0], np.array(place_m))
    return file.raw_pair(size, intrinsics, T)


def _ost(file: _Reader) -> StereoCalibration:
    """`ost.txt` of ROS camera_calibration: both cameras, one after the other."""
    names = [name.rpartition('.')[0] for name in file.values if name.endswith('.camera matrix')]
    names.sort(key=lambda name: 'right' in name)
    if len(names) != 2:
        raise file.error(f'holds {len(names)} cameras; calibrate both in one, as a stereo pair')
    eyes = []
    for name in names:
        D = file.numbers(f'{name}.distortion')
        eyes.append(
            EyeCalibration(
                *file.image_size('image.width', 'image.height'),
                file.numbers(f'{name}.camera matrix', 9),
                D,
                file.numbers(f'{name}.rectification', 9),
                file.numbers(f'{name}.projection', 12),
                'plumb_bob' if D.size < 8 else 'rational_polynomial',
                f'{file.path}, {name}',
            )
        )
    return StereoCalibration(*eyes)


def _oak(file: _Reader) -> StereoCalibration:
    """JSON of DepthAI: cameras by socket, x_to = R x + t with t in cm."""
    cameras = {int(socket): camera for socket, camera in file.values['cameraData']}
    sockets = file.values.get('stereoRectificationData', {})
    left, right = (
        sockets.get(f'{side}CameraSocket', i) for i, side in ((1, SIDES[0]), (2, SIDES[1]))
    )
    for socket in (left, right):
        if socket not in cameras:
            raise file.error(f'holds no camera on socket {socket}, one of the stereo pair')

    def to_root(socket: int, end: int) -> tuple[int, Array]:
        """Return the camera `end`, or else the last one, that a chain of extrinsics leads to, and
        T_last_socket.
        """
        T, passed = np.eye(4), set()
        while socket != end and socket not in passed:
            passed.add(socket)
            extrinsics = cameras[socket].get('extrinsics', {})
            onwards = int(extrinsics.get('toCameraSocket', -1))
            if onwards not in cameras:
                break
            place = extrinsics['translation']
            t_m = 0.01 * file.numbers('translation', 3, [place[axis] for axis in 'xyz'])
            R = file.numbers('rotationMatrix', 9, extrinsics['rotationMatrix']).reshape(3, 3)
            T, socket = make_transform(R, t_m) @ T, onwards
        return socket, T

    left_root, T_root_left = to_root(left, right)
    right_root, T_root_right = to_root(right, left_root)
    if left_root != right_root:
        raise file.error('its extrinsics do not connect both cameras; calibrate the device again')
    intrinsics = []
    for socket in (left, right):
        camera = cameras[socket]
        D = file.numbers('distortionCoeff', None, camera['distortionCoeff'])
        is_fisheye = camera.get('cameraType') == 1
        K = file.numbers('intrinsicMatrix', 9, camera['intrinsicMatrix']).reshape(3, 3)
        model = 'equidistant' if is_fisheye else 'rational_polynomial'
        intrinsics.append((K, D[:4] if is_fisheye else D[:14], model))
    size = int(cameras[left]['width']), int(cameras[left]['height'])
    return file.raw_pair(size, intrinsics, invert(T_root_right) @ T_root_left)


def _basalt(file: _Reader) -> StereoCalibration:
    """JSON of Basalt (Usenko et al., RA-L 2020): T_imu_cam of each camera."""
    values = file.values['value0']
    intrinsics, T_imu = [], []
    for camera, pose in zip(values['intrinsics'][:2], values['T_imu_cam'][:2], strict=True):
        model, lens = camera['camera_type'], camera['intrinsics']
        terms = {
            'kb4': ('equidistant', ('k1', 'k2', 'k3', 'k4')),
            'pinhole': ('plumb_bob', ()),
            'pinhole-radtan8': (
                'rational_polynomial', ('k1', 'k2', 'p1', 'p2', 'k3', 'k4', 'k5', 'k6'),
            ),
        }.get(model)  # fmt: skip
        if terms is None:
            raise file.error(
                f'unknown camera model {model}; calibrate it as kb4 or pinhole-radtan8'
            )
        K = _K(*(float(lens[key]) for key in ('fx', 'fy', 'cx', 'cy')))
        D = np.array([float(lens[key]) for key in terms[1]])
        intrinsics.append((K, D, terms[0]))
        place_m, quat_xyzw = (
            np.array([float(pose[f'{word}{axis}']) for axis in axes])
            for word, axes in (('p', 'xyz'), ('q', 'xyzw'))
        )
        T_imu.append(transform_from_quaternion(place_m, quat_xyzw))
    if len(T_imu) != 2:
        raise file.error('holds one camera; a stereo pair has two')
    width, height = file.numbers('resolution', 2, values['resolution'][0]).astype(int).tolist()
    return file.raw_pair((width, height), intrinsics, invert(T_imu[1]) @ T_imu[0])


def _orb_slam(file: _Reader) -> StereoCalibration:
    """YAML of ORB-SLAM 2 and 3: both raw cameras, or a rectified one with its baseline."""
    size = file.image_size('Camera.width', 'Camera.height')
    if file.has('LEFT.K', 'RIGHT.P'):
        return _rectified_by(file, size, *(f'{side}.{{}}' for side in ('LEFT', 'RIGHT')))

    def terms(camera: str, *names: str) -> list[float]:
        keys = (f'{camera}.{name}' for name in names)
        return [float(file.numbers(key, 1)[0]) for key in keys if file.has(key)]

    name = 'Camera1' if file.has('Camera1.fx') else 'Camera'
    kind = str(file.values.get('Camera.type', 'PinHole'))
    sides = (name, name if kind == 'Rectified' else 'Camera2')
    intrinsics = []
    for side in sides if file.has('Stereo.T_c1_c2') else (name,):
        K = _K(*(float(file.numbers(f'{side}.{key}', 1)[0]) for key in ('fx', 'fy', 'cx', 'cy')))
        if kind == 'KannalaBrandt8':
            lens, model = terms(side, 'k1', 'k2', 'k3', 'k4'), 'equidistant'
        else:
            lens, model = terms(side, 'k1', 'k2', 'p1', 'p2', 'k3'), 'plumb_bob'
        intrinsics.append((K, np.array(lens), model))
    if len(intrinsics) == 2:
        T_left_right = file.numbers('Stereo.T_c1_c2', 16).reshape(4, 4)
        return file.raw_pair(size, intrinsics, invert(T_left_right))
    K, D, _ = intrinsics[0]
    if D.any():
        raise file.error('holds one camera with distortion; a stereo pair has Camera2 and T_c1_c2')
    if file.has('Stereo.b'):
        baseline_m = float(file.numbers('Stereo.b', 1)[0])
    else:
        baseline_m = float(file.numbers(file.first('Camera.bf'), 1)[0]) / K[0, 0]
    shift = np.array([[-K[0, 0] * baseline_m], [0.0], [0.0]])
    eyes = (
        EyeCalibration.of_rectified(*size, np.hstack([K, t]), f'{file.path}, {side}')
        for t, side in ((np.zeros((3, 1)), 'left'), (shift, 'right'))
    )
    return StereoCalibration(*eyes)


def _rectified_by(file: _Reader, size: Size, *forms: str) -> StereoCalibration:
    """Return the pair of files that have K, D, R and P of both sides. forms: of their names."""
    eyes = (
        EyeCalibration(
            *size,
            file.numbers(form.format('K'), 9),
            file.numbers(form.format('D')),
            file.numbers(form.format('R'), 9),
            file.numbers(form.format('P'), 12),
            origin=f'{file.path}, {side}',
        )
        for form, side in zip(forms, SIDES, strict=True)
    )
    return StereoCalibration(*eyes)


def _opencv(file: _Reader) -> StereoCalibration:
    """YAML of `cv::FileStorage` with what `cv::stereoCalibrate` returns, by its usual names."""
    names = [
        (
            file.first(*(f'{word}{i}' for word in ('M', 'K', 'cameraMatrix', 'camera_matrix'))),
            file.first(*(f'{word}{i}' for word in ('D', 'distCoeffs', 'dist_coeffs'))),
        )
        for i in (1, 2)
    ]
    if file.has('image_size') or file.has('size'):
        width, height = file.numbers(file.first('image_size', 'size'), 2).astype(int).tolist()
        size = width, height
    else:
        size = file.image_size('image_width', 'image_height')
    intrinsics = []
    for K, D in names:
        terms = file.numbers(D)
        model = 'plumb_bob' if terms.size <= 5 else 'rational_polynomial'
        intrinsics.append((file.numbers(K, 9).reshape(3, 3), terms, model))
    R, t = file.numbers('R', 9).reshape(3, 3), file.numbers('T', 3)
    return file.raw_pair(size, intrinsics, make_transform(R, t))


def _kitti_raw(file: _Reader) -> StereoCalibration:
    """`calib_cam_to_cam.txt`: of rectified images, unless the size is that of raw ones."""
    sizes: dict[Size, str] = {}
    for kind in ('', '_rect'):
        width, height = file.numbers(f'S{kind}_00', 2).astype(int).tolist()
        sizes[width, height] = kind
    size = file.size or next(size for size, kind in sizes.items() if kind)
    if size not in sizes:
        listed = ' or '.join(f'{width}x{height}' for width, height in sizes)
        raise file.error(f'is for images of {listed}, these are {size[0]}x{size[1]}')
    eyes = []
    for i in file.cameras:
        P = file.numbers(f'P_rect_{i}', 12)
        if sizes[size]:
            eyes.append(EyeCalibration.of_rectified(*size, P, f'{file.path}, P_rect_{i}'))
            continue
        K, D, R = (file.numbers(f'{key}_{i}') for key in ('K', 'D', 'R_rect'))
        eyes.append(EyeCalibration(*size, K, D, R, P, origin=f'{file.path}, K_{i}'))
    return StereoCalibration(*eyes)


FORMS = (
    Form('ZED', ('STEREO.Baseline',), _zed),
    Form('ost.txt of ROS', ('image.width', 'image.height'), _ost),
    Form('OAK', ('cameraData',), _oak),
    Form('Basalt', ('value0',), _basalt),
    Form('ORB-SLAM', ('Camera.fx',), _orb_slam),
    Form('ORB-SLAM', ('Camera1.fx',), _orb_slam),
    Form('ORB-SLAM', ('LEFT.K', 'RIGHT.K'), _orb_slam),
    Form('OpenCV', ('R', 'T', 'M1', 'M2'), _opencv),
    Form('OpenCV', ('R', 'T', 'K1', 'K2'), _opencv),
    Form('OpenCV', ('R', 'T', 'cameraMatrix1', 'cameraMatrix2'), _opencv),
    Form('OpenCV', ('R', 'T', 'camera_matrix1', 'camera_matrix2'), _opencv),
    Form('KITTI raw', ('P_rect_00', 'P_rect_01'), _kitti_raw),
)


def form_of(*paths: Path) -> Form | None:
    """Return which form a file has, or several that belong together; None for one of ROS, EuRoC or
    Kalibr, or what is no calibration. Raises CalibrationError for a file that cannot be read.
    """
    if not all(path.suffix.lower() in SUFFIXES and path.is_file() for path in paths):
        return None
    values = _all_values(paths)
    return next((form for form in FORMS if all(key in values for key in form.keys)), None)


def read_other(
    *paths: Path, size: Size | None = None, cameras: tuple[str, str] = ('00', '01')
) -> StereoCalibration:
    """Return the pair that a file of one of the forms holds, or two (intrinsics and extrinsics of
    OpenCV). size: (width, height) of the images,
    where the file does not say it. cameras: of KITTI raw. Raises CalibrationError.
    """
    form, path = form_of(*paths), paths[0]
    if form is None:
        known = ', '.join(dict.fromkeys(form.name for form in FORMS))
        raise CalibrationError(
            f'{path}: not a known form of calibration; known are those of {known}, and the YAML of '
            'ROS, EuRoC and Kalibr'
        )
    try:
        return form.read(_Reader(path, _all_values(paths), size, cameras))
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        what = f'{type(error).__name__}: {error}'
        raise CalibrationError(
            f'{path}: looks like a calibration of {form.name}, but a part of it is missing or of '
            f'another form ({what})'
        ) from None


def _all_values(paths: Sequence[Path]) -> Document:
    return {name: value for path in paths for name, value in _values(path).items()}


def _values(path: Path) -> Document:
    """Return what a file holds, by name; sections and names of INI files are joined by a dot."""
    suffix = path.suffix.lower()
    if suffix == '.json':
        values = json_object(read_text(path, CalibrationError))
        return {} if values is None else values
    if suffix in ('.yaml', '.yml'):
        return read_yaml(path, 'a calibration: names and values', CalibrationError)
    return _sections(path) if suffix == '.conf' else _sections(path) | _lines(path)


def _lines(path: Path) -> dict[str, Any]:
    """Return lines of a name, a colon and values."""
    parts = (line.partition(':') for _, line in read_lines(path, CalibrationError))
    return {name.strip(): values.split() for name, colon, values in parts if colon}


def _sections(path: Path) -> dict[str, Any]:
    """Return the values of an INI file, and of one of ROS, whose values are below their names."""
    values: dict[str, Any] = {}
    section = name = ''
    for _, line in read_lines(path, CalibrationError):
        text = line.split(';')[0].strip()
        heading = re.fullmatch(r'\[(.+)\]', text)
        key, equals, value = (part.strip() for part in text.partition('='))
        if heading:
            section, name = heading[1], ''
        elif equals:
            values[f'{section}.{key}'] = value.split()
        elif re.match(r'[-+.0-9]', text):
            values.setdefault(f'{section}.{name}', []).extend(text.split())
        else:
            name = text
            values.pop(f'{section}.{name}', None)  # said again of the next camera
    return values
