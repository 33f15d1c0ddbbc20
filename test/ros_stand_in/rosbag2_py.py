"""As much of rosbag2_py as reads and writes bags, by rosbags: pip has no rosbag2_py."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any


@dataclass
class StorageOptions:
    uri: str
    storage_id: str = ''
    storage_preset_profile: str = ''


@dataclass
class ConverterOptions:
    input_serialization_format: str
    output_serialization_format: str


@dataclass
class StorageFilter:
    topics: Sequence[str] = ()


class SequentialReader:
    opened = 0

    def open(self, storage: StorageOptions, converter: ConverterOptions) -> None:
        from rosbags.rosbag2 import Reader

        suffix = Path(storage.uri).suffix
        assert storage.storage_id == {'.mcap': 'mcap', '.db3': 'sqlite3'}.get(suffix, '')
        assert converter == ConverterOptions('cdr', 'cdr')
        SequentialReader.opened += 1
        self._reader = Reader(storage.uri)
        self._reader.open()
        self.set_filter(StorageFilter([*self._reader.topics]))

    def get_metadata(self) -> Any:
        topics = [
            SimpleNamespace(
                topic_metadata=SimpleNamespace(name=name, type=info.msgtype),
                message_count=info.msgcount,
            )
            for name, info in self._reader.topics.items()
        ]
        return SimpleNamespace(topics_with_message_count=topics)

    def set_filter(self, wanted: StorageFilter) -> None:
        connections = [c for c in self._reader.connections if c.topic in wanted.topics]
        self._messages = self._reader.messages(connections)
        self._next = next(self._messages, None)

    def has_next(self) -> bool:
        return self._next is not None

    def read_next(self) -> tuple[str, bytes, int]:
        connection, stamp_ns, data = self._next
        self._next = next(self._messages, None)
        return connection.topic, bytes(data), stamp_ns


@dataclass
class TopicMetadata:
    id: int
    name: str
    type: str
    serialization_format: str


class SequentialWriter:
    opened = 0

    def open(self, storage: StorageOptions, converter: ConverterOptions) -> None:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        assert storage.storage_id == 'mcap'
        assert converter == ConverterOptions('cdr', 'cdr')
        SequentialWriter.opened += 1
        self._writer = Writer(Path(storage.uri), version=9, storage_plugin=StoragePlugin.MCAP)
        if storage.storage_preset_profile:
            assert storage.storage_preset_profile == 'zstd_fast'
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()
        self._connections: dict[str, Any] = {}

    def create_topic(self, topic: TopicMetadata) -> None:
        from rosbags.typesys import Stores, get_typestore

        assert topic.serialization_format == 'cdr'
        self._connections[topic.name] = self._writer.add_connection(
            topic.name, topic.type, typestore=get_typestore(Stores.ROS2_JAZZY)
        )

    def write(self, topic: str, data: bytes, stamp_ns: int) -> None:
        assert isinstance(data, bytes)
        self._writer.write(self._connections[topic], stamp_ns, data)

    def __del__(self) -> None:
        self._writer.close()
