"""What can be set of the nodes that record and play sessions: their parameters."""

from __future__ import annotations

import posixpath
from dataclasses import dataclass

from us_sim.nodes.topics import TOPICS
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

BEGUN = Quantity("time", 0.0, 1e10)
"""When something began, since 1970."""
_SPEED = Quantity("number", 0.01, 100.0)
_SPAN = Quantity("time", 0.0, 1e6)
_BYTES = Quantity("number", 0, 2**53)
LOST = "events/rosbag2_messages_lost"
NOT_THE_SESSION = ("/rosout", "/parameter_events", LOST)
"""Topics that are not recorded; losses are in the recording's metadata."""
SHARED = ("/tf", "/tf_static")
"""Topics that a recorder takes outside its namespace, too: frames may be common to all."""
OF_SIMULATORS = tuple(f"/{topic.name}" for topic in TOPICS if not topic.from_drivers)
"""How the names of topics end that only a simulator publishes, in whichever namespace it is."""


@dataclass(frozen=True)
class AwaitedSettings(Settings):
    """Of nodes that play: when they begin."""

    await_topics: tuple[str, ...] = setting(
        description="begin when each of these has a publisher", default=()
    )
    await_recorded: tuple[str, ...] = setting(
        description="and session_recorder subscribes to each of these", default=()
    )


@dataclass(frozen=True)
class PathPlayerSettings(Settings):
    """Of ``path_player``."""

    path: str | None = setting(
        description="bag or tracker recording to play", default=None, file=True
    )
    topic: str | None = setting(
        description="in the bag; not given: the only one of PoseStamped", default=None
    )
    rate: float = setting(_SPEED, "speed factor", default=1.0, live=True)
    loop: bool = setting(description="start again at the end", default=False, live=True)
    paused: bool = setting(
        description="hold the probe where it is; not in lockstep", default=False, live=True
    )
    time: float = setting(
        _SPAN, "from the start, where to play on each time this is set", default=0.0, live=True
    )
    stay: bool = setting(
        description="hold the probe at the end until `time` is set, else end there", default=False
    )
    restamp: bool = setting(
        description="stamp poses when they are sent, else as recorded", default=True
    )
    lockstep: bool = setting(
        description="send the next pose when the image of the last has come", default=False
    )
    begun: float = setting(
        BEGUN,
        "since 1970, when the first pose was sent: play on where the path would be by now; 0: from "
        "the start",
        default=0.0,
    )


@dataclass(frozen=True)
class SessionPlayerSettings(Settings):
    """Of ``session_player``."""

    path: str | None = setting(description="bag to play", default=None, file=True)
    rate: float = setting(_SPEED, "speed factor", default=1.0, live=True)
    loop: bool = setting(description="start again at the end", default=False, live=True)
    paused: bool = setting(description="publish nothing", default=False, live=True)
    time: float = setting(
        _SPAN, "from the start, where to play on each time this is set", default=0.0, live=True
    )
    stay: bool = setting(
        description="wait at the end until `time` is set, else end there", default=False
    )
    exclude: tuple[str, ...] = setting(description="full names to leave out", default=())


@dataclass(frozen=True)
class SessionRecorderSettings(Settings):
    """Of ``session_recorder``."""

    file: str = setting(
        description="MCAP file to write, or a new folder for a bag", default="session.mcap"
    )
    if_exists: str = setting(
        description="a recording of that name that is there already: refuse to start, or go on in "
        "a further file beside it",
        choices=("refuse", "further"),
        default="refuse",
    )
    compression: str = setting(
        description="of the file's chunks", choices=("none", "zstd"), default="none"
    )
    topics: tuple[str, ...] = setting(
        description="names, in this node's namespace or from `/` on; none: all of the namespace, "
        "but no other simulator's and none made on demand",
        default=(),
    )
    also: tuple[str, ...] = setting(
        description="names of topics that are recorded beside these: made on demand, such as "
        "tissue/structures, or outside the namespace",
        default=(),
    )
    exclude: tuple[str, ...] = setting(description="names to leave out", default=())
    max_cache_size: int = setting(
        _BYTES,
        "bytes of messages that may wait for the disk; 0: whoever publishes in this process waits",
        default=100 * 1024 * 1024,
    )
    max_bagfile_size: int = setting(
        _BYTES, "bytes after which a further file is begun; 0: never", default=0
    )
    max_bagfile_duration: float = setting(
        _SPAN, "after which a further file is begun; 0: never", default=0.0
    )
    start_paused: bool = setting(description="wait for the service ~/resume", default=False)
    snapshot_mode: bool = setting(
        description="keep messages in memory, max_cache_size at most, until ~/snapshot writes them",
        default=False,
    )
    snapshot_duration: float = setting(_SPAN, "how old they may be; 0: any", default=0.0)
    scene: str | None = setting(
        description="scene that is recorded, to be attached with the files that it names",
        default=None,
    )
    volume: str | None = setting(
        description="volume file in place of the scene's", default=None, file=True
    )
    path: str | None = setting(
        description="bag or tracker recording that is played in place of the scene's path",
        default=None,
        file=True,
    )
    parameters: str = setting(
        description="those of all nodes, as YAML: attached as parameters.yaml", default=""
    )
    attach: tuple[str, ...] = setting(description="more files to attach", default=())

    def records(self, topic: str, namespace: str = "/") -> bool:
        """Whether a recorder in this namespace records a topic, given by its full name.

        Topics of another simulator, and those made on demand, it records only by name.
        """

        def among(*names: str) -> bool:
            return topic in {posixpath.join(namespace, name) for name in names}

        if among(*self.exclude, *NOT_THE_SESSION):
            return False
        if self.topics or among(*self.also):
            return among(*self.topics, *self.also)
        if topic.endswith(OF_SIMULATORS):
            return among(*(each.name for each in TOPICS if not each.on_demand), *SHARED)
        return topic.startswith(posixpath.join(namespace, "")) or topic in SHARED

    @property
    def at_once(self) -> bool:
        """Whether it records from its start on what it records, and not when it is told to."""
        return not (self.start_paused or self.snapshot_mode)


@dataclass(frozen=True)
class SessionControlSettings(Settings):
    """Of ``session_control``."""

    live = True

    scene: str = setting(
        description="scene file, name of an installed one, or `case:NAME`; setting it, also to "
        "what it is, loads it",
        default="upper_arm",
    )
    volume: str | None = setting(
        description="volume file in place of the scene's; of no other scene than it is set with",
        default=None,
    )
    record: str | None = setting(
        description="new MCAP file to record to; none ends the recording", default=None
    )
    replay: str | None = setting(
        description="bag to play; setting it to what it is plays it from its start; none ends it",
        default=None,
    )
    replay_as: str = setting(
        description="path: the probe moves as recorded; recording: all recorded topics are "
        "published in place of the simulation, which goes on afterwards",
        choices=("path", "recording"),
        default="path",
    )
    replay_rate: float = setting(_SPEED, "speed factor", default=1.0)
    replay_loop: bool = setting(description="start again at the end", default=False)
    replay_paused: bool = setting(description="hold it where it is", default=False)
    replay_time: float = setting(
        _SPAN, "from the start, where to play on each time this is set", default=0.0
    )
