"""A small valid input of every kind, with the command that reads it, for `tools.fuzz` to damage."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
import zstandard
from numpy.typing import NDArray
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from segfloor_ros.apps.cli.main import program
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.recordings.bag_writer import convert
from segfloor_ros.apps.recordings.calibration_files import write_ros_calibration
from segfloor_ros.core.camera.calibration import EyeCalibration
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.contracts import FLOOR, NOT_FLOOR
from tools.benchmark_stages import CAMERA, MOUNT, CorridorImages

FRAMES = 4
SCALE = 4
"""The images are so many times smaller than the generated ones."""

WIDTH, HEIGHT = CAMERA.width // SCALE, CAMERA.height // SCALE
STAMPS_NS = [10**15 + 10**8 * i for i in range(FRAMES)]
MOUNTED = [
    f'--set=stereo_slam.camera_height_m={MOUNT.height_m}',
    f'--set=stereo_slam.camera_pitch_rad={MOUNT.pitch_rad}',
    '--set=stereo_slam.camera_roll_rad=0.0',
]
NAME = 'a[red]b'
"""Of folders: markup in a name is text."""


@dataclass(frozen=True)
class Kind:
    """How an input is made in a new folder, the files of it that are damaged, as patterns, and the
    command that reads it; `{}` stands for the folder.
    """

    make: Callable[[Path], None]
    files: tuple[str, ...]
    command: tuple[str, ...]


def _pairs() -> list[tuple[NDArray[np.uint8], NDArray[np.uint8]]]:
    size = (WIDTH, HEIGHT)
    frames = list(CorridorImages(FRAMES, 1).drive())
    return [
        (
            cv2.resize(frame.left, size, interpolation=cv2.INTER_AREA),
            cv2.resize(frame.right, size, interpolation=cv2.INTER_AREA),
        )
        for frame in frames
    ]


def _eyes() -> tuple[EyeCalibration, EyeCalibration]:
    f, cx, cy = CAMERA.fx / SCALE, (WIDTH - 1) / 2, (HEIGHT - 1) / 2
    P = np.array([[f, 0, cx, 0], [0, f, cy, 0], [0, 0, 1, 0.0]])
    P_right = P.copy()
    P_right[0, 3] = -f * CAMERA.baseline_m
    return (
        EyeCalibration.of_rectified(WIDTH, HEIGHT, P),
        EyeCalibration.of_rectified(WIDTH, HEIGHT, P_right),
    )


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def _image(path: Path, image: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image)


def _calibrations(folder: Path) -> None:
    for name, eye in zip(('left', 'right'), _eyes(), strict=True):
        write_ros_calibration(folder / f'{name}.yaml', eye, name)


def _sensors(folder: Path) -> None:
    """Wheels that drive ahead, and an IMU with the axes of the camera."""
    wheels = [f'{1e-9 * t:.9f} {0.05 * i:.3f} 0 0 0 0 0 1' for i, t in enumerate(STAMPS_NS)]
    _write(folder / 'wheel_odometry.txt', '# t x y z qx qy qz qw\n' + '\n'.join(wheels) + '\n')
    stamps = range(STAMPS_NS[0] - 10**7, STAMPS_NS[-1] + 2 * 10**7, 10**7)
    rows = [f'{t},0.001,0.002,-0.001,0.1,-9.7,0.5' for t in stamps]
    _write(folder / 'imu.csv', '#timestamp [ns],w,w,w,a,a,a\n' + '\n'.join(rows) + '\n')
    _write(folder / 'imu.yaml', yaml.safe_dump({'T_BS': {'data': np.eye(4).ravel().tolist()}}))


def make_kitti(folder: Path) -> None:
    """Write a KITTI folder with wheels, an IMU, depth and true poses."""
    root = folder / NAME
    for i, pair in enumerate(_pairs()):
        for camera, image in enumerate(pair):
            _image(root / f'image_{camera}' / f'{i:06d}.png', image)
        _image(root / 'depth' / f'{i:06d}.png', np.full((HEIGHT, WIDTH), 2000, np.uint16))
        _image(root / 'masks' / f'{i:06d}.png', np.zeros((HEIGHT, WIDTH), np.uint8))
    rows = [f'P{i}: ' + ' '.join(map(repr, e.P.ravel().tolist())) for i, e in enumerate(_eyes())]
    _write(root / 'calib.txt', '\n'.join(rows) + '\n')
    _write(root / 'times.txt', ''.join(f'{1e-9 * t:.6f}\n' for t in STAMPS_NS))
    _write(
        root / 'poses.txt', ''.join(f'1 0 0 0 0 1 0 0 0 0 1 {0.05 * i}\n' for i in range(FRAMES))
    )
    _sensors(root)


def make_folders(folder: Path) -> None:
    """Write two folders of images, one of them in JPEG, with ROS calibrations."""
    for i, (left, right) in enumerate(_pairs()):
        _image(folder / NAME / 'left' / f'left{i}.png', left)
        _image(folder / NAME / 'right' / f'right{i}.jpg', right)
    _calibrations(folder / NAME)
    _write(folder / NAME / 'times.txt', ''.join(f'{1e-9 * t:.6f}\n' for t in STAMPS_NS))


def make_euroc(folder: Path) -> None:
    """Write an EuRoC folder with an IMU."""
    for side in (0, 1):
        root, T = folder / NAME / f'cam{side}', np.eye(4)
        T[0, 3] = side * CAMERA.baseline_m
        for stamp, pair in zip(STAMPS_NS, _pairs(), strict=True):
            _image(root / 'data' / f'{stamp}.png', pair[side])
        _write(root / 'data.csv', '#t,name\n' + ''.join(f'{t},{t}.png\n' for t in STAMPS_NS))
        K = _eyes()[0].K
        sensor = {
            'T_BS': {'rows': 4, 'cols': 4, 'data': T.ravel().tolist()},
            'resolution': [WIDTH, HEIGHT],
            'intrinsics': [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
            'distortion_model': 'radial-tangential',
            'distortion_coefficients': [0.01, 0.0, 0.0, 0.0],
        }
        _write(root / 'sensor.yaml', '%YAML:1.0\n' + yaml.safe_dump(sensor))
    _sensors(folder / NAME / 'imu0')
    (folder / NAME / 'imu0' / 'imu.csv').rename(folder / NAME / 'imu0' / 'data.csv')
    (folder / NAME / 'imu0' / 'imu.yaml').rename(folder / NAME / 'imu0' / 'sensor.yaml')


def make_rgbd(folder: Path) -> None:
    """Write a folder of the TUM RGB-D benchmark."""
    root = folder / NAME
    for name in ('rgb', 'depth'):
        _write(root / f'{name}.txt', ''.join(f'{1e-9 * t:.6f} {name}/{t}.png\n' for t in STAMPS_NS))
    for stamp, (left, _) in zip(STAMPS_NS, _pairs(), strict=True):
        _image(root / 'rgb' / f'{stamp}.png', left)
        _image(root / 'depth' / f'{stamp}.png', np.full((HEIGHT, WIDTH), 8000, np.uint16))
    write_ros_calibration(root / 'left.yaml', _eyes()[0], 'left')


def _bag(folder: Path, out: Path) -> None:
    make_kitti(folder / 'made')
    source = open_source(StereoCameraSettings(input=str(folder / 'made' / NAME)))
    convert(source, out)
    shutil.rmtree(folder / 'made')


def make_mcap(folder: Path) -> None:
    """Write a bag of one file."""
    _bag(folder, folder / 'drive.mcap')


def make_compressed_mcap(folder: Path) -> None:
    """Write a bag of one file that is compressed."""
    make_mcap(folder)
    file = folder / 'drive.mcap'
    packed = zstandard.ZstdCompressor().compress(file.read_bytes())
    file.with_suffix('.mcap.zstd').write_bytes(packed)
    file.unlink()


def make_pairs_list(folder: Path) -> None:
    """Write a folder of the TUM RGB-D benchmark with a list of pairs alone."""
    make_rgbd(folder)
    root = folder / NAME
    rows = (f'{1e-9 * t:.6f} rgb/{t}.png {1e-9 * t:.6f} depth/{t}.png\n' for t in STAMPS_NS)
    _write(root / 'associations.txt', ''.join(rows))
    for name in ('rgb', 'depth'):
        (root / f'{name}.txt').unlink()


def make_other_calibrations(folder: Path) -> None:
    """Write one calibration as several tools do."""
    eye = _eyes()[0]
    fx, cx, cy = (float(eye.K[at]) for at in ((0, 0), (0, 2), (1, 2)))
    cameras = [
        [socket, {
            'cameraType': 0, 'distortionCoeff': [0.01] + [0.0] * 13, 'width': WIDTH,
            'height': HEIGHT, 'intrinsicMatrix': eye.K.tolist(), 'extrinsics': {
                'rotationMatrix': np.eye(3).tolist(), 'toCameraSocket': 3 - socket,
                'translation': {'x': -12.0, 'y': 0.0, 'z': 0.0},
            },
        }]
        for socket in (1, 2)
    ]  # fmt: skip
    _write(folder / 'oak.json', json.dumps({'cameraData': cameras}))
    lens = {'fx': fx, 'fy': fx, 'cx': cx, 'cy': cy, 'k1': 0.01, 'k2': 0.0, 'k3': 0.0, 'k4': 0.0}
    pose = {'px': 0.0, 'py': 0.0, 'pz': 0.0, 'qx': 0.0, 'qy': 0.0, 'qz': 0.0, 'qw': 1.0}
    value = {
        'T_imu_cam': [pose, pose | {'px': 0.12}], 'resolution': [[WIDTH, HEIGHT]] * 2,
        'intrinsics': [{'camera_type': 'kb4', 'intrinsics': lens}] * 2,
    }  # fmt: skip
    _write(folder / 'basalt.json', json.dumps({'value0': value}))
    text = f'%YAML:1.0\nCamera.fx: {fx}\nCamera.fy: {fx}\nCamera.cx: {cx}\nCamera.cy: {cy}\n'
    text += f'Camera.width: {WIDTH}\nCamera.height: {HEIGHT}\nCamera.bf: {0.12 * fx}\n'
    _write(folder / 'orb.yaml', text)
    sections = ''.join(
        f'[{side}_CAM_VGA]\nfx={fx}\nfy={fx}\ncx={cx}\ncy={cy}\nk1=0\nk2=0\np1=0\np2=0\nk3=0\n'
        for side in ('LEFT', 'RIGHT')
    )
    stereo = '[STEREO]\nBaseline=120\nTY=0\nTZ=0\nCV_VGA=0.001\nRX_VGA=0\nRZ_VGA=0\n'
    _write(folder / 'zed.conf', sections + stereo)


def make_bag_folder(folder: Path) -> None:
    """Write a bag of a folder."""
    _bag(folder, folder / NAME)


def _messages(folder: Path) -> list[tuple[Any, int, bytes]]:
    _bag(folder, folder / 'other.mcap')
    with rosbag2.Reader(folder / 'other.mcap') as reader:
        messages = list(reader.messages())
    (folder / 'other.mcap').unlink()
    return messages


def make_sqlite(folder: Path) -> None:
    """Write a bag of a folder with a database."""
    kept = get_typestore(Stores.ROS2_JAZZY)
    messages = _messages(folder)
    plugin = rosbag2.StoragePlugin.SQLITE3
    with rosbag2.Writer(folder / NAME, version=9, storage_plugin=plugin) as writer:
        topics: dict[str, Any] = {}
        for connection, time_ns, data in messages:
            topic, kind = connection.topic, connection.msgtype
            if topic not in topics:
                if kind not in kept.types:
                    continue
                topics[topic] = writer.add_connection(topic, kind, typestore=kept)
            writer.write(topics[topic], time_ns, data)


def make_ros1(folder: Path) -> None:
    """Write a bag of ROS 1."""
    kept = get_typestore(Stores.ROS1_NOETIC)
    kinds = kept.types
    roi = kinds['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False)
    with rosbag1.Writer(folder / 'drive.bag') as writer:
        topics = {
            (side, name): writer.add_connection(f'/{side}/{topic}', kind, typestore=kept)
            for side in ('left', 'right')
            for name, topic, kind in (
                ('image', 'image_rect', 'sensor_msgs/msg/Image'),
                ('info', 'camera_info', 'sensor_msgs/msg/CameraInfo'),
            )
        }
        for stamp_ns, pair in zip(STAMPS_NS, _pairs(), strict=True):
            stamp = kinds['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9))
            header = kinds['std_msgs/msg/Header'](seq=0, stamp=stamp, frame_id='camera')
            for side, image, eye in zip(('left', 'right'), pair, _eyes(), strict=True):
                info = kinds['sensor_msgs/msg/CameraInfo'](
                    header, HEIGHT, WIDTH, 'plumb_bob', eye.D, eye.K.ravel(), eye.R.ravel(),
                    eye.P.ravel(), 0, 0, roi,
                )  # fmt: skip
                picture = kinds['sensor_msgs/msg/Image'](
                    header, HEIGHT, WIDTH, 'mono8', 0, WIDTH, image.ravel()
                )
                for name, message in (('info', info), ('image', picture)):
                    connection = topics[side, name]
                    data = kept.serialize_ros1(message, connection.msgtype)
                    writer.write(connection, stamp_ns, data)


def make_video(folder: Path) -> None:
    """Write a side-by-side video."""
    (folder / NAME).mkdir()
    codec = cv2.VideoWriter.fourcc(*'MJPG')
    video = cv2.VideoWriter(str(folder / NAME / 'drive.avi'), codec, 10.0, (2 * WIDTH, HEIGHT))
    for pair in _pairs():
        video.write(cv2.cvtColor(np.hstack(pair), cv2.COLOR_GRAY2BGR))
    video.release()
    _calibrations(folder / NAME)


def make_params(folder: Path) -> None:
    """Write a recording and a parameter file."""
    make_kitti(folder)
    values = {
        '/**': {'ros__parameters': {'robot_height_m': 0.8, 'use_sim_time': False}},
        'stereo_slam': {'ros__parameters': {'num_features': 700, 'camera_height_m': 0.3,
                                            'camera_pitch_rad': 0.12, 'camera_roll_rad': 0.0}},
        'occupancy_grid': {'ros__parameters': {'resolution_m': 0.05}},
    }  # fmt: skip
    _write(folder / 'params.yaml', yaml.safe_dump(values))


def _run(folder: Path, *words: str) -> None:
    program(['run'])(['run', str(folder / NAME), *MOUNTED, *words], standalone_mode=False)


def make_saved_map(folder: Path) -> None:
    """Write a recording and a map that was saved."""
    make_kitti(folder)
    _run(folder, '--out', str(folder / 'out'), '--save-map', str(folder / 'saved.map'))
    shutil.rmtree(folder / 'out')


def make_results(folder: Path) -> None:
    """Write a recording with its truth, and what a run made of it."""
    make_kitti(folder)
    _run(folder, '--out', str(folder / 'run'))
    truth = folder / 'truth'
    shutil.copytree(folder / 'run', truth)
    for name in ('summary.json', 'settings.yaml', 'keyframes.txt', 'labelled_cloud.ply'):
        (truth / name).unlink()
    (truth / 'floor_masks').rename(truth / 'floor')
    shutil.copy(folder / NAME / 'poses.txt', truth / 'poses.txt')
    shutil.copy(folder / NAME / 'times.txt', truth / 'times.txt')
    _write(truth / 'scene.yaml', 'start_pose_world: [0.0, 0.0, 0.0]\nfov_x_deg: 90.0\n')
    rows = [f'{1e-9 * t:.6f} {0.05 * i} 0 0\n' for i, t in enumerate(STAMPS_NS)]
    _write(truth / 'base_poses.txt', ''.join(rows))


def make_masks(folder: Path) -> None:
    """Write two folders of floor masks, and outlines of floor."""
    mask = np.full((HEIGHT, WIDTH), NOT_FLOOR, np.uint8)
    mask[HEIGHT // 2 :] = FLOOR
    for name in ('a', 'b'):
        for i in range(2):
            _image(folder / NAME / name / f'{i:06d}.png', mask)
    outline = {'floor': [[0, 60, 159, 60, 159, 119, 0, 119]], 'unsure': [[0, 0, 9, 0, 9, 9]]}
    _write(folder / 'outlines.yaml', yaml.safe_dump({'frames': {0: outline, 1: outline}}))


def make_chessboards(folder: Path) -> None:
    """Write pairs of pictures of a chessboard of 5x4 inner corners."""
    squares = (np.indices((5, 6)).sum(axis=0) % 2 * 200 + 30).astype(np.uint8)
    board = np.pad(np.kron(squares, np.ones((16, 16), np.uint8)), 16, constant_values=230)
    scale_m = 0.03 / 16
    # Pixels of the picture of the board -> metres on it, its middle at the origin.
    S = np.array([[scale_m, 0, -0.12], [0, scale_m, -0.105], [0, 0, 1]])
    K = np.array([[150.0, 0, 79.5], [0, 150, 59.5], [0, 0, 1]])
    rng = np.random.default_rng(5)
    for i in range(8):
        R = Rotation.from_euler('xyz', rng.uniform(-0.5, 0.5, 3) * (1, 1, 0.4)).as_matrix()
        t = np.array([*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.35, 0.45)])
        for x_m, side in ((0.03, 'left'), (-0.03, 'right')):
            H = K @ np.column_stack([R[:, 0], R[:, 1], t + np.array([x_m, 0, 0])]) @ S
            finer = np.array([[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1]])
            large = cv2.warpPerspective(
                board, finer @ H, (4 * WIDTH, 4 * HEIGHT), borderValue=(120,)
            )
            image = cv2.resize(large, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
            _image(folder / NAME / f'{side}{i}.png', image)


def make_suite(folder: Path) -> None:
    """Write a suite that measures results which are there, a baseline, and an earlier check."""
    make_results(folder)
    entry = {
        'results': 'run', 'name': 'the run', 'truth': 'truth', 'reference_map': 'truth/map.yaml',
        'timeout_s': 60, 'set': {'occupancy_grid.resolution_m': 0.05},
        'expect': {'tracked_percent': 1, 'keyframes': {'min': 1, 'max': 100}},
        'no_worse_by': {'recall_percent': 5, 'memory_peak_mb': '900 %'},
    }  # fmt: skip
    suite = {'name': 'nightly', 'defaults': {'mode': 'run'}, 'recordings': [entry]}
    _write(folder / 'suite.yaml', yaml.safe_dump(suite))
    words = ['check', str(folder / 'suite.yaml'), '--out', str(folder / 'out')]
    words += ['--write-baseline', str(folder / 'baseline.json'), '--cache', str(folder / 'cache')]
    program(words)(words, standalone_mode=False)


def make_scene(folder: Path) -> None:
    """Write a scene of one room and a short drive."""
    scene = {
        'description': 'a room',
        'seed': 3,
        'floor': {'texture': 'marble'},
        'walls': [{'points': [[-2, -1], [2, -1], [2, 1], [-2, 1]], 'closed': True, 'posters': 1}],
        'boxes': [{'at': [1.5, 0.6], 'size': [0.3, 0.3, 0.5], 'yaw_deg': 10}],
        'furniture': [{'kind': 'stool', 'at': [1.2, -0.6]}],
        'camera': {'width': 64, 'height': 48, 'rate_hz': 5, 'pitch_deg': 7},
        'path': {'waypoints': [[-1.0, 0.0], [-0.8, 0.0]], 'speed_m_s': 0.4},
    }
    _write(folder / 'scene.yaml', yaml.safe_dump(scene))


def make_floor_plan(folder: Path) -> None:
    """Write a map of a closed room to drive in."""
    cells = np.full((60, 80), 254, np.uint8)
    cells[[0, 1, -1, -2]] = cells[:, [0, 1, -1, -2]] = 0
    _image(folder / NAME / 'plan.pgm', cells)
    text = 'image: plan.pgm\nresolution: 0.05\norigin: [0.0, 0.0, 0.0]\nnegate: 0\n'
    _write(folder / NAME / 'plan.yaml', text + 'occupied_thresh: 0.65\nfree_thresh: 0.196\n')


def make_words(folder: Path) -> None:
    """Write a recording, and one value of `--set` or another option in a file of its own."""
    make_kitti(folder)
    _write(folder / 'word', 'occupancy_grid.resolution_m=0.05')


def _mapped(*rest: str, input: str = NAME) -> tuple[str, ...]:
    return ('run', f'{{}}/{input}', '--out', '{}/results', *MOUNTED, *rest)


SUITE = ('check', '{}/suite.yaml', '--out', '{}/out', '--cache', '{}/cache')
SIMULATE = ('simulate', '--out', '{}/results', '--floor-every', '0')
SMALL = ('--set=camera.width=64', '--set=camera.height=48', '--set=camera.rate_hz=2',
         '--set=path.waypoints=[[1.0, 1.5], [1.5, 1.5]]')  # fmt: skip
PLAN = ('--nodes', '20', '--repetitions', '2')

KINDS = {
    'KITTI text': Kind(make_kitti, (f'{NAME}/calib.txt', f'{NAME}/times.txt'), _mapped()),
    'KITTI images': Kind(make_kitti, (f'{NAME}/image_?/*',), _mapped()),
    'wheels': Kind(make_kitti, (f'{NAME}/wheel_odometry.txt',), _mapped()),
    'IMU': Kind(make_kitti, (f'{NAME}/imu.csv', f'{NAME}/imu.yaml'), _mapped()),
    'depth images': Kind(make_kitti, (f'{NAME}/depth/*',), _mapped('--depth')),
    'masks': Kind(make_kitti, (f'{NAME}/masks/*',), _mapped('--masks', f'{{}}/{NAME}/masks')),
    'folder images': Kind(make_folders, (f'{NAME}/*/*',), _mapped()),
    'calibration': Kind(make_folders, (f'{NAME}/*.yaml', f'{NAME}/times.txt'), _mapped()),
    'EuRoC text': Kind(make_euroc, (f'{NAME}/*/*.csv', f'{NAME}/*/*.yaml'), _mapped()),
    'EuRoC images': Kind(make_euroc, (f'{NAME}/cam?/data/*',), _mapped()),
    'RGB-D': Kind(make_rgbd, (f'{NAME}/*.txt', f'{NAME}/*.yaml', f'{NAME}/*/*'), _mapped()),
    'mcap': Kind(make_mcap, ('drive.mcap',), _mapped(input='drive.mcap')),
    'compressed bag': Kind(
        make_compressed_mcap, ('drive.mcap.zstd',), _mapped(input='drive.mcap.zstd')
    ),
    'list of pairs': Kind(make_pairs_list, (f'{NAME}/*.txt',), _mapped()),
    **{
        f'calibration {file}': Kind(
            make_other_calibrations, (file,),
            ('calibrate', '--from', f'{{}}/{file}', '--out', '{}/results'),
        )
        for file in ('oak.json', 'basalt.json', 'orb.yaml', 'zed.conf')
    },
    'bag folder': Kind(make_bag_folder, (f'{NAME}/metadata.yaml', f'{NAME}/*.mcap'), _mapped()),
    'sqlite bag': Kind(make_sqlite, (f'{NAME}/*',), _mapped()),
    'ROS 1 bag': Kind(make_ros1, ('drive.bag',), _mapped(input='drive.bag')),
    'video': Kind(make_video, (f'{NAME}/drive.avi',), _mapped(input=f'{NAME}/drive.avi')),
    'parameters': Kind(
        make_params, ('params.yaml',), ('run', f'{{}}/{NAME}', '--out', '{}/results',
                                        '--params', '{}/params.yaml')
    ),
    'an option': Kind(make_words, ('word',), _mapped('--set', '{word}')),
    'saved map': Kind(make_saved_map, ('saved.map',), _mapped('--load-map', '{}/saved.map')),
    'convert': Kind(
        make_kitti, (f'{NAME}/*.*', f'{NAME}/image_?/*'), ('convert', f'{{}}/{NAME}', '{}/o.mcap')
    ),
    'map': Kind(
        make_results, ('run/map.*', 'truth/map.*', 'truth/scene.yaml', 'truth/base_poses.txt'),
        ('evaluate', 'map', '{}/run', '{}/truth', *PLAN),
    ),
    'trajectories': Kind(
        make_results, ('run/camera_trajectory.txt', 'truth/*s.txt', 'run/summary.json'),
        ('evaluate', 'trajectory', '{}/run', '{}/truth'),
    ),
    'floor masks': Kind(
        make_masks, (f'{NAME}/*/*',), ('evaluate', 'floor', f'{{}}/{NAME}/a', f'{{}}/{NAME}/b')
    ),
    'outlines': Kind(
        make_masks, ('outlines.yaml',),
        ('evaluate', 'floor', f'{{}}/{NAME}/a', '{}/outlines.yaml'),
    ),
    'report': Kind(
        make_results, ('run/*.*', 'run/*/*'),
        ('evaluate', 'report', '{}/run', '--truth', '{}/truth'),
    ),
    'chessboards': Kind(
        make_chessboards, (f'{NAME}/*',),
        ('calibrate', f'{{}}/{NAME}', '--square', '0.03', '--board', '5x4', '--out', '{}/results'),
    ),
    'suite': Kind(make_suite, ('suite.yaml',), SUITE),
    'results of a suite': Kind(make_suite, ('run/*.*', 'truth/*.*', 'truth/*/*'), SUITE),
    'baseline': Kind(
        make_suite, ('baseline.json',), (*SUITE, '--baseline', '{}/baseline.json')
    ),
    'resumed check': Kind(make_suite, ('out/*/measured.json',), (*SUITE, '--resume')),
    'scene': Kind(make_scene, ('scene.yaml',), (*SIMULATE, '{}/scene.yaml')),
    'floor plan': Kind(
        make_floor_plan, (f'{NAME}/*',), (*SIMULATE, *SMALL, f'{{}}/{NAME}/plan.yaml')
    ),
}  # fmt: skip


def files_of(kind: Kind, folder: Path) -> list[Path]:
    """Return the files of an input that are damaged."""
    found = {path for pattern in kind.files for path in folder.glob(pattern.replace('[', '[[]'))}
    return sorted(path for path in found if path.is_file())


def words_of(kind: Kind, folder: Path) -> Sequence[str]:
    """Return the words of the command for an input in a folder."""
    value = folder / 'word'
    word = value.read_bytes() if value.is_file() else b''
    text = word.replace(b'\0', b'').decode(errors='surrogateescape')[:100_000]
    return [text if w == '{word}' else w.replace('{}', str(folder)) for w in kind.command]
