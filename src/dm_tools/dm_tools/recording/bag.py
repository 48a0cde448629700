"""Recordings on disk, through the library rosbags: a folder as rosbag2 of ROS 2 Jazzy writes it. Knows no node.

So `ros2 bag info`, `ros2 bag play` and Foxglove read ours, and we read theirs.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

try:
    from backports import zstd
    from rosbags import interfaces
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer, WriterError
    from rosbags.rosbag2.storage_mcap import McapReader, McapWriter
except ModuleNotFoundError as error:  # rosdep has no key for it
    raise RuntimeError("recordings need rosbags: `pip install rosbags`, see docs/install.md") from error

METADATA_FILE, SUFFIX = "metadata.yaml", ".mcap"
#: First bytes of an MCAP file, and its last bytes if it was finished.
MAGIC = b"\x89MCAP0\r\n"
#: Topic on which nodes publish their parameters.
PARAMETER_EVENTS = "/parameter_events"
#: Recorded messages reach the disk with the first message that is later by more than this, ns, or by
#: `BagWriter.flush`; the rest is lost when the recorder is killed or loses its power.
FLUSH_NS = 4 * 10**9
#: The library writes no checksums of its own; those of zstd are verified by every decompressor.
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
    """Writes a recording until it is closed; not to be used from several threads at once."""

    def __init__(self, folder: Path) -> None:
        """Begin a recording in the new folder `folder`.

        Raises:
            FileExistsError: there is something already.
            OSError: it cannot be written to.
        """
        self.folder = folder
        try:
            self._writer = Writer(folder, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        except WriterError as error:
            raise FileExistsError(f"{folder}: exists already; a recording is never overwritten") from error
        assert isinstance(self._writer.storage, McapWriter)
        self._storage = self._writer.storage
        self._storage.compressor = partial(zstd.compress, options=CHECKED)
        self._connections: dict[str, interfaces.Connection] = {}
        self._flushed = 0

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
        if abs(log_time - self._flushed) > FLUSH_NS:
            self.flush()
            self._flushed = log_time

    def flush(self) -> None:
        """Bring to the disk what was written."""
        if self._storage.chunk.msgs:
            self._storage.close_chunk()
        self._storage.bio.flush()
        os.fsync(self._storage.bio.fileno())

    def close(self) -> None:
        """Finish the file and write the metadata, both to the disk."""
        self._writer.close()
        for path in self.folder.iterdir():
            with path.open("rb") as written:
                os.fsync(written.fileno())


class BagReader:
    """Reads a recording, ours or one of `ros2 bag record`: a folder, of one or several files, or one file of it.

    Attributes:
        path: where it is.
        topics, counts: topics, and numbers of their messages, by name.
        messages: of all topics.
        duration_s: from the first message to the last.
        unfinished: files without an end (the recorder was killed); their complete records are read.
    """

    def __init__(self, path: Path) -> None:
        """Open what is at `path`. Raises BagError when it is not a recording, or cannot be read."""
        self.path = path
        self.topics: dict[str, Topic] = {}
        with self._opened() as readers:
            for each in [connection for reader in readers for connection in reader.connections]:
                assert isinstance(each.ext, interfaces.ConnectionExtRosbag2)
                topic = Topic(each.topic, each.msgtype, each.ext.offered_qos_profiles, each.digest)
                self.topics.setdefault(each.topic, topic)
            self.counts = dict.fromkeys(self.topics, 0)
            for each in [connection for reader in readers for connection in _stored(reader)]:
                self.counts[each.topic] += each.msgcount
            self.messages = sum(self.counts.values())
            lasted = max(reader.end_time for reader in readers) - min(reader.start_time for reader in readers)
            self.duration_s = 1e-9 * max(0, lasted - 1)
            self.unfinished = [str(reader.path) for reader in readers if isinstance(reader.storage, _Unfinished)]

    def read(self, names: Sequence[str] | None = None) -> Iterator[Message]:
        """Messages in the order received, `names` = only of these topics. Raises BagError when the file is damaged."""
        missing = sum(count for name, count in self.counts.items() if names is None or name in names)
        with self._opened() as readers:
            for reader in readers:  # each begins where the one before ended
                chosen = [each for each in _stored(reader) if names is None or each.topic in names]
                for connection, time, data in reader.messages(chosen) if chosen else ():
                    yield Message(self.topics[connection.topic], data, time)
                    missing -= 1
            if missing:  # no checksum protects the index by which messages are found
                raise ValueError(f"{missing} messages are missing")

    @contextmanager
    def _opened(self) -> Iterator[list[Reader]]:
        """Open the files of the recording, in order of time; any failure while they are read becomes BagError."""
        try:
            with ExitStack() as stack:
                readers = [stack.enter_context(_reader(path)) for path in _parts(self.path)]
                yield sorted(readers, key=lambda reader: reader.start_time)
        except Exception as error:  # where a file is damaged, the library fails in many ways
            raise BagError(f"{self.path}: no recording, or damaged: {error}") from error


class _Unfinished(McapReader):
    """An MCAP file whose recorder was killed; its complete records are read."""

    messages = McapReader.messages_scan  # there is no index

    def open(self) -> None:
        """Find the complete records and their contents."""
        self.bio, size = self.path.open("rb"), self.path.stat().st_size
        self.data_start = end = len(MAGIC)
        while end <= size:
            self.data_end = self.bio.seek(end)
            head = self.bio.read(9)  # kind and length
            end += 9 + (int.from_bytes(head[1:], "little") if len(head) == 9 else size)
        self.meta_scan()
        assert self.statistics is not None
        counts = self.statistics.channel_message_counts
        self.connections = [each._replace(msgcount=counts.get(each.id, 0)) for each in self.connections]
        if self.statistics.message_count:
            start, last = self.statistics.start_time, self.statistics.end_time
            self.metadata = self.metadata._replace(start_time=start, end_time=last + 1)


def _reader(path: Path) -> Reader:
    """Reader of a folder with metadata, or of a file."""
    reader = Reader(path)
    if path.is_file() and path.suffix == SUFFIX:
        with path.open("rb") as content:
            begins = content.read(len(MAGIC))
            if not begins:
                raise ValueError(f"{path.name} is empty: nothing was written yet")
            content.seek(-len(MAGIC), os.SEEK_END)
            if begins == MAGIC and content.read() != MAGIC:
                reader.storage = _Unfinished(path)
    return reader


def _stored(reader: Reader) -> list[interfaces.Connection]:
    """The topics by the files themselves; a folder's metadata may give another quality of service, or count."""
    return [each for file in getattr(reader.storage, "storages", [reader.storage]) for each in file.connections]


def _parts(path: Path) -> list[Path]:
    """The folder, if it has metadata, or else the files. A file that is alone in its folder counts as that folder."""
    if path.is_file():
        alone = len(list(path.parent.glob(f"*{path.suffix}"))) == 1
        return [path.parent if alone and path.with_name(METADATA_FILE).is_file() else path]
    if (path / METADATA_FILE).is_file():
        return [path]
    found = [file for suffix in (SUFFIX, ".db3") for file in path.glob(f"*{suffix}")]
    if not found:
        raise FileNotFoundError(f"neither {METADATA_FILE} nor a file *{SUFFIX} or *.db3")
    return found


def offered(profile: Any) -> interfaces.Qos:
    """Convert the `QoSProfile` that a publisher offers to the form in which it is recorded."""

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
