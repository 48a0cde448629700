"""A recording on disk: a folder with one MCAP file and `metadata.yaml`, as rosbag2 of ROS 2 Jazzy writes it.

So `ros2 bag info`, `ros2 bag play` and Foxglove read it. MCAP profile `ros2`; definitions as `ros2msg`; the quality of
service that publishers offered in each channel's metadata. Knows no node.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType, Writer

from dm_common.atomic_write import write_whole

SUFFIX = ".mcap"
METADATA_FILE = "metadata.yaml"
#: Version of rosbag2's metadata in ROS 2 Jazzy: quality of service as words.
METADATA_VERSION = 9
#: MCAP metadata record that rosbag2 looks for, and ours with the nodes' parameters.
ROSBAG_RECORD, PARAMETERS_RECORD = "rosbag2", "node_parameters"
#: Key in a channel's metadata.
QOS_KEY, HASH_KEY = "offered_qos_profiles", "topic_type_hash"


class BagError(ValueError):
    """The recording cannot be read; the message says which and why."""


@dataclass(frozen=True)
class Topic:
    """One recorded topic.

    Attributes:
        name: absolute.
        type_name: ``package/msg/Type``.
        qos: one mapping per publisher, in the words of rosbag2 (history, depth, reliability, durability, ...).
        type_hash: ``RIHS01_...``; "" = not known.
    """

    name: str
    type_name: str
    qos: Sequence[Mapping[str, Any]]
    type_hash: str = ""


@dataclass(frozen=True)
class Message:
    """One recorded message: serialised as CDR, received at `log_time`, published at `publish_time`, ns."""

    topic: Topic
    data: bytes
    log_time: int
    publish_time: int


class BagWriter:
    """Writes a recording. Use as a context manager; not to be used from several threads at once."""

    def __init__(self, folder: Path) -> None:
        """Begin a recording in the new folder `folder`.

        Raises:
            FileExistsError: there is something already.
            OSError: it cannot be written to.
        """
        if folder.exists():
            raise FileExistsError(f"{folder}: exists already; a recording is never overwritten")
        folder.mkdir(parents=True)
        self.folder = folder
        self.file = folder / f"{folder.name}_0{SUFFIX}"
        self._stream = self.file.open("wb")
        self._writer = Writer(self._stream, compression=CompressionType.ZSTD)
        self._writer.start(profile=Profile.ROS2)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._topics: dict[str, Topic] = {}
        self._counts: dict[str, int] = {}
        self._first = self._last = 0

    @property
    def messages(self) -> int:
        """Messages written so far."""
        return sum(self._counts.values())

    @property
    def counts(self) -> dict[str, int]:
        """Messages of each topic by name."""
        return dict(self._counts)

    def add_topic(self, topic: Topic, definition: str) -> None:
        """Announce a topic with the definition of its type; again = nothing happens."""
        if topic.name in self._channels:
            return
        if topic.type_name not in self._schemas:
            self._schemas[topic.type_name] = self._writer.register_schema(
                topic.type_name, SchemaEncoding.ROS2, definition.encode()
            )
        metadata = {QOS_KEY: yaml.safe_dump(list(map(dict, topic.qos)), sort_keys=False), HASH_KEY: topic.type_hash}
        self._channels[topic.name] = self._writer.register_channel(
            topic.name, MessageEncoding.CDR, self._schemas[topic.type_name], metadata
        )
        self._topics[topic.name], self._counts[topic.name] = topic, 0

    def write(self, name: str, data: bytes, log_time: int, publish_time: int) -> None:
        """Write one message of the topic `name`, announced before; times in ns."""
        self._writer.add_message(self._channels[name], log_time, data, publish_time, self._counts[name])
        self._counts[name] += 1
        self._first = min(self._first or log_time, log_time)
        self._last = max(self._last, log_time)

    def add_parameters(self, parameters: Mapping[str, Mapping[str, Any]]) -> None:
        """Keep the parameters of nodes, by node name."""
        self._writer.add_metadata(
            PARAMETERS_RECORD, {node: json.dumps(dict(values)) for node, values in parameters.items()}
        )

    def close(self) -> None:
        """Finish the file and write the metadata."""
        if self._stream.closed:
            return
        text = yaml.safe_dump(self._metadata(), sort_keys=False)
        self._writer.add_metadata(ROSBAG_RECORD, {"serialized_metadata": text})
        self._writer.finish()
        self._stream.close()
        whole = yaml.safe_dump({"rosbag2_bagfile_information": self._metadata()}, sort_keys=False)
        write_whole(self.folder / METADATA_FILE, whole.encode())

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, _type: type[BaseException] | None, _error: BaseException | None, _traceback: TracebackType | None
    ) -> None:
        self.close()

    def _metadata(self) -> dict[str, Any]:
        duration, start = {"nanoseconds": self._last - self._first}, {"nanoseconds_since_epoch": self._first}
        # Built anew for each place: the same object twice would become an anchor, which no reader expects.
        return {
            "version": METADATA_VERSION,
            "storage_identifier": "mcap",
            "duration": dict(duration),
            "starting_time": dict(start),
            "message_count": self.messages,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.type_name,
                        "serialization_format": MessageEncoding.CDR,
                        "offered_qos_profiles": [_copy(profile) for profile in topic.qos],
                        "type_description_hash": topic.type_hash,
                    },
                    "message_count": self._counts[topic.name],
                }
                for topic in self._topics.values()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self.file.name],
            "files": [
                {
                    "path": self.file.name,
                    "starting_time": dict(start),
                    "duration": dict(duration),
                    "message_count": self.messages,
                }
            ],
            "custom_data": None,
            "ros_distro": "jazzy",
        }


def _copy(profile: Mapping[str, Any]) -> dict[str, Any]:
    return {key: dict(value) if isinstance(value, Mapping) else value for key, value in profile.items()}


class BagReader:
    """Reads a recording: a folder, or one MCAP file."""

    def __init__(self, path: Path) -> None:
        """
        Raises:
            BagError: no MCAP file there, or none that can be read.
        """
        files = sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]
        if len(files) != 1 or not files[0].is_file():
            raise BagError(f"{path}: {len(files) if path.is_dir() else 'no'} MCAP files; must be one")
        self.file = files[0]
        try:
            with self.file.open("rb") as stream:
                reader = make_reader(stream)
                self.profile = reader.get_header().profile
                summary = reader.get_summary()
                self._metadata = {record.name: dict(record.metadata) for record in reader.iter_metadata()}
        except (McapError, OSError, UnicodeDecodeError) as error:
            raise BagError(f"{self.file}: cannot be read: {error}") from error
        if summary is None or summary.statistics is None:
            raise BagError(f"{self.file}: has no summary: the recording was not finished")
        self.messages = summary.statistics.message_count
        self.duration_s = 1e-9 * (summary.statistics.message_end_time - summary.statistics.message_start_time)
        self.topics: dict[str, Topic] = {}
        self.counts: dict[str, int] = {}
        self._by_channel: dict[int, Topic] = {}
        for number, channel in summary.channels.items():
            qos = yaml.safe_load(channel.metadata.get(QOS_KEY, "")) or []
            topic = Topic(
                channel.topic, summary.schemas[channel.schema_id].name, qos, channel.metadata.get(HASH_KEY, "")
            )
            self.topics[topic.name] = self._by_channel[number] = topic
            self.counts[topic.name] = summary.statistics.channel_message_counts.get(number, 0)

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Parameters of the nodes when the recording began, by node name; empty when it has none."""
        return {node: json.loads(text) for node, text in self._metadata.get(PARAMETERS_RECORD, {}).items()}

    def read(self, names: Sequence[str] | None = None) -> Iterator[Message]:
        """Messages in the order received; `names` = only of these topics.

        Raises:
            BagError: the file is damaged.
        """
        try:
            with self.file.open("rb") as stream:
                for _schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages(names):
                    topic = self._by_channel[channel.id]
                    yield Message(topic, message.data, message.log_time, message.publish_time)
        except (McapError, OSError) as error:
            raise BagError(f"{self.file}: cannot be read: {error}") from error
