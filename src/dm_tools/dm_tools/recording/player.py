"""Publish a recording again, in its own time."""

import time
from collections.abc import Callable, Sequence
from contextlib import closing

from rclpy.duration import Duration
from rclpy.node import Node

from dm_client.connection import Connection
from dm_tools.recording.bag import PARAMETER_EVENTS, BagReader, Topic
from dm_tools.recording.interfaces import UnknownTypeError, message_class
from dm_tools.recording.recorder import COMMON, profile_for

#: Topics that would move a real mirror; published only when asked for.
COMMANDS = ("actuator_command", "focus_request")
#: Topic that only drivers publish: nodes that follow a live driver would take the recorded moves for its own.
DRIVER_STATE = "actuator_state"
#: Topics that belong to the nodes of the recording, not to its data.
HOUSEKEEPING = ("/rosout", PARAMETER_EVENTS)
DEPTH = 10
#: Time for subscribers to find the publishers before the first message, s.
DISCOVERY_S = 1.0
#: Longest wait for acknowledgements of the last messages: a subscriber may be suspended.
ACKNOWLEDGED = Duration(seconds=2)


def replayed(
    topics: Sequence[str], names: Sequence[str] = (), commands: bool = False, namespace: str = ""
) -> list[str]:
    """Which of `topics` are published: `names`, or all but commands, hidden and housekeeping ones.

    Args:
        namespace: only topics in it, and those that all mirrors share; "" = all.

    Raises:
        ValueError: a name or namespace that is not in the recording, or a command that must not be published.
    """
    prefix = f"/{namespace.strip('/')}/" if namespace.strip("/") else "/"
    if namespace and not any(name.startswith(prefix) for name in topics):
        raise ValueError(f"namespace {namespace}: no topic of the recording is in it: {', '.join(sorted(topics))}")
    wanted = [name if name.startswith("/") else prefix + name for name in names]
    for name in wanted:
        if name not in topics:
            raise ValueError(f"topic {name}: not in the recording, which has {', '.join(sorted(topics))}")
        if not commands and name.rsplit("/", 1)[-1] in COMMANDS:
            raise ValueError(f"topic {name}: a command, which is published with --commands only")
    own = [name for name in topics if name.startswith(prefix) or name in COMMON]
    chosen = wanted or [name for name in own if "/_" not in name and name not in HOUSEKEEPING]
    return [name for name in chosen if commands or name.rsplit("/", 1)[-1] not in COMMANDS]


def play(
    bag: BagReader,
    names: Sequence[str],
    rate: float = 1.0,
    domain: int | None = None,
    progress: Callable[[float], None] = lambda seconds: None,
    remark: Callable[[str], None] = lambda text: None,
) -> dict[str, int]:
    """Publish the topics `names` of the recording; returns the number of messages of each that was published.

    Topics are left out whose type is not installed, or had another layout when they were recorded: their bytes would
    be misread.

    Args:
        rate: times faster than recorded, above 0.
        progress: called with the time in the recording, s.
        remark: called with a sentence for each topic that is left out.

    Raises:
        ValueError: one of the topics is the state of a driver, and a driver is running.
        BagError: the file is damaged.
    """
    with closing(Connection("dm_player", "", domain, topics={}, watched={})) as connection:
        connection.start()
        node, publishers = connection.node, {}
        for topic in [bag.topics[name] for name in names]:
            try:
                kind = message_class(topic.type_name)
            except UnknownTypeError as error:  # a recording of all topics may hold those of any other program
                remark(f"{topic.name} is left out: {error}")
            else:
                loose = {offer.reliability.name for offer in topic.qos} == {"BEST_EFFORT"}
                profile = profile_for(topic, DEPTH, reliable=not loose)
                publishers[topic.name] = node.create_publisher(kind, topic.name, profile)
        time.sleep(DISCOVERY_S)
        for name in publishers:
            _check_no_driver(node, name)
        for topic in [bag.topics[name] for name in publishers if _has_changed(node, bag.topics[name])]:
            node.destroy_publisher(publishers.pop(topic.name))
            remark(f"{topic.name} is left out: {topic.type_name} had another layout when it was recorded")
        begun, first, counts = time.monotonic(), None, dict.fromkeys(publishers, 0)
        for message in bag.read(list(publishers)):
            first = message.log_time if first is None else first
            elapsed = 1e-9 * (message.log_time - first)
            time.sleep(max(0.0, begun + elapsed / rate - time.monotonic()))
            _check_no_driver(node, message.topic.name)  # one may start meanwhile, or be found late on a busy machine
            publishers[message.topic.name].publish(message.data)
            counts[message.topic.name] += 1
            progress(elapsed)
        for publisher in publishers.values():  # otherwise the last messages would be lost with their publisher
            publisher.wait_for_all_acked(ACKNOWLEDGED)
        return counts


def _check_no_driver(node: Node, name: str) -> None:
    """Raise ValueError if the topic is the state of a driver, and a live driver publishes it."""
    if name.rsplit("/", 1)[-1] != DRIVER_STATE:
        return
    if living := {info.node_name for info in node.get_publishers_info_by_topic(name)} - {node.get_name()}:
        raise ValueError(
            f"{name}: the node {living.pop()} publishes it here, and its subscribers would take the recorded moves "
            "for real ones; replay with another ROS_DOMAIN_ID, or --topics without it"
        )


def _has_changed(node: Node, topic: Topic) -> bool:
    """Whether the type of `topic` has another layout than was recorded, as far as is known."""
    published = [info for info in node.get_publishers_info_by_topic(topic.name) if info.node_name == node.get_name()]
    return topic.type_hash.startswith("RIHS") and topic.type_hash not in {str(o.topic_type_hash) for o in published}
