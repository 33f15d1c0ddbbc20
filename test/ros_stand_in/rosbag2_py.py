"""As much of rosbag2_py as reads bags, by rosbags: pip has no rosbag2_py."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any


@dataclass
class StorageOptions:
    uri: str
    storage_id: str = ''


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
