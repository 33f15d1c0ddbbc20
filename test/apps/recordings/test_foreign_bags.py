"""Bags as other recorders and tools leave them."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_recordings import (
    MS,
    Message,
    calibration,
    grey_pairs,
    image_message,
    info_message,
    opened,
    stereo_messages,
    write_rosbag2,
)

from segfloor_ros.core.errors import InputError

STAMPS = [10**9 + i * 100 * MS for i in range(6)]
PAIRS = grey_pairs(6)

Spoil = Callable[[Path], Path]

NO_TIME = '{sec: 0, nsec: 0}'
QOS = (
    '{history: keep_last, depth: 77, reliability: reliable, durability: volatile, '
    f'deadline: {NO_TIME}, lifespan: {NO_TIME}, liveliness: automatic, '
    f'liveliness_lease_duration: {NO_TIME}, avoid_ros_namespace_conventions: false}}'
)


def messages(first: int = 0, last: int = 6) -> list[Message]:
    return stereo_messages(PAIRS[first:last], STAMPS[first:last])


def with_protobuf(path: Path) -> Path:
    """Return a copy of the bag's file with a channel of Foxglove's in it."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    file = path.parent / 'both.mcap'
    (bag,) = path.glob('*.mcap')
    with bag.open('rb') as source, file.open('wb') as out:
        writer = Writer(out)
        writer.start(profile='ros2')
        schema = writer.register_schema('foxglove.Log', 'protobuf', b'')
        other = writer.register_channel('/log', 'protobuf', schema)
        writer.add_message(other, STAMPS[0], b'\x08\x01', STAMPS[0])
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for kind, channel, message in make_reader(source).iter_messages():
            if channel.topic not in channels:
                schemas[kind.name] = writer.register_schema(kind.name, kind.encoding, kind.data)
                channels[channel.topic] = writer.register_channel(
                    channel.topic, 'cdr', schemas[kind.name]
                )
            writer.add_message(
                channels[channel.topic], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    return file


def changed_metadata(old: str, new: str) -> Spoil:
    def spoil(path: Path) -> Path:
        metadata = path / 'metadata.yaml'
        text = metadata.read_text()
        assert re.search(old, text)
        metadata.write_text(re.sub(old, new, text))
        return path

    return spoil


def without_its_folder(path: Path) -> Path:
    import zstandard

    (bag,) = [*path.glob('*.mcap'), *path.glob('*.db3')]
    file = path.parent / f'{bag.name}.zstd'
    file.write_bytes(zstandard.ZstdCompressor().compress(bag.read_bytes()))
    return file


def renamed(path: Path) -> Path:
    (bag,) = path.glob('*.mcap')
    bag.rename(path / 'other.mcap')
    return path


def beside_a_copy(path: Path) -> Path:
    """metadata.yaml names one of two files."""
    (bag,) = path.glob('*.mcap')
    (path / 'copy.mcap').write_bytes(bag.read_bytes())
    return path


@pytest.mark.parametrize('plugin', ['mcap', 'sqlite3'])
@pytest.mark.parametrize(
    'spoil',
    [
        changed_metadata('storage_identifier: .*', "storage_identifier: ''"),
        changed_metadata(r'offered_qos_profiles: \[\]', f'offered_qos_profiles: [{QOS}]'),
        changed_metadata('message_count: [0-9]+', 'message_count: 1'),
        without_its_folder,
    ],
    ids=['no storage_identifier', 'other QoS', 'other counts', 'compressed file'],
)
def test_all_pairs_are_read(tmp_path: Path, spoil: Spoil, plugin: str) -> None:
    path = write_rosbag2(tmp_path / 'drive', messages(), plugin)
    source = opened(spoil(path))
    assert [frame.stamp_ns for frame in source.frames()] == STAMPS
    assert source.frame_count == 6


@pytest.mark.parametrize('spoil', [with_protobuf, renamed, beside_a_copy])
def test_all_pairs_of_an_mcap_are_read(tmp_path: Path, spoil: Spoil) -> None:
    source = opened(spoil(write_rosbag2(tmp_path / 'drive', messages())))
    assert [frame.stamp_ns for frame in source.frames()] == STAMPS


def test_messages_that_are_compressed_one_by_one_are_read_without_metadata(tmp_path: Path) -> None:
    from rosbags import rosbag2

    path = tmp_path / 'drive'
    writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
    writer.set_compression(rosbag2.CompressionMode.MESSAGE, rosbag2.CompressionFormat.ZSTD)
    whole = write_rosbag2(tmp_path / 'whole', messages())
    with writer, rosbag2.Reader(whole) as reader:
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_JAZZY)
        made = {
            c.topic: writer.add_connection(c.topic, c.msgtype, typestore=store)
            for c in reader.connections
        }
        for connection, stamp_ns, data in reader.messages():
            writer.write(made[connection.topic], stamp_ns, data)
    (file,) = path.glob('*.mcap')
    assert [frame.stamp_ns for frame in opened(file).frames()] == STAMPS


@pytest.mark.parametrize('names', [('drive_0', 'drive_1', 'drive_10'), ('c', 'a', 'b')])
def test_parts_without_metadata_are_read_in_the_order_of_their_stamps(
    tmp_path: Path, names: Sequence[str]
) -> None:
    folder = tmp_path / 'parts'
    folder.mkdir()
    for i, name in enumerate(names):
        bag = write_rosbag2(tmp_path / name, messages(2 * i, 2 * i + 2))
        (file,) = bag.glob('*.mcap')
        file.rename(folder / f'{name}.mcap')
    assert [frame.stamp_ns for frame in opened(folder).frames()] == STAMPS


def test_bags_of_one_time_are_no_parts(tmp_path: Path) -> None:
    folder = tmp_path / 'parts'
    folder.mkdir()
    for name in ('a', 'b'):
        (file,) = write_rosbag2(tmp_path / name, messages()).glob('*.mcap')
        file.rename(folder / f'{name}.mcap')
    with pytest.raises(InputError, match=r'holds 2 bags \(a.mcap, b.mcap\); name one of them'):
        opened(folder)


def test_a_missing_part_is_named(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / 'drive', messages())
    metadata = path / 'metadata.yaml'
    metadata.write_text(
        metadata.read_text().replace('- drive.mcap', '- drive.mcap\n  - drive_1.mcap')
    )
    with pytest.raises(InputError, match=r'drive_1.mcap, which metadata.yaml names, is not there'):
        opened(path)


def test_foreign_encodings_alone_are_named_without_a_wrong_remedy(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / 'drive.mcap'
    with path.open('wb') as out:
        writer = Writer(out)
        writer.start()
        schema = writer.register_schema('foxglove.CompressedImage', 'jsonschema', b'{}')
        channel = writer.register_channel('/left', 'json', schema)
        writer.add_message(channel, 1, b'{}', 1)
        writer.finish()
    with pytest.raises(InputError, match='its messages are in json, not those of ROS 2') as error:
        opened(path)
    assert 'recover' not in str(error.value)


@pytest.mark.parametrize('sides', [(0, 1), (0,), (1,)])
def test_zero_stamps_are_named(tmp_path: Path, sides: tuple[int, ...]) -> None:
    found = []
    for message in messages():
        is_zero = any(('/left/', '/right/')[side] in message.topic for side in sides)
        stamp = 0 if is_zero and 'image' in message.topic else None
        if stamp == 0:
            side = int('/right/' in message.topic)
            pair = PAIRS[STAMPS.index(message.time_ns)]
            message = image_message(message.topic, 0, pair[side], time_ns=message.time_ns)
        found.append(message)
    path = write_rosbag2(tmp_path / 'drive', found)
    with pytest.raises(InputError, match=r'image_raw: all stamps are zero.* let the driver stamp'):
        opened(path)


def yuyv(image: np.ndarray) -> np.ndarray:
    """Return YUYV (H, W, 2) of a grey image in which reddish and bluish parts take turns."""
    colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR).astype(int)
    colour[:, : image.shape[1] // 2, 2] += 25
    colour[:, image.shape[1] // 2 :, 0] += 25
    yuv = cv2.cvtColor(np.clip(colour, 0, 255).astype(np.uint8), cv2.COLOR_BGR2YUV)
    packed = np.stack([yuv[:, :, 0], yuv[:, :, 1]], axis=-1)
    packed[:, 1::2, 1] = yuv[:, 1::2, 2]
    return packed


@pytest.mark.parametrize('encoding', ['yuv422', 'uyvy', 'yuv422_yuy2', 'yuyv'])
@pytest.mark.parametrize('sent', ['yuyv', 'uyvy'])
def test_the_image_says_which_bytes_are_its_brightness(
    tmp_path: Path, encoding: str, sent: str
) -> None:
    pairs = [tuple(yuyv(image) for image in pair) for pair in PAIRS[:2]]
    if sent == 'uyvy':
        pairs = [tuple(image[:, :, ::-1].copy() for image in pair) for pair in pairs]
    path = write_rosbag2(
        tmp_path / 'drive',
        stereo_messages(pairs, STAMPS[:2], eyes=calibration(), encoding=encoding),
    )
    source = opened(path)
    for frame, (left, _) in zip(source.frames(), PAIRS[:2], strict=True):
        # A reddish pixel is a little brighter.
        assert np.abs(frame.left.astype(int) - left).max() <= 10
    source.takes_colour = True
    colour = next(source.raw_pairs()).colour
    assert colour is not None
    assert np.median(colour[:, :28, 2].astype(int) - colour[:, :28, 0]) > 10


def test_images_without_a_row_step_are_read(tmp_path: Path) -> None:
    found = [
        message if 'info' in message.topic else replace_step(message, 0) for message in messages()
    ]
    assert len(list(opened(write_rosbag2(tmp_path / 'drive', found)).frames())) == 6


def test_one_line_is_said_of_one_fault_of_all_images(tmp_path: Path, caplog) -> None:
    found = [
        message if 'info' in message.topic else replace_step(message, 17) for message in messages()
    ]
    path = write_rosbag2(tmp_path / 'drive', found)
    with pytest.raises(InputError, match=r'no pair of images in it can be read.* a row step of 17'):
        opened(path)
    assert len(caplog.records) == 1


def replace_step(message: Message, step: int) -> Message:
    def make(types, header):
        return replace(message.make(types, header), step=step)

    return message._replace(make=make)


@pytest.mark.parametrize('kind', ['image_raw', 'image_rect'])
def test_binning_and_roi_of_the_calibration_are_those_of_the_images(
    tmp_path: Path, kind: str
) -> None:
    """Images of 64x48 of a camera of 256x192: binned, then a crop from its middle."""
    eyes = calibration()
    found = [
        message for message in stereo_messages(
            PAIRS, STAMPS, (f'/left/{kind}', f'/right/{kind}'), eyes
        ) if 'image' in message.topic
    ]  # fmt: skip
    for side, eye in (('left', eyes.left), ('right', eyes.right)):
        P = eye.P * [[2.0], [2.0], [1.0]]
        P[0, 2] += 64
        P[1, 2] += 48
        roi = {'x_offset': 64, 'y_offset': 48, 'width': 128, 'height': 96}
        whole = info_message(
            f'/{side}/camera_info', STAMPS[0], eye, width=256, height=192,
            k=P[:, :3].ravel(), p=P.ravel(),
        )  # fmt: skip

        def make(types, header, whole=whole, roi=roi):
            part = types['sensor_msgs/msg/RegionOfInterest'](**roi, do_rectify=False)
            return replace(whole.make(types, header), binning_x=2, binning_y=2, roi=part)

        found.append(whole._replace(make=make))
    camera = opened(write_rosbag2(tmp_path / 'drive', found)).camera
    assert (camera.width, camera.height) == (64, 48)
    assert camera.fx == pytest.approx(eyes.camera.fx)
    assert camera.baseline_m == pytest.approx(eyes.camera.baseline_m)
    # (2 cx + 64 - 64 + 0.5) / 2 - 0.5
    assert camera.cx == pytest.approx(eyes.camera.cx - 0.25)
    assert camera.cy == pytest.approx(eyes.camera.cy - 0.25)
