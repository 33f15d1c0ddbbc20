"""Messages of a bag file as Python objects: by `rosbags`, without a ROS install, or by the reader
that a ROS install has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from segfloor_ros.errors import InputError
from segfloor_ros.files.whole import check_file
from segfloor_ros.files.yaml_files import read_yaml

BAG_SUFFIXES = {'.mcap', '.db3', '.bag'}
REPAIRS = {'.mcap': 'mcap recover', '.bag': 'rosbag reindex'}
TF_DEFINITION = 'geometry_msgs/TransformStamped[] transforms'
MISSING_LIBRARY = (
    'bags are read by rosbag2_py of a ROS installation, or by the Python package rosbags, which '
    'also writes them: pip install rosbags, on Ubuntu 24.04 with --break-system-packages or in a '
    'virtual environment'
)


class Topic(NamedTuple):
    """Type and number of the messages on one topic of a bag."""

    msgtype: str
    num_messages: int


ReadMessages = Callable[[Sequence[str]], Iterator[tuple[str, Any]]]
"""Yields (topic, message) of some topics in the order of recording."""

OpenBag = Callable[[Path], tuple[dict[str, Topic], ReadMessages]]

_ros_reader: OpenBag | None = None


def read_rosbag2_with(open_bag: OpenBag) -> None:
    """Have rosbag2 files read by another library from now on. It may raise anything."""
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
    with _rosbags_reader(path) as (reader, decode):

        def read(names: Sequence[str]) -> Iterator[tuple[str, Any]]:
            connections = [c for c in reader.connections if c.topic in names]
            for connection, _, data in reader.messages(connections):
                yield connection.topic, decode(data, connection.msgtype)

        with _read_errors(path):
            topics = {n: _topic(path, n, info) for n, info in reader.topics.items()}
        yield BagFile(path, topics, read)


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
