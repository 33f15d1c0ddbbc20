"""Bags of all formats and encodings, their topics, and what is wrong with bad ones."""

import builtins
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from camera_recordings import (
    BASELINE_M,
    FX,
    MS,
    Message,
    calibration,
    compressed_message,
    grey_pairs,
    image_message,
    info_message,
    opened,
    stereo_messages,
    write_rosbag1,
    write_rosbag2,
)

from segfloor_ros.apps.recordings.bag_file import CAMERA_INFO, COMPRESSED, IMAGE, find_topics
from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.camera.rectification import StereoRectifier
from segfloor_ros.core.errors import CalibrationError, InputError

STAMPS = [1_700_000_000_000_000_000 + i * 100 * MS for i in range(4)]
LEFT, RIGHT = '/stereo/left/image_raw', '/stereo/right/image_raw'


def mcap_folder(path: Path, messages: Sequence[Message]) -> Path:
    return write_rosbag2(path / 'drive', messages)


def mcap_file(path: Path, messages: Sequence[Message]) -> Path:
    return write_rosbag2(path / 'drive', messages) / 'drive.mcap'


def mcap_without_metadata(path: Path, messages: Sequence[Message]) -> Path:
    folder = write_rosbag2(path / 'drive', messages)
    (folder / 'metadata.yaml').unlink()
    return folder


def sqlite_folder(path: Path, messages: Sequence[Message]) -> Path:
    return write_rosbag2(path / 'drive', messages, 'sqlite3')


def sqlite_file(path: Path, messages: Sequence[Message]) -> Path:
    return write_rosbag2(path / 'drive', messages, 'sqlite3') / 'drive.db3'


def ros1_bag(path: Path, messages: Sequence[Message]) -> Path:
    return write_rosbag1(path / 'drive.bag', messages)


@pytest.mark.parametrize(
    'write', [mcap_folder, mcap_file, mcap_without_metadata, sqlite_folder, sqlite_file, ros1_bag]
)
def test_bags_of_all_formats_give_rectified_pairs(
    tmp_path: Path, write: Callable[[Path, Sequence[Message]], Path]
) -> None:
    pairs = grey_pairs(4)
    source = opened(write(tmp_path, stereo_messages(pairs, STAMPS)))
    assert (source.frame_count, source.rate_hz) == (4, 10.0)
    assert (source.camera.fx, source.camera.baseline_m) == (FX, BASELINE_M)
    rectifier = StereoRectifier(calibration(distorted=True))
    frames = list(source.frames())
    assert [frame.stamp_ns for frame in frames] == STAMPS
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    for frame, raw, pair in zip(frames, source.raw_pairs(), pairs, strict=True):
        left, right = rectifier.rectify(*pair)
        np.testing.assert_array_equal(frame.left, left)
        np.testing.assert_array_equal(frame.right, right)
        np.testing.assert_array_equal(raw.right, pair[1])


@pytest.mark.parametrize('rectified_by', ['topic', 'calibration'])
def test_rectified_images_pass_through(tmp_path: Path, rectified_by: str) -> None:
    pairs = grey_pairs(2)
    by_topic = rectified_by == 'topic'
    name = 'image_rect' if by_topic else 'image_raw'
    messages = stereo_messages(
        pairs,
        STAMPS[:2],
        (f'/left/{name}', f'/right/{name}'),
        calibration(distorted=by_topic),  # CameraInfo beside image_rect still tells of the lens
    )
    source = opened(mcap_file(tmp_path, messages))
    assert source.calibration.is_rectified
    np.testing.assert_array_equal([f.left for f in source.frames()], [left for left, _ in pairs])


def test_colour_and_sixteen_bit_images_become_grey(tmp_path: Path) -> None:
    red = np.zeros((48, 64, 3), np.uint8)
    red[:, :, 0] = 255
    source = opened(mcap_file(tmp_path, stereo_messages([(red, red)], STAMPS[:1], encoding='rgb8')))
    assert np.abs(next(source.raw_pairs()).left.astype(int) - 76).max() <= 1
    deep = np.full((48, 64), 1000, np.uint16)  # 10 bits
    messages = stereo_messages([(deep, deep)], STAMPS[:1], encoding='mono16')
    source = opened(ros1_bag(tmp_path, messages))
    assert next(source.raw_pairs()).left[0, 0] == 252


@pytest.mark.parametrize('write', [mcap_file, ros1_bag])
def test_a_fisheye_of_sixteen_bits_is_rectified_as_from_files(
    tmp_path: Path, write: Callable[[Path, Sequence[Message]], Path]
) -> None:
    D = [0.02, -0.005, 0.003, -0.001]
    eyes = [
        EyeCalibration(64, 48, eye.K, D, np.eye(3), eye.P, 'equidistant')
        for eye in (calibration().left, calibration().right)
    ]
    fisheye = StereoCalibration(*eyes)
    pairs = [
        (left.astype(np.uint16) << 4, right.astype(np.uint16) << 4) for left, right in grey_pairs(4)
    ]
    source = opened(
        write(tmp_path, stereo_messages(pairs, STAMPS, eyes=fisheye, encoding='mono16'))
    )
    assert source.calibration.left.distortion_model == 'equidistant'
    rectifier = StereoRectifier(fisheye)
    for frame, (left, _) in zip(source.frames(), pairs, strict=True):
        grey = np.rint(255 * np.sqrt(left / 4095)).astype(np.uint8)
        np.testing.assert_array_equal(frame.left, rectifier.rectify(grey, grey)[0])


@pytest.mark.parametrize('write', [mcap_file, ros1_bag])
def test_compressed_images_are_decoded(
    tmp_path: Path, write: Callable[[Path, Sequence[Message]], Path]
) -> None:
    pairs = grey_pairs(2)
    eyes = calibration()
    messages = []
    for stamp_ns, pair in zip(STAMPS, pairs, strict=False):
        for side, eye, image in zip(('left', 'right'), (eyes.left, eyes.right), pair, strict=True):
            png = cv2.imencode('.png', image)[1].tobytes()
            messages.append(info_message(f'/cam/{side}/camera_info', stamp_ns, eye))
            topic = f'/cam/{side}/image_raw/compressed'
            messages.append(compressed_message(topic, stamp_ns, png))
    source = opened(write(tmp_path, messages))
    np.testing.assert_array_equal([f.right for f in source.frames()], [r for _, r in pairs])


@pytest.mark.parametrize(
    ('topics', 'expected'),
    [
        ('/left/image_raw /right/image_raw', '/left/image_raw'),
        ('/a/left/image_raw /a/right/image_raw /b/left/image_rect', '/a/left/image_raw'),
        ('/left/image_raw /right/image_raw /left/image_rect /right/image_rect', '/left/image_rect'),
        (
            '/camera/infra1/image_rect_raw /camera/infra2/image_rect_raw '
            '/camera/depth/image_rect_raw /camera/color/image_raw',
            '/camera/infra1/image_rect_raw',
        ),
        ('/left/image_raw/compressed /right/image_raw/compressed', '/left/image_raw/compressed'),
        (
            '/left/image_color/compressed /right/image_color/compressed '
            '/left/image_color /right/image_color',
            '/left/image_color',
        ),
        ('/cam0/image_raw /cam1/image_raw', '/cam0/image_raw'),
        (
            '/keyframe/left/image_rect /keyframe/right/image_rect /left/image_raw /right/image_raw',
            '/left/image_raw',
        ),
        ('/stereo_left /stereo_right', '/stereo_left'),
    ],
)
def test_stereo_topics_are_found_by_name(topics: str, expected: str) -> None:
    types = {t: COMPRESSED if t.endswith('compressed') else IMAGE for t in topics.split()}
    assert find_topics('bag', types, '', '').left == expected


@pytest.mark.parametrize(
    ('image', 'info'),
    [
        ('/a/left/image_raw', '/a/left/camera_info'),
        ('/a/left/image_raw/compressed', '/a/left/camera_info'),
        ('/left_camera/mono/image', '/left_camera/camera_info'),
        ('/camera/infra1/image_rect_raw', '/camera/infra1/camera_info'),
    ],
)
def test_camera_info_is_the_nearest_of_the_same_side(image: str, info: str) -> None:
    def other(topic: str) -> str:
        return topic.replace('left', 'right').replace('infra1', 'infra2')

    types = {image: IMAGE, other(image): IMAGE, '/z/left/camera_info': CAMERA_INFO}
    types |= {info: CAMERA_INFO, other(info): CAMERA_INFO}
    found = find_topics('bag', types, '', '')
    assert (found.left_info, found.right_info) == (info, other(info))


def test_topics_of_the_settings_are_taken(tmp_path: Path) -> None:
    pairs = grey_pairs(2)
    messages = stereo_messages(pairs, STAMPS[:2], ('/front/one/image', '/front/two/image'))
    path = mcap_file(tmp_path, messages)
    source = opened(path, left_image_topic='/front/one/image', right_image_topic='/front/two/image')
    np.testing.assert_array_equal([p.left for p in source.raw_pairs()], [left for left, _ in pairs])
    with pytest.raises(InputError, match=r'no pair of left and right image topics .*/front/one/im'):
        opened(path)
    with pytest.raises(InputError, match=r'no images on /one; set stereo_camera.left_image_topic'):
        opened(path, left_image_topic='/one', right_image_topic='/front/two/image')


def test_sides_that_arrive_late_and_apart_are_paired(tmp_path: Path) -> None:
    pairs = grey_pairs(4)
    messages = [
        info_message('/left/camera_info', 0, calibration().left),
        info_message('/right/camera_info', 0, calibration().right),
    ]
    for i, (left, right) in enumerate(pairs):
        stamp_ns = i * 100 * MS
        # The left image is recorded 0.25 s after the right one, whose stamp is 3 ms later.
        late_ns = stamp_ns + 250 * MS
        messages.append(image_message('/left/image_raw', stamp_ns, left, time_ns=late_ns))
        messages.append(
            image_message('/right/image_raw', stamp_ns + 3 * MS, right, time_ns=stamp_ns)
        )
    messages.sort(key=lambda message: message.time_ns)
    frames = list(opened(mcap_file(tmp_path, messages)).frames())
    assert [frame.stamp_ns // MS for frame in frames] == [0, 100, 200, 300]
    np.testing.assert_array_equal([f.left for f in frames], [left for left, _ in pairs])
    np.testing.assert_array_equal([f.right for f in frames], [right for _, right in pairs])


def test_missing_images_leave_a_gap(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    messages = stereo_messages(grey_pairs(4), STAMPS)
    lost = [m for m in messages if m.topic == RIGHT][1]
    source = opened(mcap_file(tmp_path, [m for m in messages if m is not lost]))
    with caplog.at_level(logging.WARNING):
        assert [f.stamp_ns for f in source.frames()] == [STAMPS[0], STAMPS[2], STAMPS[3]]
    assert '1 and 0 images have no partner' in caplog.text


def test_damaged_images_are_skipped_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pairs = grey_pairs(4)
    messages = stereo_messages(pairs, STAMPS)
    number = [i for i, m in enumerate(messages) if m.topic == LEFT][2]
    messages[number] = image_message(LEFT, STAMPS[2], pairs[2][0], step=60)
    source = opened(mcap_file(tmp_path, messages))
    with caplog.at_level(logging.WARNING):
        assert [frame.index for frame in source.frames()] == [0, 1, 3]
    assert source.skipped_frames == 1
    assert f'frame 2 is skipped: {LEFT}: 3072 bytes do not make a 64x48 mono8' in caplog.text


def test_images_recorded_twice_come_once(tmp_path: Path) -> None:
    messages = stereo_messages(grey_pairs(3), STAMPS[:3])
    source = opened(mcap_file(tmp_path, messages + messages[-4:]))
    assert [frame.stamp_ns for frame in source.frames()] == STAMPS[:3]
    assert source.skipped_frames == 1


def reversed_stamps() -> list[Message]:
    return [
        message._replace(time_ns=i)
        for i, message in enumerate(stereo_messages(grey_pairs(4), STAMPS[::-1]))
    ]


def without(part: str) -> list[Message]:
    return [m for m in stereo_messages(grey_pairs(2), STAMPS[:2]) if part not in m.topic]


def with_info(side: str, **changes: Any) -> list[Message]:
    eye = getattr(calibration(), side)
    return [
        info_message(m.topic, m.time_ns, eye, **changes)
        if m.topic == f'/stereo/{side}/camera_info'
        else m
        for m in stereo_messages(grey_pairs(2), STAMPS[:2])
    ]


def right_later_by(ms: int) -> list[Message]:
    left = [m for m in stereo_messages(grey_pairs(2), STAMPS[:2]) if 'left' in m.topic]
    late = [stamp_ns + ms * MS for stamp_ns in STAMPS[:2]]
    return left + [m for m in stereo_messages(grey_pairs(2), late) if 'right' in m.topic]


@pytest.mark.parametrize(
    ('messages', 'error', 'message'),
    [
        ([], InputError, 'drive: the bag is empty; record the image topics again'),
        (without('image'), InputError, r'no pair .* \(its image topics: none\); set stereo_camera'),
        (without('right/image'), InputError, r'no pair .*: /stereo/left/image_raw\); set stereo_'),
        (without('left/camera_info'), CalibrationError, f'no CameraInfo beside {LEFT}; record it'),
        (with_info('left', k=np.zeros(9)), CalibrationError, r'left/camera_info: K\[0\] = 0, so'),
        (with_info('right', p=calibration().left.P.ravel()), CalibrationError, 'baseline is 0 m'),
        (with_info('right', p=-calibration().right.P.ravel()), CalibrationError, r'P\[0\] = -50'),
        (with_info('left', d=np.full(5, np.nan)), CalibrationError, 'D holds values .* not finite'),
        (with_info('left', width=128), CalibrationError, '128x48, .* need the same size'),
        (reversed_stamps(), InputError, f'{LEFT}: the stamp goes backwards, from .* cut the'),
        (right_later_by(40), InputError, 'no two images within 0.01 s; the nearest are 0.04'),
    ],
)
@pytest.mark.parametrize('write', [mcap_folder, sqlite_folder])
def test_faults_of_bags_are_named(
    tmp_path: Path,
    write: Callable[[Path, Sequence[Message]], Path],
    messages: list[Message],
    error: type[Exception],
    message: str,
) -> None:
    path = write(tmp_path, messages)
    with pytest.raises(error, match=message) as caught:
        list(opened(path).frames())
    assert str(path) in str(caught.value)
    assert '\n' not in str(caught.value)


def test_images_of_another_size_than_their_info_are_refused(tmp_path: Path) -> None:
    messages = stereo_messages(grey_pairs(1, width=32, height=24), STAMPS[:1])
    path = mcap_file(tmp_path, messages)
    with pytest.raises(CalibrationError, match=r'frame 0 is 32x24, but .*left/camera_info is for'):
        opened(path)


@pytest.mark.parametrize('write', [mcap_file, sqlite_file, ros1_bag])
def test_damaged_bags_end_in_one_line(
    tmp_path: Path, write: Callable[[Path, Sequence[Message]], Path]
) -> None:
    path = write(tmp_path, stereo_messages(grey_pairs(4), STAMPS))
    data = path.read_bytes()
    for spoilt in (b'', b'no bag', data[: len(data) // 2]):
        path.write_bytes(spoilt)
        with pytest.raises(InputError, match=r'drive\.\w+: cannot read the bag .* repair it') as e:
            list(opened(path).frames())
        assert '\n' not in str(e.value)


def test_a_folder_of_several_bags_asks_for_one(tmp_path: Path) -> None:
    for name in ('a.bag', 'b.bag'):
        write_rosbag1(tmp_path / name, [])
    with pytest.raises(InputError, match=r'holds 2 bags \(a.bag, b.bag\); name one of them'):
        opened(tmp_path)


def test_without_the_library_the_message_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = mcap_file(tmp_path, stereo_messages(grey_pairs(1), STAMPS[:1]))
    real_import = builtins.__import__

    def no_rosbags(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith('rosbags'):
            raise ImportError(name)
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, '__import__', no_rosbags)
    with pytest.raises(InputError, match=r'rosbag2_py of a ROS.*pip install rosbags'):
        opened(path)


def test_stamps_may_differ_by_the_tolerance_that_is_set(tmp_path: Path) -> None:
    pairs, late = grey_pairs(3), [stamp_ns + 15 * MS for stamp_ns in STAMPS[:3]]
    messages = [
        message
        for stamps, side in ((STAMPS[:3], 'left'), (late, 'right'))
        for message in stereo_messages(pairs, stamps)
        if side in message.topic
    ]
    bag = mcap_file(tmp_path, messages)
    with pytest.raises(InputError, match=r'raise stereo_camera\.pairing_tol'):
        list(opened(bag).frames())
    assert len(list(opened(bag, pairing_tolerance_s=0.02).frames())) == 3
