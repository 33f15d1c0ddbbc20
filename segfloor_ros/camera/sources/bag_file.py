"""Messages of a bag file as Python objects, by `rosbags`, without a ROS install."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from segfloor_ros.errors import InputError

BAG_SUFFIXES = {'.mcap', '.db3', '.bag'}
REPAIRS = {'.mcap': 'mcap recover', '.bag': 'rosbag reindex'}
TF_DEFINITION = 'geometry_msgs/TransformStamped[] transforms'
MISSING_LIBRARY = (
    'bags are read and written by the Python package rosbags: pip install rosbags, on Ubuntu 24.04 '
    'with --break-system-packages or in a virtual environment; or let ROS play the bag: '
    'ros2 launch segfloor_ros bag.launch.py bag:=BAG'
)


class Topic(NamedTuple):
    """Type and number of the messages on one topic of a bag."""

    msgtype: str
    num_messages: int


class BagFile:
    """An open bag. Message types are those of ROS 2 Jazzy or ROS 1 Noetic, so that other types
    in the bag do not matter.
    """

    def __init__(self, path: Path, reader: Any, typestore: Any) -> None:
        self._path = path
        self._reader = reader
        is_ros1 = path.suffix == '.bag'
        self._decode = typestore.deserialize_ros1 if is_ros1 else typestore.deserialize_cdr
        self.topics = {
            name: Topic(info.msgtype or '', info.msgcount) for name, info in reader.topics.items()
        }

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, Any]]:
        """Yield (topic, message) of some topics in the order of recording."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        with _read_errors(self._path):
            for connection, _, data in self._reader.messages(connections):
                yield connection.topic, self._decode(data, connection.msgtype)


def is_bag(path: Path) -> bool:
    """Whether `path` is a bag file or a folder with one."""
    if path.is_dir():
        return (path / 'metadata.yaml').exists() or bool(_files_in(path))
    return path.suffix in BAG_SUFFIXES


@contextmanager
def open_bag_file(path: Path) -> Iterator[BagFile]:
    """Open a rosbag2 folder, an mcap or sqlite3 file, or a ROS 1 bag. Raises InputError."""
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise InputError(f'{path}: {MISSING_LIBRARY}') from None
    path = _bag_path(path)
    with _read_errors(path):
        if path.suffix == '.bag':
            reader: Any = rosbag1.Reader(path)
            typestore = get_typestore(Stores.ROS1_NOETIC)
            typestore.register(get_types_from_msg(TF_DEFINITION, 'tf2_msgs/msg/TFMessage'))
        else:
            reader, typestore = rosbag2.Reader(path), get_typestore(Stores.ROS2_JAZZY)
        reader.open()
    try:
        yield BagFile(path, reader, typestore)
    finally:
        reader.close()


@contextmanager
def _read_errors(path: Path) -> Iterator[None]:
    """Turn what the library raises about a damaged bag into an InputError."""
    try:
        yield
    except Exception as error:  # damaged bytes make the library fail in any way, anywhere
        reason = ' '.join(str(error).split()) or type(error).__name__
        repair = REPAIRS.get(path.suffix, 'ros2 bag reindex')
        raise InputError(
            f'{path}: cannot read the bag ({reason}); if its recording was interrupted, repair it '
            f'with {repair}'
        ) from error


def _bag_path(path: Path) -> Path:
    if not path.is_dir() or (path / 'metadata.yaml').exists():
        return path
    files = _files_in(path)
    if len(files) != 1:
        names = ', '.join(file.name for file in files)
        raise InputError(f'{path}: holds {len(files)} bags ({names}); name one of them')
    return files[0]


def _files_in(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix in BAG_SUFFIXES)
