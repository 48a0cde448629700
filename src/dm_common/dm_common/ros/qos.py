"""Quality-of-service profiles, one per kind of topic."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

#: Set-points: reliable, and the latest wins, so that a slow reader never works off a queue of old requests.
COMMAND = QoSProfile(depth=1, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)

#: State streams: reliable with a small depth, so that a short stall loses nothing.
STATE = QoSProfile(depth=10, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)

#: Facts that late joiners need (calibration, capabilities, mirror info).
LATCHED = QoSProfile(
    depth=1,
    history=HistoryPolicy.KEEP_LAST,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

#: Services that many ask at once: a server keeps as many requests, and answers on their way, as this, whoever they are
#: from. With the default of 10 a hundred clients at once lose one request in five (measured).
SERVICE = QoSProfile(depth=1000, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)

#: Surface maps of several megabytes. Reliable, because best effort loses whole maps once they exceed the transport's
#: datagram size (ros2/rmw_fastrtps#739).
MAP = QoSProfile(depth=1, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
