"""One rig in the files of other tools: each gives the same rectified camera."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from camera_recordings import grey_pairs, opened, write_folders, write_image
from command_line import segfloor
from scipy.spatial.transform import Rotation

from segfloor_ros.apps.recordings.calibration_files import read_calibration, read_eye_calibration
from segfloor_ros.apps.recordings.extrinsics import calibration_from_extrinsics
from segfloor_ros.apps.recordings.other_calibrations import form_of
from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.errors import CalibrationError
from segfloor_ros.core.geometry import invert, make_transform

SIZE = 1280, 720
FX, FY, CX, CY = (700.0, 690.0), (701.0, 691.0), (640.0, 630.0), (360.0, 355.0)
D = [(-0.1, 0.02, 0.001, -0.0005, 0.003), (-0.11, 0.025, -0.001, 0.0004, 0.001)]
FISHEYE = [(0.01, -0.004, 0.002, -0.001), (0.012, -0.003, 0.001, -0.0005)]
TURN = np.array([0.002, -0.004, 0.003])
PLACE_M = np.array([0.12, 0.0004, -0.0003])
"""The right camera in the left one: rotation vector of x_right = R x_left + t, and place."""
T_RIGHT_LEFT = make_transform(Rotation.from_rotvec(TURN).as_matrix(), -PLACE_M)


def K(side: int) -> np.ndarray:
    return np.array([[FX[side], 0, CX[side]], [0, FY[side], CY[side]], [0, 0, 1]])


def truth(kind: str = 'plumb_bob') -> StereoCalibration:
    terms = {'plumb_bob': D, 'equidistant': FISHEYE, 'none': [(0.0,) * 5] * 2}[kind]
    model = 'plumb_bob' if kind == 'none' else kind
    eyes = (EyeCalibration.of_raw(SIZE, K(i), np.array(terms[i]), model) for i in (0, 1))
    return calibration_from_extrinsics(*eyes, T_RIGHT_LEFT)


def same(found: StereoCalibration, wanted: StereoCalibration) -> None:
    assert (found.camera.width, found.camera.height) == (wanted.camera.width, wanted.camera.height)
    for side in ('left', 'right'):
        one, other = getattr(found, side), getattr(wanted, side)
        for name in 'KRP':
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-4)
        count = min(one.D.size, other.D.size)
        np.testing.assert_allclose(one.D[:count], other.D[:count], atol=1e-9)
        assert not one.D[count:].any() and not other.D[count:].any()
    assert found.camera.baseline_m == pytest.approx(wanted.camera.baseline_m, abs=1e-6)


def opencv_matrix(values: np.ndarray) -> str:
    rows, cols = np.atleast_2d(values).shape
    data = ', '.join(f'{v:.17g}' for v in np.ravel(values))
    return f'!!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {data} ]\n'


def zed(path: Path) -> Path:
    lines = []
    for side, name in enumerate(('LEFT', 'RIGHT')):
        for mode, factor in (('HD', 1.0), ('FHD', 1.5)):
            lines.append(f'[{name}_CAM_{mode}]\n')
            for key, value in (('fx', FX), ('fy', FY), ('cx', CX), ('cy', CY)):
                lines.append(f'{key}={factor * value[side]:.10g}\n')
            lines += [
                f'{k}={v}\n' for k, v in zip(('k1', 'k2', 'p1', 'p2', 'k3'), D[side], strict=True)
            ]
    mm = [1e3 * value for value in PLACE_M]
    lines.append(f'[STEREO]\nBaseline={mm[0]:.10g}\nTY={mm[1]:.10g}\nTZ={mm[2]:.10g}\n')
    for mode in ('HD', 'FHD'):
        lines += [f'{k}_{mode}={v}\n' for k, v in zip(('RX', 'CV', 'RZ'), TURN, strict=True)]
    file = path / 'SN12345.conf'
    file.write_text(''.join(lines))
    return file


def zed_of_one_resolution(path: Path) -> Path:
    file = zed(path)
    parts = file.read_text().split('[')
    file.write_text('['.join(part for part in parts if '_CAM_FHD]' not in part))
    return file


def ost(path: Path) -> Path:
    pair = truth()
    text = '# oST version 5.0 parameters\n\n\n'
    for name, eye in (('left', pair.left), ('right', pair.right)):
        text += f'[image]\n\nwidth\n{SIZE[0]}\n\nheight\n{SIZE[1]}\n\n[narrow_stereo/{name}]\n\n'
        for what, values in (
            ('camera matrix', eye.K), ('distortion', eye.D[None]), ('rectification', eye.R),
            ('projection', eye.P),
        ):  # fmt: skip
            rows = '\n'.join(' '.join(f'{v:.12f}' for v in row) for row in values)
            text += f'{what}\n{rows}\n\n'
    file = path / 'ost.txt'
    file.write_text(text)
    return file


def oak(
    path: Path, is_fisheye: bool = False, through_rgb: bool = False, both_ways: bool = False
) -> Path:
    def extrinsics(T: np.ndarray, socket: int) -> dict:
        place = dict(zip('xyz', (100 * T[:3, 3]).tolist(), strict=True))
        return {
            'rotationMatrix': T[:3, :3].tolist(),
            'toCameraSocket': socket,
            'translation': place,
        }

    T_rgb_right = make_transform(np.eye(3), np.array([0.04, 0.0, 0.0]))
    none = extrinsics(np.eye(4), -1)
    links = {
        1: extrinsics(T_rgb_right @ T_RIGHT_LEFT, 0)
        if through_rgb
        else extrinsics(T_RIGHT_LEFT, 2),
        2: extrinsics(T_rgb_right, 0),
        0: none,
    }
    if both_ways:
        links[2] = extrinsics(invert(T_RIGHT_LEFT), 1)
    cameras = []
    for socket in (0, 1, 2):
        side = max(socket - 1, 0)
        terms = FISHEYE[side] if is_fisheye else (*D[side], *(0.0,) * 9)
        cameras.append(
            [socket, {
                'cameraType': int(is_fisheye), 'distortionCoeff': list(terms), 'width': SIZE[0],
                'height': SIZE[1], 'intrinsicMatrix': K(side).tolist(), 'extrinsics': links[socket],
            }]
        )  # fmt: skip
    file = path / 'calib.json'
    rectified = {'leftCameraSocket': 1, 'rightCameraSocket': 2}
    file.write_text(json.dumps({'cameraData': cameras, 'stereoRectificationData': rectified}))
    return file


def basalt(path: Path, kind: str = 'kb4') -> Path:
    T_imu_left = make_transform(
        Rotation.from_euler('xyz', (0.1, 1.2, -0.4)).as_matrix(), np.array([0.01, -0.05, 0.02])
    )
    poses = []
    for T in (T_imu_left, T_imu_left @ invert(T_RIGHT_LEFT)):
        q = Rotation.from_matrix(T[:3, :3]).as_quat()
        names = ('px', 'py', 'pz', 'qx', 'qy', 'qz', 'qw')
        poses.append(dict(zip(names, [*T[:3, 3], *q], strict=True)))
    lenses = []
    for side in (0, 1):
        lens = {'fx': FX[side], 'fy': FY[side], 'cx': CX[side], 'cy': CY[side]}
        if kind == 'kb4':
            lens |= dict(zip(('k1', 'k2', 'k3', 'k4'), FISHEYE[side], strict=True))
        else:
            lens |= dict(zip(('k1', 'k2', 'p1', 'p2', 'k3'), D[side], strict=True))
            lens |= dict.fromkeys(('k4', 'k5', 'k6'), 0.0)
        lenses.append({'camera_type': kind, 'intrinsics': lens})
    value = {'T_imu_cam': poses, 'intrinsics': lenses, 'resolution': [list(SIZE)] * 2}
    file = path / 'calibration.json'
    file.write_text(json.dumps({'value0': value}))
    return file


def orb_slam3(path: Path, is_fisheye: bool = False) -> Path:
    kind = 'KannalaBrandt8' if is_fisheye else 'PinHole'
    text = f'%YAML:1.0\n\nFile.version: "1.0"\nCamera.type: "{kind}"\n'
    for side in (0, 1):
        names = ('k1', 'k2', 'k3', 'k4') if is_fisheye else ('k1', 'k2', 'p1', 'p2', 'k3')
        values = dict(zip(names, FISHEYE[side] if is_fisheye else D[side], strict=True))
        values |= {'fx': FX[side], 'fy': FY[side], 'cx': CX[side], 'cy': CY[side]}
        text += ''.join(f'Camera{side + 1}.{k}: {v}\n' for k, v in values.items())
    text += f'Camera.width: {SIZE[0]}\nCamera.height: {SIZE[1]}\nCamera.fps: 20\nCamera.RGB: 1\n'
    file = path / 'EuRoC.yaml'
    file.write_text(text + f'Stereo.T_c1_c2: {opencv_matrix(invert(T_RIGHT_LEFT))}')
    return file


def orb_slam2(path: Path) -> Path:
    pair = truth()
    text = f'%YAML:1.0\nCamera.fx: {pair.camera.fx}\nCamera.width: {SIZE[0]}\n'
    text += f'Camera.height: {SIZE[1]}\nCamera.bf: {pair.camera.disparity_times_depth}\n'
    for name, eye in (('LEFT', pair.left), ('RIGHT', pair.right)):
        for key in 'KDRP':
            text += f'{name}.{key}: {opencv_matrix(getattr(eye, key))}'
    file = path / 'EuRoC2.yaml'
    file.write_text(text)
    return file


def opencv(path: Path, names: str = 'M', has_size: bool = True) -> Path:
    text = '%YAML:1.0\n---\n'
    other = {'M': 'D', 'K': 'D', 'cameraMatrix': 'distCoeffs'}[names]
    for side in (0, 1):
        text += f'{names}{side + 1}: {opencv_matrix(K(side))}'
        text += f'{other}{side + 1}: {opencv_matrix(np.array(D[side]))}'
    text += f'R: {opencv_matrix(T_RIGHT_LEFT[:3, :3])}T: {opencv_matrix(T_RIGHT_LEFT[:3, 3:])}'
    if has_size:
        text += f'image_width: {SIZE[0]}\nimage_height: {SIZE[1]}\n'
    file = path / 'stereo.yml'
    file.write_text(text)
    return file


def kalibr(path: Path) -> Path:
    text = ''
    for side in (0, 1):
        text += (
            f'cam{side}:\n  camera_model: pinhole\n  distortion_model: equidistant\n'
            f'  distortion_coeffs: {list(FISHEYE[side])}\n  resolution: {list(SIZE)}\n'
            f'  intrinsics: [{FX[side]}, {FY[side]}, {CX[side]}, {CY[side]}]\n'
        )
    file = path / 'drive-camchain.yaml'
    file.write_text(text + f'  T_cn_cnm1: {T_RIGHT_LEFT.tolist()}\n')
    return file


FILES: dict[str, tuple[Callable[[Path], Path], str]] = {
    'ZED': (zed_of_one_resolution, 'plumb_bob'),
    'ost.txt': (ost, 'plumb_bob'),
    'OAK both ways': (lambda p: oak(p, both_ways=True), 'plumb_bob'),
    'OAK': (oak, 'plumb_bob'),
    'OAK through its colour camera': (lambda p: oak(p, through_rgb=True), 'plumb_bob'),
    'OAK fisheye': (lambda p: oak(p, is_fisheye=True), 'equidistant'),
    'Basalt kb4': (basalt, 'equidistant'),
    'Basalt radtan8': (lambda p: basalt(p, 'pinhole-radtan8'), 'plumb_bob'),
    'Basalt pinhole': (lambda p: basalt(p, 'pinhole'), 'none'),
    'ORB-SLAM3': (orb_slam3, 'plumb_bob'),
    'ORB-SLAM3 fisheye': (lambda p: orb_slam3(p, is_fisheye=True), 'equidistant'),
    'ORB-SLAM2': (orb_slam2, 'plumb_bob'),
    'OpenCV M1': (opencv, 'plumb_bob'),
    'OpenCV K1': (lambda p: opencv(p, 'K'), 'plumb_bob'),
    'OpenCV cameraMatrix1': (lambda p: opencv(p, 'cameraMatrix'), 'plumb_bob'),
    'Kalibr': (kalibr, 'equidistant'),
}


@pytest.mark.parametrize('name', FILES)
def test_a_file_of_another_tool_is_read_and_converted(tmp_path: Path, name: str) -> None:
    write, kind = FILES[name]
    file, wanted = write(tmp_path), truth(kind)
    same(read_calibration(file, file), wanted)
    assert read_eye_calibration(file).K[0, 0] == FX[0] if name != 'Kalibr' else True
    out = tmp_path / 'out'
    said = segfloor('calibrate', '--from', file, '--out', out)
    assert said.returncode == 0, said.stderr
    same(read_calibration(out / 'left.yaml', out / 'right.yaml'), wanted)


@pytest.mark.parametrize('name', FILES)
def test_a_file_of_another_tool_beside_the_images_is_found(tmp_path: Path, name: str) -> None:
    folder = write_folders(tmp_path, grey_pairs(2, *SIZE))
    for side in ('left', 'right'):
        (folder / f'{side}.yaml').unlink()
    (folder / 'notes.yaml').symlink_to(tmp_path / 'gone')
    write, kind = FILES[name]
    file = write(folder)
    same(opened(folder).calibration, truth(kind))
    other = tmp_path / 'other'
    write_folders(other, grey_pairs(2, *SIZE))
    same(opened(other, left_calibration=str(file)).calibration, truth(kind))


def test_intrinsics_and_extrinsics_of_opencv_are_one_calibration(tmp_path: Path) -> None:
    file = opencv(tmp_path)
    head, t, tail = file.read_text().partition('R: ')
    (tmp_path / 'intrinsics.yml').write_text(head)
    (tmp_path / 'extrinsics.yml').write_text('%YAML:1.0\n---\n' + t + tail)
    same(read_calibration(tmp_path / 'intrinsics.yml', tmp_path / 'extrinsics.yml'), truth())


def test_several_calibrations_are_named(tmp_path: Path) -> None:
    folder = write_folders(tmp_path, grey_pairs(2, *SIZE))
    for side in ('left', 'right'):
        (folder / f'{side}.yaml').unlink()
    oak(folder)
    orb_slam3(folder)
    with pytest.raises(CalibrationError, match=r'several calibrations \(EuRoC.yaml, calib.json\)'):
        opened(folder)


@pytest.mark.parametrize(
    ('write', 'message'),
    [
        (zed, 'holds calibrations of images of 1920x1080, 1280x720; convert that of yours'),
        (lambda p: opencv(p, has_size=False), 'does not say the size of its images; convert it'),
    ],
)
def test_a_file_that_lacks_the_size_is_converted_with_it(tmp_path: Path, write, message) -> None:
    file, out = write(tmp_path), tmp_path / 'out'
    with pytest.raises(CalibrationError, match=message) as error:
        read_calibration(file, file)
    assert f'segfloor calibrate --from {file} --size WIDTHxHEIGHT' in str(error.value)
    said = segfloor('calibrate', '--from', file, '--size', '1280x720', '--out', out)
    assert said.returncode == 0, said.stderr
    same(read_calibration(out / 'left.yaml', out / 'right.yaml'), truth())


@pytest.mark.parametrize(
    ('write', 'old', 'new', 'message'),
    [
        (oak, '"toCameraSocket": 0', '"toCameraSocket": 7', ''),
        (oak, '"toCameraSocket": 2', '"toCameraSocket": 7', 'do not connect both cameras'),
        (oak, '"distortionCoeff"', '"distortion"', 'calibration of OAK, but a part of it is miss'),
        (oak, '"rotationMatrix": [[', '"rotationMatrix": [["a", ', 'rotationMatrix: expected fini'),
        (basalt, '"kb4"', '"ds"', 'unknown camera model ds; calibrate it as kb4'),
        (orb_slam3, 'Camera2.fx', 'Camera3.fx', 'Camera2.fx is missing'),
        (ost, '[narrow_stereo/right]', '[narrow_stereo/left]', 'holds 1 cameras; calibrate both'),
        (opencv, 'D2', 'E2', 'D2 is missing'),
    ],
)
def test_faults_of_other_files_are_one_line(tmp_path: Path, write, old, new, message) -> None:
    file = write(tmp_path)
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    if not message:
        read_calibration(file, file)
        return
    with pytest.raises(CalibrationError, match=message) as error:
        read_calibration(file, file)
    assert str(file) in str(error.value) and '\n' not in str(error.value)


def test_what_is_no_calibration_is_named_with_the_forms(tmp_path: Path) -> None:
    file = tmp_path / 'notes.json'
    file.write_text('{"a": 1}')
    assert form_of(file) is None
    said = segfloor('calibrate', '--from', file, '--out', tmp_path / 'out')
    assert said.returncode == 2
    assert 'not a known form of calibration; known are those of ZED' in said.stderr


@pytest.mark.parametrize('is_rectified', [True, False])
@pytest.mark.parametrize('cameras', [(0, 1), (2, 3)])
def test_kitti_raw_is_read_with_its_times_and_calibration(
    tmp_path: Path, is_rectified: bool, cameras: tuple[int, int]
) -> None:
    folder = tmp_path / '2011_09_26' / '2011_09_26_drive_0001_sync'
    size = (124, 37) if is_rectified else (139, 51)
    for i, pair in enumerate(grey_pairs(4, *size)):
        for camera, image in zip(cameras, pair, strict=True):
            write_image(folder / f'image_{camera:02d}' / 'data' / f'{i:010d}.png', image)
    times = [f'2011-09-26 13:02:2{5 + i // 5}.{2 * (i % 5)}94360375\n' for i in range(4)]
    for camera in cameras:
        (folder / f'image_{camera:02d}' / 'timestamps.txt').write_text(''.join(times))
    text = 'calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.950000e-02\n'
    for camera in range(4):
        f, shift = 72.0 + (camera > 1), (0.0, -38.0, 4.5, -33.5)[camera]
        P = [f, 0, 60, shift, 0, f, 18, 0, 0, 0, 1, 0]
        text += f'S_{camera:02d}: 139 51\nS_rect_{camera:02d}: 124 37\n'
        text += f'K_{camera:02d}: 98 0 69 0 98 25 0 0 1\nD_{camera:02d}: -0.3 0.1 0 0 0\n'
        text += f'R_rect_{camera:02d}: 1 0 0 0 1 0 0 0 1\n'
        text += f'P_rect_{camera:02d}: {" ".join(map(str, P))}\n'
    (folder.parent / 'calib_cam_to_cam.txt').write_text(text)
    source = opened(folder)
    assert source.rate_hz == pytest.approx(5.0)
    first = next(source.frames())
    assert first.stamp_ns == 1317042145_094360375  # 13:02:25 UTC on this day
    assert source.calibration.is_rectified == is_rectified
    expected_m = 38 / 72 if cameras == (0, 1) else 38 / 73
    assert source.camera.baseline_m == pytest.approx(expected_m)
