"""Read a recording: ours, or one of rosbag2 in MCAP or SQLite. Knows no node."""

import json
import math
import sqlite3
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from mcap.exceptions import McapError
from mcap.reader import make_reader

from dm_tools.recording.bag import HASH_KEY, INFORMATION, METADATA_FILE, PARAMETERS_RECORD, QOS_KEY, SUFFIX, Topic


class BagError(ValueError):
    """The recording cannot be read; the message says which and why."""


@dataclass(frozen=True)
class Message:
    """One recorded message: serialised as CDR, received at `log_time`, published at `publish_time`, ns."""

    topic: Topic
    data: bytes
    log_time: int
    publish_time: int


class BagReader:
    """Reads a recording, ours or one of `ros2 bag record`: a folder, of one or several files, or one file of it.

    Attributes:
        file: the first one.
        topics, counts: topics, and numbers of their messages, by name.
        messages: of all topics.
        duration_s: from the first message to the last.
    """

    def __init__(self, path: Path) -> None:
        """Open what is at `path`.

        Raises:
            BagError: no recording there, or none that can be read.
        """
        self._parts: list[_McapPart | _SqlitePart] = [_PARTS[file.suffix](file) for file in _files(path)]
        self._parts.sort(key=lambda part: part.span[0] or math.inf)  # empty ones last
        self.file = self._parts[0].file
        self.topics: dict[str, Topic] = {}
        counted: Counter[str] = Counter()
        for part in self._parts:
            self.topics |= {topic.name: topic for topic in part.topics.values()}
            counted.update(part.counts)
        self.counts = {name: counted[name] for name in self.topics}
        self.messages = sum(self.counts.values())
        spans = [part.span for part in self._parts if any(part.counts.values())]
        self.duration_s = 1e-9 * (max(end for _, end in spans) - min(start for start, _ in spans)) if spans else 0.0

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Parameters of the nodes when the recording began, by node name; empty when it has none."""
        return {node: json.loads(text) for node, text in self._parts[0].parameters.items()}

    def read(self, names: Sequence[str] | None = None) -> Iterator[Message]:
        """Messages in the order received; `names` = only of these topics.

        Raises:
            BagError: the file is damaged.
        """
        for part in self._parts:  # each begins where the one before ended
            with _readable(part.file):
                yield from part.read(names)


class _McapPart:
    """One MCAP file of a recording."""

    def __init__(self, file: Path) -> None:
        self.file = file
        with _readable(file), file.open("rb") as stream:
            reader = make_reader(stream)
            reader.get_header()
            summary = reader.get_summary()
            metadata = {record.name: dict(record.metadata) for record in reader.iter_metadata()}
        if summary is None or summary.statistics is None:
            raise BagError(f"{file}: has no summary: the recording was not finished")
        self.parameters: Mapping[str, str] = metadata.get(PARAMETERS_RECORD, {})
        self.span = (summary.statistics.message_start_time, summary.statistics.message_end_time)
        self.topics: dict[int, Topic] = {}
        self.counts: dict[str, int] = {}
        for number, channel in summary.channels.items():
            qos = yaml.safe_load(channel.metadata.get(QOS_KEY, "")) or []
            topic = Topic(
                channel.topic, summary.schemas[channel.schema_id].name, qos, channel.metadata.get(HASH_KEY, "")
            )
            self.topics[number] = topic
            self.counts[topic.name] = summary.statistics.channel_message_counts.get(number, 0)

    def read(self, names: Sequence[str] | None) -> Iterator[Message]:
        """Messages in the order received."""
        with self.file.open("rb") as stream:
            for _schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages(names):
                yield Message(self.topics[channel.id], message.data, message.log_time, message.publish_time)


class _SqlitePart:
    """One file of `ros2 bag record -s sqlite3`, which knows no time of publication."""

    parameters: Mapping[str, str] = {}

    def __init__(self, file: Path) -> None:
        self.file = file
        with _readable(file), self._database() as database:
            # The hash of the type came in version 4 of the tables.
            rows = database.execute("SELECT id, name, type, offered_qos_profiles FROM topics").fetchall()
            counted = dict(database.execute("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id"))
            first_last = "SELECT IFNULL(MIN(timestamp), 0), IFNULL(MAX(timestamp), 0) FROM messages"
            self.span = database.execute(first_last).fetchone()
        self.topics = {number: Topic(name, kind, yaml.safe_load(qos) or []) for number, name, kind, qos in rows}
        self.counts = {topic.name: counted.get(number, 0) for number, topic in self.topics.items()}

    def read(self, names: Sequence[str] | None) -> Iterator[Message]:
        """Messages in the order received."""
        with self._database() as database:
            rows = database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp, id")
            for number, time, data in rows:
                if names is None or self.topics[number].name in names:
                    yield Message(self.topics[number], data, time, time)

    def _database(self) -> closing[sqlite3.Connection]:
        return closing(sqlite3.connect(f"{self.file.resolve().as_uri()}?mode=ro", uri=True))


_PARTS: dict[str, type[_McapPart] | type[_SqlitePart]] = {SUFFIX: _McapPart, ".db3": _SqlitePart}


def _files(path: Path) -> list[Path]:
    """The files of a recording."""
    if not path.is_dir():
        found = [path]
    elif (described := path / METADATA_FILE).is_file():
        try:
            found = [path / name for name in yaml.safe_load(described.read_text())[INFORMATION]["relative_file_paths"]]
        except (yaml.YAMLError, KeyError, TypeError, OSError, UnicodeDecodeError) as error:
            raise BagError(f"{described}: cannot be read: {error!r}") from error
    else:
        found = list(path.glob(f"*{SUFFIX}"))
    if not found or not all(file.is_file() and file.suffix in _PARTS for file in found):
        named = ", ".join(file.name for file in found) or "no file"
        raise BagError(f"{path}: {named}: a recording has files {' or '.join(_PARTS)}, not compressed as a whole")
    return found


@contextmanager
def _readable(file: Path) -> Iterator[None]:
    """What goes wrong while a file is read becomes BagError."""
    try:
        yield
    except (McapError, sqlite3.Error, OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise BagError(f"{file}: cannot be read: {error}") from error
