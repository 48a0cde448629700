"""A recording on disk: a folder with one MCAP file and `metadata.yaml`, as rosbag2 of ROS 2 Jazzy writes it.

So `ros2 bag info`, `ros2 bag play` and Foxglove read it. MCAP profile `ros2`; definitions as `ros2msg`; the quality of
service that publishers offered in each channel's metadata. Knows no node.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType, Writer

from dm_common.atomic_write import write_whole

SUFFIX = ".mcap"
METADATA_FILE = "metadata.yaml"
INFORMATION = "rosbag2_bagfile_information"
#: Version of rosbag2's metadata in ROS 2 Jazzy: quality of service as words.
METADATA_VERSION = 9
#: MCAP metadata record that rosbag2 looks for, and ours with the nodes' parameters.
ROSBAG_RECORD, PARAMETERS_RECORD = "rosbag2", "node_parameters"
#: Key in a channel's metadata.
QOS_KEY, HASH_KEY = "offered_qos_profiles", "topic_type_hash"


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


class _Dumper(yaml.SafeDumper):
    """Without anchors for what stands there twice, which no reader of recordings expects."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _as_yaml(value: Any) -> str:
    return str(yaml.dump(value, Dumper=_Dumper, sort_keys=False))


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
        metadata = {QOS_KEY: _as_yaml(list(topic.qos)), HASH_KEY: topic.type_hash}
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
        self._writer.add_metadata(ROSBAG_RECORD, {"serialized_metadata": _as_yaml(self._metadata())})
        self._writer.finish()
        self._stream.close()
        write_whole(self.folder / METADATA_FILE, _as_yaml({INFORMATION: self._metadata()}).encode())

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def _metadata(self) -> dict[str, Any]:
        duration, start = {"nanoseconds": self._last - self._first}, {"nanoseconds_since_epoch": self._first}
        return {
            "version": METADATA_VERSION,
            "storage_identifier": "mcap",
            "duration": duration,
            "starting_time": start,
            "message_count": self.messages,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.type_name,
                        "serialization_format": MessageEncoding.CDR,
                        "offered_qos_profiles": list(topic.qos),
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
                    "starting_time": start,
                    "duration": duration,
                    "message_count": self.messages,
                }
            ],
            "custom_data": None,
            "ros_distro": "jazzy",
        }
