"""Bags read by `rosbag2_py`, where ROS has it."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from segfloor_ros.camera.sources.bag_file import ReadMessages, Topic, read_rosbag2_with

STORAGE = {'.mcap': 'mcap', '.db3': 'sqlite3'}


def use_rosbag2_py() -> None:
    """Read rosbag2 files with `rosbag2_py` from now on, if it is installed."""
    if importlib.util.find_spec('rosbag2_py') is not None:
        read_rosbag2_with(open_rosbag2)


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


def message_class(name: str) -> Any:
    """Return the class of a message type, e.g. `sensor_msgs/msg/Image`."""
    package, _, kind = name.split('/')
    return getattr(importlib.import_module(f'{package}.msg'), kind)
