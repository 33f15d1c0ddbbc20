"""KITTI, EuRoC and image folders: order, stamps, pixels, and what is wrong with bad ones."""

import logging
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_recordings import (
    BASELINE_M,
    DISTORTION,
    FX,
    MS,
    P_LEFT,
    P_RIGHT,
    calibration,
    grey_pairs,
    kitti_line,
    opened,
    sensor_yaml,
    write_euroc,
    write_folders,
    write_image,
    write_kitti,
)

from segfloor_ros.apps.recordings import StereoSource, open_source
from segfloor_ros.apps.recordings.calibration_files import write_ros_calibration
from segfloor_ros.apps.recordings.files import partners
from segfloor_ros.core.camera.rectification import StereoRectifier
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.errors import CalibrationError, InputError


def left_images(source: StereoSource) -> list[np.ndarray]:
    return [frame.left for frame in source.frames()]


def stamps_ms(source: StereoSource) -> list[float]:
    return [frame.stamp_ns / MS for frame in source.frames()]


def test_kitti_pairs_come_as_they_are(tmp_path: Path) -> None:
    pairs = grey_pairs(4)
    source = opened(write_kitti(tmp_path / 'drive', pairs))
    assert (source.frame_count, source.rate_hz, source.skipped_frames) == (4, 10.0, 0)
    assert (source.camera.fx, source.camera.baseline_m) == (FX, BASELINE_M)
    frames = list(source.frames())
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert [frame.stamp_ns for frame in frames] == [0, 100 * MS, 200 * MS, 300 * MS]
    for frame, (left, right) in zip(frames, pairs, strict=True):
        np.testing.assert_array_equal(frame.left, left)
        np.testing.assert_array_equal(frame.right, right)


def test_kitti_stamps_are_exact_in_nanoseconds(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path, grey_pairs(2))
    (folder / 'times.txt').write_text('1403715273.262142976\n1.403715273312143104e+09\n')
    stamps = [frame.stamp_ns for frame in opened(folder).frames()]
    assert stamps == [1403715273262142976, 1403715273312143104]


def test_part_of_a_kitti_drive_keeps_its_numbers_and_times(tmp_path: Path) -> None:
    source = opened(write_kitti(tmp_path, grey_pairs(3), first=7))
    assert [frame.index for frame in source.frames()] == [7, 8, 9]
    assert stamps_ms(source) == [700, 800, 900]


@pytest.mark.parametrize(
    ('start', 'frames', 'every', 'expected'),
    [(0, 0, 1, range(9)), (2, 0, 1, range(2, 9)), (0, 3, 1, range(3)), (1, 3, 2, [1, 3, 5])],
)
def test_a_part_of_a_recording_keeps_indices_and_times(
    tmp_path, start, frames, every, expected
) -> None:
    folder = write_kitti(tmp_path, grey_pairs(9))
    whole = list(opened(folder).frames())
    part = opened(folder, start=start, frames=frames, every=every)
    assert part.frame_count == len(expected)
    read = list(part.frames())
    assert [f.index for f in read] == list(expected)
    assert [f.stamp_ns for f in read] == [whole[i].stamp_ns for i in expected]
    for frame in read:
        np.testing.assert_array_equal(frame.left, whole[frame.index].left)


def test_a_part_behind_the_end_is_refused(tmp_path) -> None:
    with pytest.raises(InputError, match='has 3 frames; --start 3 is behind its end'):
        opened(write_kitti(tmp_path, grey_pairs(3)), start=3)


def test_kitti_colour_folders_are_read_as_grey(tmp_path: Path) -> None:
    red = np.zeros((48, 64, 3), np.uint8)
    red[:, :, 2] = 255
    for folder in ('image_2', 'image_3'):
        write_image(tmp_path / folder / '000000.png', red)
    (tmp_path / 'calib.txt').write_text(kitti_line('P2', P_LEFT) + kitti_line('P3', P_RIGHT))
    source = opened(tmp_path)
    assert stamps_ms(source) == [0]
    assert np.abs(left_images(source)[0].astype(int) - 76).max() <= 1  # 0.299 * 255


def test_folders_are_read_in_natural_order_at_10_hz(tmp_path: Path) -> None:
    pairs = grey_pairs(11)
    source = opened(write_folders(tmp_path, pairs))
    assert (tmp_path / 'left' / 'left10.png').exists()
    np.testing.assert_array_equal(left_images(source), [left for left, _ in pairs])
    assert stamps_ms(source)[-1] == 1000
    assert stamps_ms(opened(tmp_path, rate_hz=4.0))[:3] == [0, 250, 500]


@pytest.mark.parametrize(
    'names',
    [
        ('left_images/{}.png', 'right_images/{}.png'),
        ('image_left/a{}.png', 'image_right/b{}.png'),
        ('cam0/data/{}.png', 'cam1/data/{}.png'),
        ('image_0/{}.png', 'image_1/{}.png'),
        ('left{}.png', 'right{}.png'),
        ('{}_left.png', '{}_right.png'),
    ],
)
def test_usual_names_of_folders_are_known(tmp_path: Path, names: tuple[str, str]) -> None:
    pairs = grey_pairs(3)
    source = opened(write_folders(tmp_path, pairs, names))
    for frame, (left, right) in zip(source.frames(), pairs, strict=True):
        np.testing.assert_array_equal(frame.left, left)
        np.testing.assert_array_equal(frame.right, right)


def test_names_that_are_times_and_files_of_times_give_the_stamps(tmp_path: Path) -> None:
    pairs = grey_pairs(2)
    first = 1403715273262142976
    assert stamps_ms(opened(write_folders(tmp_path / 'a', pairs))) == [0, 100]
    folder = write_folders(tmp_path / 'b', pairs, ('left/{}.png', 'right/{}.png'), first=first)
    assert [f.stamp_ns for f in opened(folder).frames()] == [first, first + 1]
    (folder / 'times.txt').write_text('5\n5.05\n')
    assert stamps_ms(opened(folder)) == [5000, 5050]


def test_unrectified_folders_are_rectified_and_raw_pairs_are_not(tmp_path: Path) -> None:
    pairs = grey_pairs(2)
    source = opened(write_folders(tmp_path, pairs, distorted=True))
    rectifier = StereoRectifier(calibration(distorted=True))
    for frame, raw, pair in zip(source.frames(), source.raw_pairs(), pairs, strict=True):
        expected = rectifier.rectify(*pair)
        np.testing.assert_array_equal(frame.left, expected[0])
        np.testing.assert_array_equal(frame.right, expected[1])
        np.testing.assert_array_equal(raw.left, pair[0])
        assert not np.array_equal(frame.left, raw.left)
    np.testing.assert_array_equal(source.calibration.left.D, DISTORTION)


def test_sixteen_bit_images_share_one_scale(tmp_path: Path) -> None:
    first = np.full((48, 64), 4000, np.uint16)  # 12 bits
    second = np.full((48, 64), 1024, np.uint16)
    folder = write_folders(tmp_path, [(first, first), (second, second)])
    assert [image[0, 0] for image in left_images(opened(folder))] == [252, 128]


def test_given_calibration_files_come_before_those_of_the_recording(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path / 'drive', grey_pairs(1))
    left, right = tmp_path / 'l.yaml', tmp_path / 'r.yaml'
    write_ros_calibration(left, calibration(distorted=True).left, 'l')
    write_ros_calibration(right, calibration(distorted=True).right, 'r')
    source = opened(folder, left_calibration=str(left), right_calibration=str(right))
    assert not source.calibration.is_rectified
    with pytest.raises(CalibrationError, match=r'belong together; only .*l\.yaml is given'):
        opened(folder, left_calibration=str(left))


@pytest.mark.parametrize('inside', [True, False])
def test_euroc_pairs_by_stamp(tmp_path: Path, inside: bool) -> None:
    left_ns, right_ns = [0, 50 * MS, 100 * MS], [1000, 50 * MS, 99 * MS]
    pairs = grey_pairs(3)
    folder = write_euroc(tmp_path, pairs, left_ns, right_ns)
    source = opened(folder / 'mav0' if inside else folder)
    assert [frame.stamp_ns for frame in source.frames()] == left_ns
    assert source.rate_hz == pytest.approx(20.0)
    assert source.camera.baseline_m == pytest.approx(BASELINE_M)
    np.testing.assert_array_equal([p.right for p in source.raw_pairs()], [r for _, r in pairs])


def test_euroc_images_without_partner_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    left_ns = [0, 50 * MS, 100 * MS, 150 * MS]
    folder = write_euroc(tmp_path, grey_pairs(4), left_ns, [0, 100 * MS, 150 * MS])
    with caplog.at_level(logging.WARNING):
        source = opened(folder)
    assert [frame.stamp_ns for frame in source.frames()] == [0, 100 * MS, 150 * MS]
    assert '1 and 0 images have no partner' in caplog.text


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])


@pytest.mark.parametrize('broken', [0, 2])
def test_truncated_images_are_skipped_with_a_warning_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, broken: int
) -> None:
    folder = write_kitti(tmp_path, grey_pairs(4))
    truncate(folder / 'image_1' / f'{broken:06d}.png')
    source = opened(folder)
    with caplog.at_level(logging.WARNING):
        indices = [frame.index for frame in source.frames()]
    assert indices == [i for i in range(4) if i != broken]
    assert source.skipped_frames == 1
    assert f'frame {broken} is skipped: ' in caplog.text
    assert caplog.text.count(f'{broken:06d}.png: the PNG is truncated') == 1


def test_a_stamp_that_comes_twice_is_skipped(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path, grey_pairs(3))
    (folder / 'times.txt').write_text('0\n0.1\n0.1\n')
    source = opened(folder)
    assert [frame.index for frame in source.frames()] == [0, 1]
    assert source.skipped_frames == 1


def remove_right_folder(folder: Path) -> None:
    shutil.rmtree(folder / 'image_1')


def remove_all_images(folder: Path) -> None:
    for path in folder.glob('image_?/*.png'):
        path.unlink()


def truncate_all_images(folder: Path) -> None:
    for path in folder.glob('image_?/*.png'):
        truncate(path)


def remove_calibration(folder: Path) -> None:
    (folder / 'calib.txt').unlink()


def halve_images(folder: Path) -> None:
    for path in folder.glob('image_?/*.png'):
        cv2.imwrite(str(path), cv2.imread(str(path))[::2, ::2])


def go_backwards(folder: Path) -> None:
    (folder / 'times.txt').write_text('0\n0.1\n0.05\n0.2\n')


def remove_a_time(folder: Path) -> None:
    (folder / 'times.txt').write_text('0\n0.1\n0.2\n')


def stop_the_clock(folder: Path) -> None:
    (folder / 'times.txt').write_text(4 * '7.5\n')


def double_images(folder: Path) -> None:
    for path in folder.glob('image_?/*.png'):
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), None, fx=2, fy=2))


def spoil_a_time(folder: Path) -> None:
    (folder / 'times.txt').write_text('0\nsoon\n0.2\n0.3\n')


@pytest.mark.parametrize(
    ('spoil', 'error', 'message'),
    [
        (remove_right_folder, InputError, 'drive: has image_0, but a stereo pair is image_0 with'),
        (remove_all_images, InputError, 'drive: there are no images in its folders'),
        (truncate_all_images, InputError, 'drive: none of its 4 images can be decoded'),
        (remove_calibration, CalibrationError, 'calib.txt: the calibration is missing; put it'),
        (halve_images, CalibrationError, 'calib.txt, P0: the principal point .* 32x24; use the'),
        (go_backwards, InputError, 'times.txt, line 3: the stamp goes backwards, from 0.1.* cut'),
        (remove_a_time, InputError, 'times.txt: 3 times for 4 pairs of images; .* or remove it'),
        (double_images, CalibrationError, 'calib.txt, P0: .* images of about 64x48, these are 128'),
        (stop_the_clock, InputError, 'times.txt: all 4 times are the same; it needs the time in'),
        (spoil_a_time, InputError, 'times.txt, line 2: expected a time in seconds'),
    ],
)
def test_faults_of_kitti_folders_are_named(
    tmp_path: Path, spoil, error: type[Exception], message: str
) -> None:
    folder = write_kitti(tmp_path / 'drive', grey_pairs(4))
    spoil(folder)
    with pytest.raises(error, match=message) as caught:
        list(opened(folder).frames())
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(('unit', 'said'), [(1000.0, '100 s'), (1e-6, '1e-07 s'), (1.0, '')])
def test_times_in_another_unit_are_said(tmp_path: Path, caplog, unit: float, said: str) -> None:
    folder = write_kitti(tmp_path / 'drive', grey_pairs(4))
    (folder / 'times.txt').write_text(''.join(f'{0.1 * unit * i:.9f}\n' for i in range(4)))
    opened(folder)
    assert [r.getMessage() for r in caplog.records] == (
        [f'{folder}: {said} from pair to pair; times must be in seconds, where their name does not '
         'say otherwise'] if said else []
    )  # fmt: skip


def test_images_without_partner_are_left_out(tmp_path: Path, caplog) -> None:
    folder = write_folders(tmp_path / 'drive', grey_pairs(5))
    (folder / 'times.txt').write_text('0.0\n0.1\n0.2\n0.3\n0.4\n')
    whole = list(opened(folder).frames())
    (folder / 'right' / 'right2.png').unlink()
    (folder / 'left' / 'left5.png').unlink()
    (folder / 'times.txt').write_text('0.0\n0.1\n0.2\n0.3\n')
    there = list(opened(folder).frames())
    expected = [whole[0], whole[2], whole[3]]
    assert [frame.stamp_ns for frame in there] == [frame.stamp_ns for frame in expected]
    for frame, one in zip(there, expected, strict=True):
        np.testing.assert_array_equal(frame.left, one.left)
        np.testing.assert_array_equal(frame.right, one.right)
    assert [r.getMessage() for r in caplog.records] == [
        f'{folder}: 1 left and 1 right images have no partner of the same number; they are left out'
    ]


def test_images_keep_their_order_whatever_their_last_numbers() -> None:
    left, right = (
        [Path(f'{name}_{side}{i}.png') for name, i in (('a', 7), ('b', 2))] for side in 'lr'
    )
    assert partners('drive', left, right) == ([0, 1], [0, 1])


def test_a_kitti_copy_that_broke_off_is_read_as_far_as_it_goes(tmp_path: Path, caplog) -> None:
    folder = write_kitti(tmp_path / 'drive', grey_pairs(4))
    whole = list(opened(folder).frames())
    (folder / 'image_1' / '000003.png').unlink()
    there = list(opened(folder).frames())
    assert [(f.index, f.stamp_ns) for f in there] == [(f.index, f.stamp_ns) for f in whole[:3]]
    assert '1 left and 0 right images have no partner' in caplog.text


def test_faults_of_image_folders_are_named(tmp_path: Path) -> None:
    folder = write_folders(tmp_path / 'drive', grey_pairs(4))
    for path in (folder / 'right').iterdir():
        path.rename(path.with_stem(path.stem.replace('right', 'right10')))
    with pytest.raises(InputError, match=r'drive: 4 left and 4 right images, none with the number'):
        opened(folder)
    shutil.rmtree(folder / 'right')
    with pytest.raises(InputError, match=r'drive: 4 left and 0 right images'):
        opened(folder)


def test_image_folders_need_a_calibration_of_their_size(tmp_path: Path) -> None:
    folder = write_folders(tmp_path / 'drive', grey_pairs(2, width=80))
    with pytest.raises(CalibrationError, match=r'frame 0 is 80x48, but .*left.yaml is .* 64x48'):
        opened(folder)
    (folder / 'right.yaml').unlink()
    with pytest.raises(CalibrationError, match=r'right.yaml: the calibration is missing; put'):
        opened(folder)
    (folder / 'left.yaml').unlink()
    with pytest.raises(CalibrationError, match=r'drive: no calibration; put left.yaml and right'):
        opened(folder)
    (folder / 'times.txt').write_text('0\n')
    with pytest.raises(InputError, match=r'times.txt: 1 times for 2 pairs'):
        opened(folder)


def test_the_list_of_a_whole_recording_does_for_a_part_of_it(tmp_path: Path, caplog) -> None:
    stamps = [0, 50 * MS, 100 * MS]
    root = write_euroc(tmp_path, grey_pairs(3), stamps, stamps) / 'mav0'
    for eye in ('cam0', 'cam1'):
        (root / eye / 'data' / f'{stamps[2]}.png').unlink()
    assert [frame.stamp_ns for frame in opened(tmp_path).frames()] == stamps[:2]
    assert 'data.csv: 1 of 3 images do not exist' in caplog.text


def test_an_imu_of_unknown_mount_is_left_out(tmp_path: Path, caplog) -> None:
    root = write_euroc(tmp_path, grey_pairs(2), [0, 50 * MS], [0, 50 * MS]) / 'mav0'
    (root / 'imu0').mkdir()
    (root / 'imu0' / 'data.csv').write_text('0,0,0,0,0,9.8,0\n')
    assert [sensor.used for sensor in opened(tmp_path).sensors] == [False]
    assert 'imu0: no sensor.yaml says how the IMU is mounted; it is left out' in caplog.text


def test_faults_of_euroc_folders_are_named(tmp_path: Path) -> None:
    stamps = [0, 50 * MS, 100 * MS]
    root = write_euroc(tmp_path, grey_pairs(3), stamps, stamps) / 'mav0'
    index = root / 'cam1' / 'data.csv'
    good = index.read_text()
    index.write_text('#timestamp [ns],filename\n50,50.png\n60,60.png\n')
    with pytest.raises(InputError, match=r'data.csv: 2 of 2 images .* is .*/50.png; complete'):
        opened(tmp_path)
    index.write_text(good + '0,0.png\n')
    with pytest.raises(InputError, match=r'data.csv, line 5: the stamp goes backwards'):
        opened(tmp_path)
    index.write_text(good + 'soon,0.png\n')
    with pytest.raises(InputError, match=r'data.csv, line 5: expected a stamp in ns'):
        opened(tmp_path)
    index.write_text(good)
    (root / 'cam1' / 'sensor.yaml').unlink()
    with pytest.raises(CalibrationError, match=r'sensor.yaml: the calibration is missing'):
        opened(tmp_path)
    shutil.rmtree(root / 'cam1')
    with pytest.raises(InputError, match=r'cam1/data: no such folder; a stereo pair is cam0 and'):
        opened(tmp_path)


def test_euroc_cameras_without_a_common_clock_are_named(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path, grey_pairs(2), [0, 50 * MS], [900 * MS, 950 * MS])
    with pytest.raises(InputError, match=r'cam0 and .*cam1: no two images within 0.01 s; the n'):
        opened(folder)


def test_swapped_euroc_cameras_are_refused(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path, grey_pairs(1), [0], [0])
    T_left_right = np.eye(4)
    T_left_right[0, 3] = -0.2
    (folder / 'mav0' / 'cam1' / 'sensor.yaml').write_text(sensor_yaml(T_left_right))
    with pytest.raises(CalibrationError, match=r'camera is at \(-0.2, 0, 0\) m .* swapped'):
        opened(folder)


def test_inputs_of_no_known_kind_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'no input is given; set stereo_camera.input to a KITTI'):
        open_source(StereoCameraSettings())
    with pytest.raises(InputError, match=r'nowhere: no such file or folder; give a KITTI'):
        opened(tmp_path / 'nowhere')
    with pytest.raises(InputError, match=r'not a known kind of recording; give a KITTI'):
        opened(tmp_path)
    (tmp_path / 'notes.txt').write_text('hello')
    with pytest.raises(InputError, match=r'notes.txt: not a known kind of recording; give'):
        opened(tmp_path / 'notes.txt')
