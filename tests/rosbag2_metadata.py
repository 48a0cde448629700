"""Read `metadata.yaml` as strictly as rosbag2 of ROS 2 Jazzy does (rosbag2_storage/yaml.hpp and qos.cpp, version 9)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

_POLICIES = {
    "history": {"system_default", "keep_last", "keep_all", "unknown"},
    "reliability": {"system_default", "reliable", "best_effort", "unknown", "best_available"},
    "durability": {"system_default", "transient_local", "volatile", "unknown", "best_available"},
    "liveliness": {"system_default", "automatic", "manual_by_topic", "unknown", "best_available"},
}
_UNSIGNED = 2**64


def read_metadata(file: Path) -> dict[str, Any]:
    """The content of a metadata file.

    Raises:
        KeyError, AssertionError: rosbag2 would not read it.
    """
    information: dict[str, Any] = yaml.safe_load(file.read_text())["rosbag2_bagfile_information"]
    assert information["version"] == 9
    for name in ("storage_identifier", "compression_format", "compression_mode", "ros_distro"):
        assert isinstance(information[name], str), name
    _number(information["duration"]["nanoseconds"])
    _number(information["starting_time"]["nanoseconds_since_epoch"])
    _number(information["message_count"])
    for topic in information["topics_with_message_count"]:
        _number(topic["message_count"])
        _topic(topic["topic_metadata"])
    paths = information["relative_file_paths"]
    assert isinstance(paths, list) and all((file.parent / path).is_file() for path in paths)
    for part in information["files"]:
        assert part["path"] in paths
        _number(part["starting_time"]["nanoseconds_since_epoch"])
        _number(part["duration"]["nanoseconds"])
        _number(part["message_count"])
    assert isinstance(information["custom_data"] or {}, dict)
    return information


def _topic(metadata: dict[str, Any]) -> None:
    for name in ("name", "type", "serialization_format", "type_description_hash"):
        assert isinstance(metadata[name], str), name
    assert isinstance(metadata["offered_qos_profiles"], list)
    for profile in metadata["offered_qos_profiles"]:
        for policy, words in _POLICIES.items():
            assert profile[policy] in words, policy
        assert 0 <= profile["depth"] < 2**31
        for name in ("deadline", "lifespan", "liveliness_lease_duration"):
            _number(profile[name]["sec"])
            _number(profile[name]["nsec"])
        assert isinstance(profile["avoid_ros_namespace_conventions"], bool)


def _number(value: Any) -> None:
    assert isinstance(value, int) and not isinstance(value, bool) and 0 <= value < _UNSIGNED, value
