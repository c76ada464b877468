"""What the viewer opens: the scene in three dimensions, the image, curves and states.

A session as a recording of rerun, with what rerun's own reader of ROS 2 messages leaves out.

>>> from pathlib import Path
>>> from us_sim.progress import late_progress
>>> from us_sim.to_rerun.conversion import to_rerun
>>> progress = late_progress("to rerun")
>>> to_rerun(Path("demo/session.mcap"), Path("demo/session.rrd"), progress)  # doctest: +SKIP
[]
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rerun.blueprint as views
from rerun.encodings import AbsoluteTimeRange

from us_sim.errors import BagError, UsSimError
from us_sim.nodes.conversions import nanoseconds_of
from us_sim.recording.reader import Bag, read_bag
from us_sim.recording.topic import BagTopic
from us_sim.settings.spelling import counted
from us_sim.to_rerun.converters import CURVES, IMAGE
from us_sim.to_rerun.rerun_file import STAMP, RerunFile, require_rerun

if TYPE_CHECKING:
    from us_sim.to_rerun.converters import Shown


_BACKGROUND = (14, 17, 19)
_FROM, _AT, _UP = (0.11, -0.16, -0.11), (0.0, 0.0, 0.012), (0.0, 0.0, -1.0)
"""Where the eye is, what it looks at, and what is up, in `patient`, m: +z is into the tissue."""
_TITLES = {
    "rate": "Rates, Hz",
    "latency": "Latency of the nodes, ms",
    "residual": "Residuals",
}


def blueprint_of(
    shown: Collection[str], images: Collection[str], frame: str, span: tuple[int, int] | None
) -> Any:
    """Views of what is there.

    Args:
        shown: entities of topics that have messages.
        images: those of them that are images.
        frame: that the scene is seen in.
        span: ns since 1970, from the first stamp of a pose to the last, which is played; None where
            there are none.
    """
    scene = views.Spatial3DView(
        origin="/",
        name="Scene",
        contents=["/**", *(f"- /{image}" for image in images), "- /diagnostics/**"],
        spatial_information=views.SpatialInformation(frame),
        background=_BACKGROUND,
        line_grid=False,
        eye_controls=views.EyeControls3D(position=_FROM, look_target=_AT, eye_up=_UP),
    )
    ordered = sorted(images, key=lambda image: (image != IMAGE, image))
    beside = [views.Spatial2DView(origin=image, name=image) for image in ordered]
    curves = []
    if "probe/wrench" in shown:
        curves.append(views.TimeSeriesView(origin="probe/wrench", name="Force on the probe, N"))
    if "diagnostics" in shown:
        curves += [
            views.TimeSeriesView(origin=f"diagnostics/{curve}", name=_TITLES[curve])
            for curve in CURVES.values()
        ]
        curves.append(views.TextLogView(origin="diagnostics/state", name="States"))
    right = []
    if beside:
        right.append(views.Tabs(*beside, active_tab=0))
    if curves:
        right.append(views.Tabs(*curves, active_tab=0))
    whole = views.Horizontal(scene, views.Vertical(*right, row_shares=[2, 1][: len(right)]))
    selection = None if span is None else AbsoluteTimeRange(*span)
    time = views.TimePanel(
        timeline=STAMP,
        time_selection=selection,
        loop_mode=None if span is None else "selection",
        state="collapsed",
    )
    return views.Blueprint(whole if right else scene, time, collapse_panels=True)


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
    """Which messages of a bag are logged by whom."""

    def __init__(self, bag: Bag, tell: Callable[[float, str], None]) -> None:
        from us_sim.to_rerun.converters import (
            Clouds,
            Diagnostics,
            Images,
            Markers,
            Skin,
            Texts,
            Transforms,
            Wrenches,
        )

        self._bag, self._tell = bag, tell
        self.left_out: list[str] = []
        there = {topic.name: topic for topic in bag.topics if topic.message_count}
        skin, images, markers = Skin(), Images(), Markers()
        by_type: dict[str, Shown] = {
            "tf2_msgs/msg/TFMessage": Transforms(),
            "sensor_msgs/msg/PointCloud2": Clouds(),
            "sensor_msgs/msg/Image": images,
            "visualization_msgs/msg/Marker": markers,
            "visualization_msgs/msg/MarkerArray": markers,
            "geometry_msgs/msg/WrenchStamped": Wrenches(),
            "diagnostic_msgs/msg/DiagnosticArray": Diagnostics(),
            "std_msgs/msg/String": Texts(),
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
        """Make the structures from the scene where they were not recorded."""
        from us_sim.to_rerun.converters import REST, TETRAHEDRA, Structures

        if "/tissue/structures" in there or not {REST, TETRAHEDRA} <= there.keys():
            return
        if "/tissue/nodes" not in self.shown:
            return
        try:
            self.shown["/tissue/nodes"].append(Structures(self._bag, self._tell))
        except UsSimError as error:
            self.left_out.append(f"the structures of the scene are left out: {error}")

    def write(self, file: RerunFile) -> None:
        """Log all messages, and what the viewer opens."""
        from us_sim.to_rerun.conversion import blueprint_of

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
        file.show(blueprint_of(entities, images, "patient", span))


def _stamp_of(message: Any) -> int | None:
    """ns since 1970, of the header, or of the first transform; None where there is none, or 0."""
    header = getattr(message, "header", None)
    for part in ("transforms", "markers"):
        among = getattr(message, part, None)
        if header is None and among:
            header = among[0].header
    return nanoseconds_of(header.stamp) or None if header is not None else None
