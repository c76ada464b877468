"""A session as a recording of rerun, with all that its own reader of ROS 2 leaves out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from us_sim.errors import BagError, UsSimError
from us_sim.recording.decoding import nanoseconds_of
from us_sim.recording.reader import Bag, read_bag
from us_sim.recording.topic import BagTopic
from us_sim.settings.spelling import counted

if TYPE_CHECKING:
    from us_sim.command.rerun_converters import Shown


OLDEST = "0.41"  # of the versions of rerun, the oldest with which this works
STAMP = "stamp"  # timeline of the poses that messages come from
RECORDED = "recorded"  # timeline of when messages came to the recorder


def require_rerun() -> None:
    """Refuse at once where rerun is not installed, or too old.

    Raises:
        BagError: it is.
    """
    try:
        import rerun
    except ImportError:
        raise BagError(f"rerun is not installed: pip install 'rerun-sdk>={OLDEST}'") from None
    if tuple(map(int, rerun.__version__.split(".")[:2])) < tuple(map(int, OLDEST.split("."))):
        raise BagError(f"rerun {rerun.__version__} is too old: pip install 'rerun-sdk>={OLDEST}'")


class RerunFile:
    """Logs to a file beside the one that is wanted, which it becomes when all is written.

    Args:
        file: to write, which must not be there.
        name: of the recording, as the viewer lists it.

    Raises:
        BagError: the file is there already, or its folder cannot be written to.
    """

    def __init__(self, file: Path, name: str) -> None:
        import rerun

        self._file = file
        self._partial = file.with_name(f"{file.name}.part")
        if file.exists():
            raise BagError(f"{file} exists already: choose another file with --out")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            self._partial.touch()
        except OSError as error:
            raise BagError(f"{file} cannot be written: {error.strerror}") from None
        self._stream = rerun.RecordingStream("us_sim")
        self._stream.set_log_time_enabled(False)  # when it was converted is of no interest
        self._stream.save(self._partial)
        self._stream.send_recording_name(name)
        self._frames: dict[str, str] = {}

    def at(self, stamp: int | None, recorded: int) -> None:
        """Set the time of everything that is logged from now on.

        Args:
            stamp: ns since 1970, of the measurement; None of what has no stamp.
            recorded: ns since 1970.
        """
        moments = {STAMP: recorded if stamp is None else stamp, RECORDED: recorded}
        for timeline, moment in moments.items():
            self._stream.set_time(timeline, timestamp=np.datetime64(moment, "ns"))

    def log(self, entity: str, *parts: Any, static: bool = False) -> None:
        """Log archetypes of rerun at the time that `at` set, or as constant."""
        self._stream.log(entity, *parts, static=static)

    def place(self, entity: str, frame: str) -> None:
        """Say in which frame an entity is, at all times: the last that was said."""
        import rerun

        if self._frames.get(entity) != frame:
            self._frames[entity] = frame
            self.log(entity, rerun.CoordinateFrame(frame), static=True)

    def show(self, blueprint: Any) -> None:
        """Set the layout that the viewer opens."""
        self._stream.send_blueprint(blueprint)

    def __enter__(self) -> RerunFile:
        return self

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        self._stream.flush()
        self._stream.disconnect()
        if error is not None:
            self._partial.unlink(missing_ok=True)
        else:
            self._partial.rename(self._file)


_OF_POSES = ("/tf", "/tissue/nodes", "/skin/nodes", "/ultrasound/image")
"""Topics whose messages are stamped as poses are."""


def to_rerun(session: Path, file: Path, progress: Callable[[float, str], None]) -> list[str]:
    """Write a session as a recording of rerun.

    Each message is there at two times, on the timelines `stamp` and `recorded`. Where nobody
    recorded the markers of the structures, these are made from the attached scene.

    Args:
        session: a recording of `session_recorder`, or any bag with such topics.
        file: to write, such as ``session.rrd``.
        progress: called with the fraction that is done, and what is being done.

    Returns:
        Sentences about what was left out.

    Raises:
        BagError: rerun is not installed, the session cannot be read or has nothing to show, or the
            file is there already or cannot be written.
    """
    require_rerun()
    bag = read_bag(session)
    conversion = _Conversion(bag, progress)
    if not conversion.shown:
        raise BagError(f"{session} has no messages on topics that could be shown")
    with RerunFile(file, session.stem) as recording:
        conversion.write(recording)
    return conversion.left_out


class _Conversion:
    def __init__(self, bag: Bag, tell: Callable[[float, str], None]) -> None:
        from us_sim.command import rerun_converters as converters  # which need rerun

        self._converters = converters
        self._bag, self._tell = bag, tell
        self.left_out: list[str] = []
        there = {topic.name: topic for topic in bag.topics if topic.message_count}
        skin, images, markers = converters.Skin(), converters.Images(), converters.Markers()
        by_type: dict[str, Shown] = {
            "tf2_msgs/msg/TFMessage": converters.Transforms(),
            "sensor_msgs/msg/PointCloud2": converters.Clouds(),
            "sensor_msgs/msg/Image": images,
            "visualization_msgs/msg/Marker": markers,
            "visualization_msgs/msg/MarkerArray": markers,
            "geometry_msgs/msg/WrenchStamped": converters.Wrenches(),
            "diagnostic_msgs/msg/DiagnosticArray": converters.Diagnostics(),
            "std_msgs/msg/String": converters.Texts(),
        }
        self.shown: dict[str, list[Shown]] = {
            name: [by_type[topic.type_name]]
            for name, topic in there.items()
            if topic.type_name in by_type
        }
        if "/ultrasound/image_to_probe" in there and "/ultrasound/image" in there:
            self.shown["/ultrasound/image_to_probe"] = [images]
        if {"/skin/mesh", "/skin/nodes"} <= there.keys():
            self.shown |= {"/skin/mesh": [skin], "/skin/nodes": [skin]}
            self.shown.pop("/skin/marker", None)  # which is the same surface
        self.shown.pop("/tissue/rest", None)  # which would lie among the nodes
        self._carry_structures(there)
        self._there = there

    def _carry_structures(self, there: dict[str, BagTopic]) -> None:
        mesh = {"/tissue/rest", "/tissue/tetrahedra"}
        if "/tissue/structures" in there or not mesh <= there.keys():
            return
        if "/tissue/nodes" not in self.shown:
            return
        try:
            structures = self._converters.Structures(self._bag, self._tell)
            self.shown["/tissue/nodes"].append(structures)
        except UsSimError as error:
            self.left_out.append(f"the structures of the scene are left out: {error}")

    def write(self, file: RerunFile) -> None:
        """Log all messages, and the viewer's layout."""
        total = sum(self._there[name].message_count for name in self.shown)
        refused: dict[str, tuple[int, str]] = {}
        stamps: list[int] = []  # of poses
        for done, message in enumerate(self._bag.messages(self.shown), 1):
            decoded: Any = self._bag.deserialize(message)
            stamp = _stamp_of(decoded)
            if stamp is not None and message.topic in _OF_POSES:
                stamps.append(stamp)
            for shown in self.shown[message.topic]:
                try:
                    file.at(stamp, message.log_time)
                    shown.take(message.topic.lstrip("/"), decoded, file)
                except UsSimError as error:
                    count, first = refused.get(message.topic, (0, str(error)))
                    refused[message.topic] = count + 1, first
            if done % 20 == 0 or done == total:
                self._tell(done / total, message.topic)
        self.left_out += [
            f"{topic}: {counted(count, 'message is', 'messages are')} left out, the first because "
            f"{first}"
            for topic, (count, first) in refused.items()
        ]
        entities = [name.lstrip("/") for name in self.shown]
        images = [
            name.lstrip("/")
            for name in self.shown
            if self._there[name].type_name == "sensor_msgs/msg/Image"
        ]
        span = (min(stamps), max(stamps)) if stamps else None
        file.show(self._converters.blueprint_of(entities, images, "patient", span))


def _stamp_of(message: Any) -> int | None:
    """ns since 1970, of the header, or of the first transform; None where there is none, or 0."""
    header = getattr(message, "header", None)
    for part in ("transforms", "markers"):
        among = getattr(message, part, None)
        if header is None and among:
            header = among[0].header
    return nanoseconds_of(header.stamp) or None if header is not None else None
