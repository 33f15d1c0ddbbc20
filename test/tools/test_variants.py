"""Variants of a recording are what they are called, and scored by the frames they are made of."""

import numpy as np
import pytest
from stereo_drive import room_drive, write_kitti

from segfloor_ros.apps.recordings import open_source
from segfloor_ros.nodes.configuration import resolve
from tools.variants import VARIANTS, write_variant


@pytest.mark.parametrize('name', VARIANTS)
def test_a_variant_is_a_recording_of_the_same_camera(name, tmp_path):
    frames, _ = room_drive(5)
    recording = write_kitti(tmp_path / 'drive', frames)
    chosen, change = VARIANTS[name]
    indices = write_variant(recording, name, tmp_path / 'variant')
    assert indices == list(range(5))[chosen]
    source = open_source(resolve(stereo_camera={'input': str(tmp_path / 'variant')}).stereo_camera)
    written = list(source.frames())
    assert (
        source.camera
        == open_source(resolve(stereo_camera={'input': str(recording)}).stereo_camera).camera
    )
    assert (np.diff([frame.stamp_ns for frame in written]) > 0).all()
    for frame, index in zip(written, indices, strict=True):
        off = np.abs(frame.left.astype(float) - change(frames[index].left))
        assert off.mean() < 6  # noise is drawn anew
