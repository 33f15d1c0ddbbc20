"""Masks of what moves, beside a recording."""

import cv2
import numpy as np
import pytest
from camera_recordings import HEIGHT, WIDTH, grey_pairs, opened, write_kitti

from segfloor_ros.core.errors import InputError


def write_mask(folder, index, mask):
    folder.mkdir(exist_ok=True)
    cv2.imwrite(str(folder / f'{index:06d}.png'), mask)


@pytest.fixture
def drive(tmp_path):
    return write_kitti(tmp_path / 'drive', grey_pairs(3))


def test_frames_carry_the_mask_of_their_index_and_no_other(drive, tmp_path):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[4:9, 10:20] = 255
    write_mask(tmp_path / 'masks', 1, mask)
    frames = list(opened(drive, masks=str(tmp_path / 'masks')).frames())
    assert frames[0].excluded is None and frames[2].excluded is None
    np.testing.assert_array_equal(frames[1].excluded, mask)
    assert all(frame.excluded is None for frame in opened(drive).frames())


def test_a_mask_of_another_size_is_named(drive, tmp_path):
    write_mask(tmp_path / 'masks', 2, np.zeros((HEIGHT, WIDTH - 2), np.uint8))
    source = opened(drive, masks=str(tmp_path / 'masks'))
    with pytest.raises(InputError, match=rf'000002.png: is {WIDTH - 2}x{HEIGHT}'):
        list(source.frames())


def test_a_file_that_is_no_image_is_named_and_its_frame_alone_is_lost(drive, tmp_path, caplog):
    (tmp_path / 'masks').mkdir()
    (tmp_path / 'masks' / '000001.png').write_bytes(b'nothing')
    with pytest.raises(InputError, match=r'000001\.png: the image cannot be decoded'):
        list(opened(drive, masks=str(tmp_path / 'masks')).frames())
    write_mask(tmp_path / 'masks', 0, np.zeros((HEIGHT, WIDTH), np.uint8))
    source = opened(drive, masks=str(tmp_path / 'masks'))
    assert [frame.index for frame in source.frames()] == [0, 2]
    assert source.skipped_frames == 1
    assert 'frame 1 is skipped' in caplog.text and '000001.png: the image cannot be' in caplog.text


def test_an_image_of_another_size_is_lost_alone(drive, caplog):
    path = drive / 'image_1' / '000001.png'
    cv2.imwrite(str(path), cv2.imread(str(path))[:, 4:])
    source = opened(drive)
    assert [frame.index for frame in source.frames()] == [0, 2]
    assert f'frame 1 is {WIDTH - 4}x{HEIGHT}' in caplog.text


def test_a_folder_without_masks_is_refused(drive, tmp_path):
    with pytest.raises(InputError, match='no such folder'):
        opened(drive, masks=str(tmp_path / 'nowhere'))
    (tmp_path / 'empty').mkdir()
    with pytest.raises(InputError, match='holds no masks'):
        opened(drive, masks=str(tmp_path / 'empty'))
