"""Messages of a bag file as Python objects: by `rosbags`, without a ROS install, or by the reader
that a ROS install has; and which of its topics are the stereo pair.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from os.path import commonpath
from pathlib import Path
from typing import Any, NamedTuple

from segfloor_ros.apps.recordings.files import SIDES, is_side, side_pairs
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.whole import MAX_BYTES, check_file
from segfloor_ros.nodes.yaml_files import read_yaml

logger = logging.getLogger(__name__)

MCAP_MAGIC = b'\x89MCAP0\r\n'
"""At the beginning and the end of an mcap file."""

BAG_SUFFIXES = {'.mcap', '.db3', '.bag'}
REPAIRS = {'.mcap': 'mcap recover', '.bag': 'rosbag reindex'}
TF_DEFINITION = 'geometry_msgs/TransformStamped[] transforms'
MISSING_LIBRARY = (
    'bags are read by rosbag2_py of a ROS installation, or by the Python package rosbags, which '
    'also writes them: pip install rosbags, on Ubuntu 24.04 with --break-system-packages or in a '
    'virtual environment'
)

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED = 'sensor_msgs/msg/CompressedImage'
COMPRESSED_DEPTH = '/compressedDepth'
"""End of the name of a topic of compressed_depth_image_transport."""
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'

IMAGE_NAMES = (
    'image_rect',
    'image_rect_raw',
    'image_rect_color',
    'image_raw',
    'image_mono',
    'image_color',
    'image',
)
"""Usual last words of an image topic, the best first: rectified before raw, grey before colour."""

COLOUR = ('color', 'colour', 'rgb')
REGISTERED = ('color', 'registered', 'rgb')
"""Words in the names of depth topics that are aligned with the colour images."""

NO_PICTURES = ('depth', 'disparity', 'mask', 'keyframe', 'theora')
"""Words in the names of image topics that are no pictures, or not all of them."""


class Topic(NamedTuple):
    """Type and number of the messages on one topic of a bag."""

    msgtype: str
    num_messages: int


ReadMessages = Callable[[Sequence[str]], Iterator[tuple[str, Any]]]
"""Yields (topic, message) of some topics in the order of recording."""

OpenBag = Callable[[Path], tuple[dict[str, Topic], ReadMessages]]

_ros_reader: OpenBag | None = None
_warned_of: set[Path] = set()


def read_rosbag2_with(open_bag: OpenBag | None) -> None:
    """Have rosbag2 files read by another library from now on, which may raise anything; None: by
    rosbags again.
    """
    global _ros_reader
    _ros_reader = open_bag


@dataclass(frozen=True)
class BagFile:
    """An open bag. Message types are those of ROS 2 Jazzy or ROS 1 Noetic, so that other types
    in the bag do not matter.
    """

    path: Path
    topics: dict[str, Topic]
    read: ReadMessages

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, Any]]:
        """Yield (topic, message) of some topics in the order of recording."""
        with _read_errors(self.path):
            yield from self.read(topics)

    def first(self, topic: str) -> Any:
        """Return the first message on a topic. Raises InputError where there is none, whatever the
        bag says of their number.
        """
        for _, message in self.messages([topic]):
            return message
        raise InputError(f'{self.path}: no message on {topic}; record it again')


def is_bag(path: Path) -> bool:
    """Whether `path` is a bag file or a folder with one."""
    if path.is_dir():
        return (path / 'metadata.yaml').exists() or bool(_files_in(path))
    return path.suffix in BAG_SUFFIXES


@contextmanager
def open_bag_file(path: Path) -> Iterator[BagFile]:
    """Open a rosbag2 folder, an mcap or sqlite3 file, or a ROS 1 bag. Raises InputError."""
    path = _bag_path(path)
    if _ros_reader is not None and path.suffix != '.bag':
        with _read_errors(path):
            found = _ros_reader(path)
        yield BagFile(path, *found)
        return
    if path.suffix == '.mcap' and _lacks_its_end(path):
        with _read_errors(path):
            found = _open_cut_mcap(path)
        if path not in _warned_of:  # recordings are read more than once
            _warned_of.add(path)
            logger.warning('%s: its recording was interrupted; what was written is read', path)
        yield BagFile(path, *found)
        return
    with _rosbags_reader(path) as (reader, decode):

        def read(names: Sequence[str]) -> Iterator[tuple[str, Any]]:
            connections = [c for c in reader.connections if c.topic in names]
            for connection, _, data in reader.messages(connections):
                yield connection.topic, decode(data, connection.msgtype)

        with _read_errors(path):
            topics = {n: _topic(path, n, info) for n, info in reader.topics.items()}
        yield BagFile(path, topics, read)


def _lacks_its_end(path: Path) -> bool:
    """Whether an mcap file was begun, but not completed."""
    with _read_errors(path), path.open('rb') as file:
        begins = file.read(len(MCAP_MAGIC)) == MCAP_MAGIC
        file.seek(max(path.stat().st_size - len(MCAP_MAGIC), 0))
        return begins and file.read() != MCAP_MAGIC


def _open_cut_mcap(path: Path) -> tuple[dict[str, Topic], ReadMessages]:
    """Return topics and messages of the complete chunks of an mcap file (https://mcap.dev/spec)."""
    from mcap.exceptions import McapError
    from mcap.records import Channel, Message, Schema
    from mcap.stream_reader import StreamReader
    from rosbags.typesys import Stores, get_typestore

    decode = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr

    def messages() -> Iterator[tuple[str, str, bytes]]:
        kinds: dict[int, str] = {}
        topics: dict[int, tuple[str, str]] = {}
        with path.open('rb') as file, suppress(McapError):
            for record in StreamReader(file, record_size_limit=MAX_BYTES).records:
                if isinstance(record, Schema):
                    kinds[record.id] = record.name
                elif isinstance(record, Channel):
                    topics[record.id] = record.topic, kinds[record.schema_id]
                elif isinstance(record, Message):
                    yield *topics[record.channel_id], record.data

    def read(names: Sequence[str]) -> Iterator[tuple[str, Any]]:
        for topic, kind, data in messages():
            if topic in names:
                yield topic, decode(data, kind)

    counts = Counter((topic, kind) for topic, kind, _ in messages())
    if not counts:
        raise ValueError('it ends before its first chunk does')
    return {topic: Topic(kind, count) for (topic, kind), count in counts.items()}, read


def _topic(path: Path, name: str, info: Any) -> Topic:
    if not (isinstance(info.msgcount, int) and 0 <= info.msgcount < 1 << 32):
        raise ValueError(f'{name} has {info.msgcount} messages')
    return Topic(str(info.msgtype or ''), info.msgcount)


@contextmanager
def _rosbags_reader(path: Path) -> Iterator[tuple[Any, Any]]:
    """Open a bag with `rosbags`; yields its reader and what decodes a message."""
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise InputError(f'{path}: {MISSING_LIBRARY}') from None
    with _read_errors(path):
        if path.suffix == '.bag':
            reader: Any = rosbag1.Reader(path)
            typestore = get_typestore(Stores.ROS1_NOETIC)
            typestore.register(get_types_from_msg(TF_DEFINITION, 'tf2_msgs/msg/TFMessage'))
            decode = typestore.deserialize_ros1
        else:
            reader = rosbag2.Reader(path)
            decode = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr
        reader.open()
    try:
        yield reader, decode
    finally:
        reader.close()


@contextmanager
def _read_errors(path: Path) -> Iterator[None]:
    """Turn what the library raises about a damaged bag into an InputError."""
    try:
        yield
    except Exception as error:  # damaged bytes make the library fail in any way, anywhere
        reason = ' '.join(str(error).split()) or type(error).__name__
        if isinstance(error, MemoryError):
            reason = 'it asks for more memory than there is'
        repair = REPAIRS.get(path.suffix, 'ros2 bag reindex')
        raise InputError(
            f'{path}: cannot read the bag ({reason}); if its recording was interrupted, repair it '
            f'with {repair}'
        ) from error


def _bag_path(path: Path) -> Path:
    if not path.is_dir():
        check_file(path)
        return path
    files = _files_in(path)
    if (path / 'metadata.yaml').exists():
        # Libraries read this file without bounds.
        read_yaml(path / 'metadata.yaml', 'rosbag2_bagfile_information')
        for file in files:
            check_file(file)
        return path
    if len(files) != 1:
        names = ', '.join(file.name for file in files)
        raise InputError(f'{path}: holds {len(files)} bags ({names}); name one of them')
    check_file(files[0])
    return files[0]


def _files_in(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix in BAG_SUFFIXES)


@dataclass(frozen=True)
class StereoTopics:
    """The image topics of both sides, and their CameraInfo topics, '' where there is none. The
    right one may be that of the depth images that belong to the left.
    """

    left: str
    right: str
    left_info: str
    right_info: str
    right_is_depth: bool = False

    @property
    def is_rectified(self) -> bool:
        """Whether the names say that the images are rectified."""
        images = (self.left,) if self.right_is_depth else (self.left, self.right)
        return all('image_rect' in topic for topic in images)


def check_given(name: str, topic: str, found: Sequence[str], what: str, setting: str) -> None:
    """Raise InputError where a topic that a setting names is not among those found in a bag."""
    if topic and topic not in found:
        raise InputError(
            f'{name}: no {what} on {topic}; set stereo_camera.{setting} to one of these: '
            f'{", ".join(found) or "none"}'
        )


def find_topics(name: str, types: Mapping[str, str], left: str, right: str) -> StereoTopics:
    """Return the stereo topics among those of a bag that hold messages.

    types: message type by topic. left, right: as the settings say, or '' to find them by name.
    Raises InputError listing the image topics when there is no pair.
    """
    images = sorted(t for t, kind in types.items() if kind in (IMAGE, COMPRESSED))
    for side, topic in (('left', left), ('right', right)):
        check_given(name, topic, images, 'images', f'{side}_image_topic')
    if not (left and right):
        candidates = [pair for pair in side_pairs(images) if left in ('', pair[0])]
        candidates = [pair for pair in candidates if right in ('', pair[1])]
        pictures = [pair for pair in candidates if not any(w in pair[0] for w in NO_PICTURES)]
        if not pictures:
            listed = ', '.join(images) or 'none'
            raise InputError(
                f'{name}: no pair of left and right image topics (its image topics: {listed}); '
                'set stereo_camera.left_image_topic and right_image_topic; one camera alone does '
                'not tell how far away anything is'
            )
        left, right = min(pictures, key=_preference)
    infos = sorted(topic for topic, kind in types.items() if kind == CAMERA_INFO)
    return StereoTopics(left, right, _info_topic(left, infos, 0), _info_topic(right, infos, 1))


def has_pair(types: Mapping[str, str], settings: StereoCameraSettings) -> bool:
    """Whether a bag holds a pair of left and right images."""
    try:
        find_topics('', types, settings.left_image_topic, settings.right_image_topic)
    except InputError:
        return False
    return True


def find_depth_topics(
    name: str, types: Mapping[str, str], settings: StereoCameraSettings
) -> StereoTopics | None:
    """Return the depth topic of a bag with that of the images it is aligned with: the colour
    camera's where its name says so or there is no left one. None where there is none.
    """
    images = sorted(t for t, kind in types.items() if kind in (IMAGE, COMPRESSED))
    depth = [
        t
        for t in images
        if 'depth' in t.lower() and (types[t] == IMAGE or t.endswith(COMPRESSED_DEPTH))
    ]
    check_given(name, settings.depth_topic, depth, 'depth images', 'depth_topic')
    depth = [settings.depth_topic] if settings.depth_topic else depth
    pictures = [t for t in images if not any(word in t.lower() for word in NO_PICTURES)]
    if not depth or not pictures:
        return None
    best = min(depth, key=lambda t: (not any(w in t for w in REGISTERED), len(t), t))
    colour = [t for t in pictures if any(word in t.lower() for word in COLOUR)]
    left = [t for t in pictures if is_side(t, 0) or 'infra1' in t]
    wanted = colour if any(word in best.lower() for word in REGISTERED) else left or colour
    picture = settings.left_image_topic or min(wanted or pictures, key=lambda t: _rank(t))
    infos = sorted(topic for topic, kind in types.items() if kind == CAMERA_INFO)
    return StereoTopics(picture, best, _info_topic(picture, infos, 0), '', right_is_depth=True)


def _rank(topic: str) -> tuple[int, int, int, str]:
    return _preference((topic, topic))


def _preference(pair: tuple[str, str]) -> tuple[int, int, int, str]:
    words = pair[0].split('/')
    compressed = words[-1] == 'compressed'
    name = words[-2 if compressed else -1]
    rank = IMAGE_NAMES.index(name) if name in IMAGE_NAMES else len(IMAGE_NAMES)
    return rank, int(compressed), len(words), pair[0]


def _info_topic(image: str, infos: list[str], side: int) -> str:
    """The CameraInfo beside the image, or else the nearest one whose name is not of the other
    side.
    """
    parent = image.removesuffix('/compressed').rpartition('/')[0]
    if f'{parent}/camera_info' in infos:
        return f'{parent}/camera_info'
    own = [words for words in SIDES if words[side] in image]
    near = [i for i in infos if any(words[side] in i for words in own)]
    return max(near, key=lambda info: len(commonpath([info, image])), default='')
