"""Depth images in place of right ones: folders, the TUM RGB-D benchmark, bags; and their faults."""

import re
import struct
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from camera_recordings import (
    FX,
    MS,
    P_LEFT,
    calibration,
    compressed_message,
    grey_pairs,
    image_message,
    info_message,
    kitti_line,
    opened,
    stereo_messages,
    write_image,
    write_kitti,
    write_rosbag2,
)

from segfloor_ros.apps.recordings.bag_file import IMAGE, find_depth_topics
from segfloor_ros.core.camera.calibration import EyeCalibration
from segfloor_ros.core.camera.depth import VIRTUAL_BASELINE_M, depth_calibration, disparity_of_depth
from segfloor_ros.core.camera.images import depth_image
from segfloor_ros.core.camera.pixels import disparity_at
from segfloor_ros.core.camera.rectification import StereoRectifier
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.errors import InputError, SegfloorError
from segfloor_ros.core.floor.pair import seen_from_right

SCALE = FX * VIRTUAL_BASELINE_M
"""Disparity times depth."""


def depth_mm(value: int = 1500) -> np.ndarray:
    depth = np.full((48, 64), value, np.uint16)
    depth[:5] = 0
    return depth


def rgbd_folder(path: Path, count: int = 3) -> Path:
    folder = write_kitti(path, grey_pairs(count))
    for i in range(count):
        write_image(folder / 'depth' / f'{i:06d}.png', depth_mm(1000 + 500 * i))
    return folder


def test_depth_of_a_folder_is_used_when_asked_for(tmp_path: Path) -> None:
    folder = rgbd_folder(tmp_path)
    stereo = opened(folder)
    assert [(s.name, s.messages, s.used) for s in stereo.sensors] == [('depth', 3, False)]
    assert all(frame.right.dtype == np.uint8 for frame in stereo.frames())
    source = opened(folder, depth=True)
    assert [(s.name, s.messages, s.used) for s in source.sensors] == [('depth', 3, True)]
    assert source.camera.baseline_m == pytest.approx(VIRTUAL_BASELINE_M)
    for frame, depth_m, pair in zip(source.frames(), (1.0, 1.5, 2.0), grey_pairs(3), strict=True):
        np.testing.assert_array_equal(frame.left, pair[0])
        assert frame.right.dtype == np.float32
        assert np.isnan(frame.right[:5]).all()
        np.testing.assert_allclose(frame.right[5:], SCALE / depth_m, rtol=1e-6)


def test_a_folder_without_right_images_needs_no_option(tmp_path: Path) -> None:
    folder = rgbd_folder(tmp_path)
    for path in (folder / 'image_1').iterdir():
        path.unlink()
    (folder / 'image_1').rmdir()
    (folder / 'calib.txt').write_text(kitti_line('P0', P_LEFT))
    assert next(opened(folder).frames()).right.dtype == np.float32


def test_one_camera_alone_is_declined_with_the_reason(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path / 'kitti', grey_pairs(2))
    for path in (folder / 'image_1').iterdir():
        path.unlink()
    (folder / 'image_1').rmdir()
    with pytest.raises(InputError, match='one camera alone does not tell how far') as error:
        opened(folder)
    assert '\n' not in str(error.value)
    messages = [m for m in stereo_messages(grey_pairs(2), [0, MS]) if 'left' in m.topic]
    with pytest.raises(InputError, match='one camera alone does not tell how far'):
        opened(write_rosbag2(tmp_path / 'bag', messages))


def test_missing_depth_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'there are no depth images .*; leave out --depth'):
        opened(write_kitti(tmp_path / 'a', grey_pairs(2)), depth=True)
    folder = rgbd_folder(tmp_path / 'b')
    (folder / 'depth' / '000001.png').unlink()
    with pytest.raises(InputError, match=r'2 depth images for 3 left ones; the one of 000001.png'):
        opened(folder, depth=True)
    with pytest.raises(InputError, match='no depth images can be read from it; leave out --depth'):
        opened(write_rosbag2(tmp_path / 'c', stereo_messages(grey_pairs(2), [0, MS])), depth=True)


def test_depth_of_eight_bits_is_no_depth(tmp_path: Path) -> None:
    folder = rgbd_folder(tmp_path)
    write_image(folder / 'depth' / '000000.png', np.zeros((48, 64), np.uint8))
    with pytest.raises(InputError, match='16 bits'):
        opened(folder, depth=True)


def test_depth_in_metres_is_read_from_tiff_files(tmp_path: Path) -> None:
    folder = rgbd_folder(tmp_path)
    for i, path in enumerate(sorted((folder / 'depth').iterdir())):
        path.unlink()
        depth_m = depth_mm(1000 + 500 * i).astype(np.float32) / 1000
        write_image(path.with_suffix('.tiff'), depth_m)
    frames = list(opened(folder, depth=True).frames())
    np.testing.assert_allclose(
        [frame.right[20, 20] for frame in frames], SCALE / np.array([1.0, 1.5, 2.0])
    )


def test_depth_of_another_size_is_named(tmp_path: Path, caplog) -> None:
    folder = rgbd_folder(tmp_path)
    write_image(folder / 'depth' / '000001.png', depth_mm()[::2, ::2])
    assert 1 not in [frame.index for frame in opened(folder, depth=True).frames()]
    assert re.search('the depth image of frame 1 is 32x24, but .*64x48', caplog.text)


def test_a_tum_folder_is_paired_by_its_stamps(tmp_path: Path) -> None:
    folder = tmp_path / 'rgbd_dataset_freiburg3_office'
    rows: dict[str, list[str]] = {'rgb': ['# colour images'], 'depth': ['# depth maps']}
    for i, (left, _) in enumerate(grey_pairs(3)):
        wide = cv2.resize(left, (640, 480))
        write_image(folder / 'rgb' / f'{i}.png', cv2.cvtColor(wide, cv2.COLOR_GRAY2BGR))
        write_image(folder / 'depth' / f'{i}.png', np.full((480, 640), 10000, np.uint16))
        rows['rgb'].append(f'{1.5 + 0.033 * i:.6f} rgb/{i}.png')
        rows['depth'].append(f'{1.508 + 0.033 * i:.6f} depth/{i}.png')
    for name, lines in rows.items():
        (folder / f'{name}.txt').write_text('\n'.join(lines) + '\n')
    source = opened(folder)
    frames = list(source.frames())
    assert [frame.stamp_ns // MS for frame in frames] == [1500, 1533, 1566]
    assert source.camera.fx == pytest.approx(535.4)
    # 10000 units of a fifth of a millimetre are two metres.
    np.testing.assert_allclose(frames[0].right, 535.4 * VIRTUAL_BASELINE_M / 2.0, rtol=1e-5)
    (folder / 'rgb.txt').write_text('1.5 rgb/9.png\n')
    with pytest.raises(InputError, match=r'rgb.txt: 1 of 1 images do not exist.*complete the copy'):
        opened(folder)


@pytest.mark.parametrize('encoding', ['16UC1', '32FC1'])
def test_depth_of_a_bag_is_that_of_its_registered_topic(tmp_path: Path, encoding: str) -> None:
    depth = depth_mm() if encoding == '16UC1' else depth_mm().astype(np.float32) / 1000
    messages = []
    for stamp_ns, (left, _) in zip((0, 100 * MS), grey_pairs(2), strict=True):
        colour = cv2.cvtColor(left, cv2.COLOR_GRAY2RGB)
        messages += [
            info_message('/camera/color/camera_info', stamp_ns, calibration().left),
            image_message('/camera/color/image_raw', stamp_ns, colour, 'rgb8'),
            image_message('/camera/depth/image_rect_raw', stamp_ns, depth[::2, ::2], encoding),
            image_message(
                '/camera/aligned_depth_to_color/image_raw', stamp_ns + MS, depth, encoding
            ),
        ]
    source = opened(write_rosbag2(tmp_path / 'drive', messages))
    (sensor,) = source.sensors
    assert (sensor.where, sensor.used) == ('/camera/aligned_depth_to_color/image_raw', True)
    frame = next(source.frames())
    np.testing.assert_allclose(frame.right[5:], SCALE / 1.5, rtol=1e-6)
    np.testing.assert_allclose(frame.left, grey_pairs(2)[0][0], atol=1)


@pytest.mark.parametrize('encoding', ['16UC1', '32FC1'])
def test_compressed_depth_of_a_bag_is_read(tmp_path: Path, encoding: str) -> None:
    pixels, header = depth_mm(), struct.pack('<iff', 0, 0.0, 0.0)
    if encoding == '32FC1':  # a / depth + b
        pixels, header = depth_mm(120 + 20), struct.pack('<iff', 0, 180.0, 20.0)
    topic = '/camera/aligned_depth_to_color/image_raw/compressedDepth'
    data = header + cv2.imencode('.png', pixels)[1].tobytes()
    (left, _) = grey_pairs(1)[0]
    messages = [
        info_message('/camera/color/camera_info', 0, calibration().left),
        image_message('/camera/color/image_raw', 0, left, 'mono8'),
        compressed_message(topic, MS, data, f'{encoding}; compressedDepth png'),
    ]
    source = opened(write_rosbag2(tmp_path / 'drive', messages))
    assert [sensor.where for sensor in source.sensors] == [topic]
    right = next(source.frames()).right
    np.testing.assert_allclose(right[5:], SCALE / 1.5, rtol=1e-6)
    assert np.isnan(right[:5]).all()
    for words, problem in (('rvl', 'must be compressedDepth of'), ('png', 'are no compressed')):
        message = SimpleNamespace(format=f'{encoding}; compressedDepth {words}', data=header[:8])
        with pytest.raises(SegfloorError, match=problem):
            depth_image(message, topic)


def test_of_two_depth_topics_the_one_that_is_set_is_taken() -> None:
    types = dict.fromkeys(('/left/image_raw', '/a/depth', '/b/depth/image_raw'), IMAGE)
    for topic in ('/a/depth', '/b/depth/image_raw'):
        found = find_depth_topics('drive', types, StereoCameraSettings(depth_topic=topic))
        assert found is not None and (found.right, found.right_is_depth) == (topic, True)
    with pytest.raises(InputError, match='depth_topic to one of these: /a/depth, /b/depth/image'):
        find_depth_topics('drive', types, StereoCameraSettings(depth_topic='/c/depth'))


def test_a_stereo_bag_with_depth_stays_stereo_unless_asked(tmp_path: Path) -> None:
    messages = stereo_messages(grey_pairs(2), [0, 100 * MS])
    messages += [image_message('/depth/image_raw', t * MS, depth_mm(), '16UC1') for t in (0, 100)]
    bag = write_rosbag2(tmp_path / 'drive', messages)
    assert next(opened(bag).frames()).right.dtype == np.uint8
    assert next(opened(bag, depth=True).frames()).right.dtype == np.float32


def test_depth_is_freed_of_the_lens_with_the_image() -> None:
    eye = calibration(distorted=True).left
    calibrated = depth_calibration(eye)
    rectifier = StereoRectifier(calibrated)
    left = grey_pairs(1)[0][0]
    disparity = np.full(left.shape, 2.0, np.float32)
    disparity[:, :32] = np.nan
    _, straight = rectifier.rectify(left, disparity)
    assert set(np.unique(straight[np.isfinite(straight)])) == {2.0}
    assert np.isnan(straight[24, :28]).all() and np.isfinite(straight[24, 36:60]).all()


def test_disparity_at_a_pixel_is_the_median_and_edges_have_none() -> None:
    eye = EyeCalibration.of_rectified(64, 48, P_LEFT)
    depth = np.full((48, 64), 2.0, np.float32)
    depth[:, 32:] = 4.0
    depth[10, 10] = 0.0
    depth[20:23, 20:23] = 0.0
    disparity = disparity_of_depth(depth, depth_calibration(eye).camera)
    uv = np.array([[5.0, 5.0], [10.0, 10.0], [21.0, 21.0], [31.6, 30.0], [50.2, 30.3]])
    found, sigma = disparity_at(disparity, SCALE, uv)
    expected = [SCALE / 2, SCALE / 2, np.nan, np.nan, SCALE / 4]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    # At 2 m: 2.5 mm per square metre is 1 cm, and 2 mm; in disparity divided by Z² over f b.
    assert sigma[0] == pytest.approx(SCALE / 4 * np.hypot(0.01, 0.002), rel=1e-3)


def test_the_right_camera_sees_what_is_nearer_in_front() -> None:
    left = np.arange(64, dtype=np.uint8)[None].repeat(48, axis=0)
    disparity = np.full((48, 64), 2.0, np.float32)
    disparity[:, 40:50] = 6.0
    right = seen_from_right(left, disparity)
    np.testing.assert_array_equal(right[0, 34:44], left[0, 40:50])
    np.testing.assert_array_equal(right[0, 10:30], left[0, 12:32])
