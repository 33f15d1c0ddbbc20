"""Messages of a bag file as Python objects: by `rosbags`, without a ROS install, or by the reader
that a ROS install has; and which of its topics are the stereo pair.
"""

from __future__ import annotations

import logging
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import chain, pairwise
from os.path import commonpath
from pathlib import Path
from typing import Any, NamedTuple

from segfloor_ros.apps.recordings.files import SIDES, is_side, natural_key, side_pairs
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.whole import MAX_BYTES, check_file
from segfloor_ros.nodes.yaml_files import read_yaml

logger = logging.getLogger(__name__)

MCAP_MAGIC = b'\x89MCAP0\r\n'
"""At the beginning and the end of an mcap file."""

BAG_SUFFIXES = {'.mcap', '.db3', '.bag'}
COMPRESSED_SUFFIXES = {'.zstd', '.zst'}
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
REPAIRS = {'.mcap': 'mcap recover', '.db3': 'sqlite3 FILE .recover', '.bag': 'rosbag reindex'}
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
    return _suffix(path) in BAG_SUFFIXES


def _suffix(path: Path) -> str:
    """Return the end of a file's name, of a compressed one that before it."""
    return (path.with_suffix('') if path.suffix in COMPRESSED_SUFFIXES else path).suffix


@contextmanager
def open_bag_file(path: Path) -> Iterator[BagFile]:
    """Open a rosbag2 folder, an mcap or sqlite3 file, or a ROS 1 bag. A folder is read by its
    files, the parts of one bag in the order of their times. Raises InputError.
    """
    if _ros_reader is not None and (path / 'metadata.yaml').exists():
        check_file(path / 'metadata.yaml')
        with _read_errors(path):
            found = _ros_reader(path)
        yield BagFile(path, *found)
        return
    with ExitStack() as stack:
        parts = [stack.enter_context(_open_part(file)) for file in _bag_files(path)]
        parts.sort(key=lambda part: part.begin_ns)
        if not (path / 'metadata.yaml').exists():
            _check_parts(path, parts)
        topics: dict[str, Topic] = {}
        for part in parts:
            for name, topic in part.topics.items():
                before = topics.get(name, Topic(topic.msgtype, 0)).num_messages
                topics[name] = Topic(topic.msgtype, before + topic.num_messages)
        yield BagFile(path, topics, lambda names: chain.from_iterable(p.read(names) for p in parts))


class _Part(NamedTuple):
    """One file of a bag, from its first message to its last, 0 where that is not known."""

    path: Path
    topics: dict[str, Topic]
    read: ReadMessages
    begin_ns: int = 0
    end_ns: int = 0


def _bag_files(path: Path) -> list[Path]:
    """Return the files of a bag: those that its metadata.yaml names, else all in its folder."""
    if not path.is_dir():
        check_file(path)
        return [path]
    files = _files_in(path)
    if (path / 'metadata.yaml').exists():
        information = read_yaml(path / 'metadata.yaml', 'rosbag2_bagfile_information')
        about = information.get('rosbag2_bagfile_information')
        listed = about.get('relative_file_paths') if isinstance(about, dict) else None
        names = [Path(str(name)).name for name in listed] if isinstance(listed, list) else []
        missing = [name for name in names if not (path / name).exists()]
        if missing and len(missing) < len(names):
            raise InputError(
                f'{path}: {missing[0]}, which metadata.yaml names, is not there; complete the copy'
            )
        if names and not missing:
            files = [path / name for name in names]
    if not files:
        raise InputError(f'{path}: holds metadata.yaml, but no bag; complete the copy')
    for file in files:
        check_file(file)
    return files


def _files_in(folder: Path) -> list[Path]:
    return sorted(
        (path for path in folder.iterdir() if _suffix(path) in BAG_SUFFIXES), key=natural_key
    )


def _check_parts(path: Path, parts: Sequence[_Part]) -> None:
    """Raise InputError where the files of a folder are not one after the other, of one bag."""
    for one, following in pairwise(parts):
        if one.end_ns > following.begin_ns or not one.topics.keys() & following.topics.keys():
            names = ', '.join(sorted(part.path.name for part in parts))
            raise InputError(f'{path}: holds {len(parts)} bags ({names}); name one of them')


@contextmanager
def _open_part(path: Path) -> Iterator[_Part]:
    with _uncompressed(path) as file:
        if _ros_reader is not None and file.suffix != '.bag':
            with _read_errors(path):
                found = _ros_reader(file)
            yield _Part(path, *found)
        elif file.suffix == '.mcap' and _lacks_its_end(file):
            with _read_errors(path):
                part = _open_mcap_stream(file)
            if path not in _warned_of:  # recordings are read more than once
                _warned_of.add(path)
                logger.warning('%s: its recording was interrupted; what was written is read', path)
            yield part
        else:
            with _rosbags_reader(file, path) as part:
                yield part


@contextmanager
def _uncompressed(path: Path) -> Iterator[Path]:
    """Yield a file, of a compressed one a copy that lasts as long."""
    if path.suffix not in COMPRESSED_SUFFIXES:
        yield path
        return
    import zstandard  # comes with mcap

    with tempfile.TemporaryDirectory(prefix='segfloor_bag_') as folder:
        copy = Path(folder, path.stem)
        with _read_errors(path), path.open('rb') as packed, copy.open('wb') as out:
            zstandard.ZstdDecompressor().copy_stream(packed, out)
        yield copy


def _message_data(data: bytes) -> bytes:
    """Return the bytes of a message, which rosbag2 may have compressed one by one."""
    if bytes(data[:4]) != ZSTD_MAGIC:
        return data
    import zstandard  # comes with mcap

    return zstandard.ZstdDecompressor().decompress(data)


def _lacks_its_end(path: Path) -> bool:
    """Whether an mcap file was begun, but not completed."""
    with _read_errors(path), path.open('rb') as file:
        begins = file.read(len(MCAP_MAGIC)) == MCAP_MAGIC
        file.seek(max(path.stat().st_size - len(MCAP_MAGIC), 0))
        return begins and file.read() != MCAP_MAGIC


def _open_mcap_stream(path: Path) -> _Part:
    """Read an mcap file from its begin (https://mcap.dev/spec): the complete chunks of one that was
    cut, or the channels of ROS 2 in one that has others, too, e.g. in protobuf.
    """
    from mcap.exceptions import McapError
    from mcap.records import Channel, Message, Schema
    from mcap.stream_reader import StreamReader
    from rosbags.typesys import Stores, get_typestore

    decode = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr
    others: set[str] = set()

    def messages() -> Iterator[tuple[str, str, int, bytes]]:
        kinds: dict[int, str] = {}
        topics: dict[int, tuple[str, str]] = {}
        with path.open('rb') as file, suppress(McapError):
            for record in StreamReader(file, record_size_limit=MAX_BYTES).records:
                if isinstance(record, Schema):
                    kinds[record.id] = record.name
                elif isinstance(record, Channel) and record.message_encoding != 'cdr':
                    others.add(record.message_encoding)
                elif isinstance(record, Channel):
                    topics[record.id] = record.topic, kinds.get(record.schema_id, '')
                elif isinstance(record, Message) and record.channel_id in topics:
                    yield *topics[record.channel_id], record.log_time, record.data

    def read(names: Sequence[str]) -> Iterator[tuple[str, Any]]:
        for topic, kind, _, data in messages():
            if topic in names:
                yield topic, _decoded(decode, topic, kind, data)

    counts: Counter[tuple[str, str]] = Counter()
    begin_ns = end_ns = 0
    for topic, kind, stamp_ns, _ in messages():
        counts[topic, kind] += 1
        begin_ns, end_ns = min(begin_ns or stamp_ns, stamp_ns), max(end_ns, stamp_ns)
    if not counts and others:
        raise InputError(
            f'{path}: its messages are in {", ".join(sorted(others))}, not those of ROS 2 (cdr); '
            'record the topics by ROS'
        )
    if not counts:
        raise ValueError('it ends before its first chunk does')
    topics = {topic: Topic(kind, count) for (topic, kind), count in counts.items()}
    return _Part(path, topics, read, begin_ns, end_ns)


def _decoded(decode: Callable[[bytes, str], Any], topic: str, kind: str, data: bytes) -> Any:
    """Return a message. Raises InputError."""
    try:
        return decode(_message_data(data), kind)
    except Exception as error:  # damaged bytes make the library fail in any way
        reason = ' '.join(str(error).split()) or type(error).__name__
        raise InputError(
            f'{topic}: a message of type {kind} cannot be read ({reason}); is it recorded with the '
            'types of ROS?'
        ) from error


def _topic(path: Path, name: str, info: Any) -> Topic:
    if not (isinstance(info.msgcount, int) and 0 <= info.msgcount < 1 << 32):
        raise ValueError(f'{name} has {info.msgcount} messages')
    return Topic(str(info.msgtype or ''), info.msgcount)


@contextmanager
def _rosbags_reader(path: Path, name: Path) -> Iterator[_Part]:
    """Open a file with `rosbags`. name: in messages."""
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise InputError(f'{name}: {MISSING_LIBRARY}') from None
    with ExitStack() as stack, _read_errors(name):
        if path.suffix == '.bag':
            reader: Any = rosbag1.Reader(path)
            typestore = get_typestore(Stores.ROS1_NOETIC)
            typestore.register(get_types_from_msg(TF_DEFINITION, 'tf2_msgs/msg/TFMessage'))
            decode = typestore.deserialize_ros1
        else:
            reader = rosbag2.Reader(path)
            decode = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr
        try:
            reader.open()
        except Exception:
            if path.suffix != '.mcap':
                raise
            try:
                part = _open_mcap_stream(path)
            except ValueError:
                part = None
            if part is None:
                raise
        else:
            stack.callback(reader.close)
            topics = {n: _topic(name, n, info) for n, info in reader.topics.items()}

            def read(names: Sequence[str]) -> Iterator[tuple[str, Any]]:
                connections = [c for c in reader.connections if c.topic in names]
                # Without connections all messages would come.
                for connection, _, data in reader.messages(connections) if connections else ():
                    topic, kind = connection.topic, connection.msgtype
                    yield topic, _decoded(decode, topic, kind, data)

            begin_ns, end_ns = (reader.start_time, reader.end_time) if topics else (0, 0)
            part = _Part(name, topics, read, begin_ns, end_ns - 1)
        kept = stack.pop_all()
    with kept:
        yield part


@contextmanager
def _read_errors(path: Path) -> Iterator[None]:
    """Turn what the library raises about a damaged bag into an InputError."""
    try:
        yield
    except InputError as error:
        if str(path) in str(error):
            raise
        raise InputError(f'{path}, {error}') from error
    except Exception as error:  # damaged bytes make the library fail in any way, anywhere
        reason = ' '.join(str(error).split()) or type(error).__name__
        if isinstance(error, MemoryError):
            reason = 'it asks for more memory than there is'
        repair = REPAIRS.get(_suffix(path), 'ros2 bag reindex')
        raise InputError(
            f'{path}: cannot read the bag ({reason}); if its recording was interrupted, repair it '
            f'with {repair}'
        ) from error


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
