"""The quality of service of each kind of topic in the graph."""

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

STREAM = QoSProfile(depth=10)  # reliable, volatile, keep last, as rclpy's is where nothing is said
"""Poses, nodes and images inside the graph, for subscribers that want the newest."""

SENT = QoSProfile(depth=100)
"""The same for publishers: kept until all have acknowledged them, so that a recorder that gets no
processor for a second loses none."""

EVERY = QoSProfile(depth=1000)
"""Subscribers that must not lose a message, as in lockstep."""

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Topics published once, for later subscribers too."""

FOREIGN = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Input from drivers, many of which publish best effort. A tracker's filter wants every pose, so
some may wait while the process does not get a processor."""
