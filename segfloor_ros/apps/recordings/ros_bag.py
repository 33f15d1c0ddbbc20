"""Bags read and written by `rosbag2_py`, where ROS has it."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from segfloor_ros.apps.recordings.bag_file import ReadMessages, Topic, read_rosbag2_with
from segfloor_ros.apps.recordings.bag_writer import write_rosbag2_with
from segfloor_ros.nodes.messages.making import message_class, ros_message

STORAGE = {'.mcap': 'mcap', '.db3': 'sqlite3'}


def use_rosbag2_py() -> None:
    """Read and write rosbag2 files with `rosbag2_py` from now on, if it is installed."""
    if importlib.util.find_spec('rosbag2_py') is not None:
        read_rosbag2_with(open_rosbag2)
        write_rosbag2_with(Rosbag2Writer)


def open_rosbag2(path: Path) -> tuple[dict[str, Topic], ReadMessages]:
    """Return the topics of a bag, a folder or a file, and what reads their messages."""
    from rclpy.serialization import deserialize_message
    from rosbag2_py import StorageFilter

    information = _reader(path).get_metadata().topics_with_message_count
    topics = {
        one.topic_metadata.name: Topic(one.topic_metadata.type, one.message_count)
        for one in information
    }

    def read(names: Sequence[str]) -> Iterator[tuple[str, Any]]:
        reader = _reader(path)
        reader.set_filter(StorageFilter(topics=[name for name in names if name in topics]))
        kinds = {name: message_class(topics[name].msgtype) for name in names if name in topics}
        while reader.has_next():
            name, data, _ = reader.read_next()
            yield name, deserialize_message(data, kinds[name])

    return topics, read


def _reader(path: Path) -> Any:
    from rosbag2_py import ConverterOptions, SequentialReader, StorageOptions

    reader = SequentialReader()
    storage = StorageOptions(uri=str(path), storage_id=STORAGE.get(path.suffix, ''))
    reader.open(storage, ConverterOptions('cdr', 'cdr'))
    return reader


class Rosbag2Writer:
    """Writes an mcap bag into a new folder (`bag_writer.BagLibrary`)."""

    def __init__(self, folder: Path, compressed: bool) -> None:
        from rosbag2_py import ConverterOptions, SequentialWriter, StorageOptions

        self.make = ros_message
        self._topics: set[str] = set()
        self._writer = SequentialWriter()
        profile = 'zstd_fast' if compressed else ''
        storage = StorageOptions(uri=str(folder), storage_id='mcap', storage_preset_profile=profile)
        self._writer.open(storage, ConverterOptions('cdr', 'cdr'))

    def knows(self, kind: str) -> bool:
        """Whether this machine has a message type."""
        return importlib.util.find_spec(kind.partition('/')[0]) is not None

    def serialize(self, message: Any, kind: str) -> bytes:
        """Return a message in CDR."""
        from rclpy.serialization import serialize_message

        return serialize_message(message)

    def write(self, topic: str, kind: str, stamp_ns: int, data: bytes | memoryview) -> None:
        """Append a message in CDR."""
        if topic not in self._topics:
            from rosbag2_py import TopicMetadata

            self._writer.create_topic(
                TopicMetadata(
                    id=len(self._topics), name=topic, type=kind, serialization_format='cdr'
                )
            )
            self._topics.add(topic)
        self._writer.write(topic, bytes(data), stamp_ns)

    def close(self, is_whole: bool) -> None:
        """Complete the file: the writer does that when it goes."""
        del self._writer
