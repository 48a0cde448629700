"""Recordings on disk, through the library rosbags: a folder as rosbag2 of ROS 2 Jazzy writes it. Knows no node.

So `ros2 bag info`, `ros2 bag play` and Foxglove read ours, and we read theirs.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

try:
    from backports import zstd
    from rosbags import interfaces
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
    from rosbags.rosbag2.storage_mcap import McapWriter
except ModuleNotFoundError as error:  # rosdep has no key for it
    raise RuntimeError("recordings need rosbags: `pip install rosbags`, see docs/install.md") from error

#: Key of the nodes' parameters in the custom data of a recording.
PARAMETERS_KEY = "node_parameters"
#: The library writes no checksums of its own; those of zstd are checked by whoever decompresses.
CHECKED = {int(zstd.CompressionParameter.checksum_flag): 1}


class BagError(ValueError):
    """The recording cannot be read; the message says which and why."""


@dataclass(frozen=True)
class Topic:
    """One recorded topic.

    Attributes:
        name: absolute.
        type_name: ``package/msg/Type``.
        qos: what each publisher offered.
        type_hash: ``RIHS01_...``; anything else = not known.
    """

    name: str
    type_name: str
    qos: Sequence[interfaces.Qos]
    type_hash: str


@dataclass(frozen=True)
class Message:
    """One recorded message: serialised as CDR, received at `log_time`, ns."""

    topic: Topic
    data: bytes
    log_time: int


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
        self.folder = folder
        self._writer = Writer(folder, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()
        assert isinstance(self._writer.storage, McapWriter)
        self._writer.storage.compressor = partial(zstd.compress, options=CHECKED)
        self._connections: dict[str, interfaces.Connection] = {}

    @property
    def counts(self) -> dict[str, int]:
        """Messages of each topic by name."""
        return {name: self._writer.counts[each.id] for name, each in self._connections.copy().items()}

    def add_topic(self, topic: Topic, definition: str) -> None:
        """Announce a topic with the definition of its type."""
        self._connections[topic.name] = self._writer.add_connection(
            topic.name, topic.type_name, msgdef=definition, rihs01=topic.type_hash, offered_qos_profiles=topic.qos
        )

    def write(self, name: str, data: bytes, log_time: int) -> None:
        """Write one message of the topic `name`, announced before; the time in ns."""
        self._writer.write(self._connections[name], log_time, data)

    def add_parameters(self, parameters: Mapping[str, Mapping[str, Any]]) -> None:
        """Keep the parameters of nodes, by node name."""
        self._writer.set_custom_data(PARAMETERS_KEY, json.dumps(parameters))

    def close(self) -> None:
        """Finish the file and write the metadata."""
        self._writer.close()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()


class BagReader:
    """Reads a recording, ours or one of `ros2 bag record`: a folder, or a file of it, which stands for all of them.

    Attributes:
        path: where it is.
        topics, counts: topics, and numbers of their messages, by name.
        messages: of all topics.
        duration_s: from the first message to the last.
        parameters: of the nodes when the recording began, by node name; empty when it has none.
    """

    def __init__(self, path: Path) -> None:
        """Open what is at `path`.

        Raises:
            BagError: no recording there, or none that can be read.
        """
        whole = path.parent if path.with_name("metadata.yaml").is_file() else path
        self.path = path if path.is_dir() else whole
        with self._opened() as reader:
            self.topics = {
                each.topic: Topic(each.topic, each.msgtype, each.ext.offered_qos_profiles, each.digest)
                for each in reader.connections
                if isinstance(each.ext, interfaces.ConnectionExtRosbag2)
            }
            self.counts = {each.topic: each.msgcount for each in reader.connections}
            self.messages = reader.message_count
            self.duration_s = 1e-9 * max(0, reader.duration - 1)
            custom = reader.storage.metadata.custom or {}
            self.parameters: dict[str, dict[str, Any]] = json.loads(custom.get(PARAMETERS_KEY, "{}"))

    def read(self, names: Sequence[str] | None = None) -> Iterator[Message]:
        """Messages in the order received; `names` = only of these topics.

        Raises:
            BagError: the file is damaged.
        """
        with self._opened() as reader:
            chosen = [each for each in reader.connections if names is None or each.topic in names]
            for connection, time, data in reader.messages(chosen) if chosen else ():
                yield Message(self.topics[connection.topic], data, time)

    @contextmanager
    def _opened(self) -> Iterator[Reader]:
        """The recording open; what goes wrong while it is read becomes BagError."""
        try:
            with Reader(self.path) as reader:
                yield reader
        except Exception as error:  # where a file is damaged, the library fails in many ways
            raise BagError(f"{self.path}: no recording, not finished or damaged: {error}") from error


def offered(profile: Any) -> interfaces.Qos:
    """What a publisher offers, a `QoSProfile`, as it is recorded."""

    def seconds(duration: Any) -> interfaces.QosTime:
        return interfaces.QosTime(*divmod(int(duration.nanoseconds), 10**9))

    return interfaces.Qos(
        history=interfaces.QosHistory[profile.history.name],
        depth=profile.depth,
        reliability=interfaces.QosReliability[profile.reliability.name],
        durability=interfaces.QosDurability[profile.durability.name],
        deadline=seconds(profile.deadline),
        lifespan=seconds(profile.lifespan),
        liveliness=interfaces.QosLiveliness[profile.liveliness.name],
        liveliness_lease_duration=seconds(profile.liveliness_lease_duration),
        avoid_ros_namespace_conventions=profile.avoid_ros_namespace_conventions,
    )
