"""Files as `ros2 bag record` of ROS 2 Jazzy writes them: tables and records as rosbag2's storage plug-ins make them."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import yaml
from mcap.writer import CompressionType, Writer

from dm_tools.recording.bag import Topic
from dm_tools.recording.bag_reader import Message

_TABLES = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL,
    offered_qos_profiles TEXT NOT NULL, type_description_hash TEXT NOT NULL);
CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,
    encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
    data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
"""


def write_rosbag2(folder: Path, messages: Sequence[Message], storage: str) -> None:
    """A recording split into two files, as with `--max-bag-size`, and a third that was begun when it ended."""
    folder.mkdir()
    write, suffix = {"mcap": (_write_mcap, "mcap"), "sqlite3": (_write_sqlite, "db3")}[storage]
    names = [f"{folder.name}_{number}.{suffix}" for number in (0, 1, 2)]
    half = len(messages) // 2
    topics = list({message.topic.name: message.topic for message in messages}.values())
    for name, part in zip(names, (messages[:half], messages[half:], ()), strict=True):
        write(folder / name, topics, part)
    information: dict[str, Any] = {"version": 9, "storage_identifier": storage, "relative_file_paths": names}
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))


def _write_mcap(file: Path, topics: Sequence[Topic], messages: Sequence[Message]) -> None:
    """No compression, as is the default; no sequence numbers; no definition of types that rosbag2 finds none of."""
    with file.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start(profile="ros2", library="rosbag2_storage_mcap")
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for topic in topics:
            kind = topic.type_name
            if kind not in schemas:
                schemas[kind] = writer.register_schema(kind, "", b"")
            qos = {"offered_qos_profiles": yaml.safe_dump(list(map(dict, topic.qos)))}
            channels[topic.name] = writer.register_channel(topic.name, "cdr", schemas[kind], qos)
        for message in messages:
            writer.add_message(channels[message.topic.name], message.log_time, message.data, message.publish_time, 0)
        writer.finish()


def _write_sqlite(file: Path, topics: Sequence[Topic], messages: Sequence[Message]) -> None:
    with closing(sqlite3.connect(file)) as database:
        database.executescript(_TABLES)
        numbers = {topic.name: number for number, topic in enumerate(topics, start=1)}
        for topic in topics:
            qos = yaml.safe_dump(list(map(dict, topic.qos)))
            row = (numbers[topic.name], topic.name, topic.type_name, "cdr", qos, topic.type_hash)
            database.execute("INSERT INTO topics VALUES (?, ?, ?, ?, ?, ?)", row)
        for message in messages:
            data = (numbers[message.topic.name], message.log_time, message.data)
            database.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", data)
        database.commit()
