"""Parameters of each node, with unit, range and meaning, without any ROS.

Nodes declare them with `us_sim.nodes.parameters`, `us-sim` checks ``--param`` with them before it
starts anything, and `us-sim reference` prints them.
"""

from __future__ import annotations

import posixpath
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, get_args, get_origin

from us_sim.errors import UsSimError
from us_sim.nodes.topics import TOPICS
from us_sim.scene.building import build_probe
from us_sim.scene.scene import Scene
from us_sim.scoring.settings import ScoreSettings
from us_sim.settings.quantity import Quantity
from us_sim.settings.registry import FILTERS, SOLVERS, TRACKERS
from us_sim.settings.setting import (
    RefusedValueError,
    Settings,
    convert_value,
    kinds_of,
    rules_of,
    setting,
)
from us_sim.settings.spelling import describe_unknown
from us_sim.settings.text_files import YamlError, load_yaml
from us_sim.settings.viewer import ViewerSettings
from us_sim.skin.settings import MembraneSettings
from us_sim.slicing.acoustics.settings import SoundSettings, TissueAcoustics
from us_sim.slicing.settings import OVERLAYS, TISSUE_PARAMETERS, Imaging
from us_sim.tracking.robot import RobotSettings

_AGE = Quantity("time", 0.01, 3600.0)


@dataclass(frozen=True)
class AnnotatedImageSettings(Settings):
    """Parameters of ``slice_interpolator`` for the annotated image, and for the age of its pose."""

    live = True

    stale_after: float = setting(
        _AGE, "time without a new pose after which the image is stale", default=0.5
    )
    lost_after: float = setting(
        _AGE, "time without a new pose after which the probe is lost", default=2.0
    )
    overlay: str = setting(
        description="colours over the annotated image, if the scene has their source",
        choices=(*OVERLAYS, "none"),
        default="none",
    )
    flip: bool = setting(
        description="exchange left and right in the annotated image and on the page: the probe's "
        "mark is then at the right",
        default=False,
    )
    beside: bool = setting(
        description="show the plain image of the same moment at the left of the annotated one",
        default=False,
    )


RECORDER, VIEWER = "session_recorder", "viewer"
PLAYERS = ("path_player", "session_player")  # of recordings
_SPEED = Quantity("number", 0.01, 100.0)
_SPAN = Quantity("time", 0.0, 1e6)
NOT_THE_SESSION = ("/rosout", "/parameter_events")  # topics that are not recorded
SHARED = ("/tf", "/tf_static")  # topics that are recorded outside the recorder's namespace, too
OF_SIMULATORS = tuple(f"/{topic.name}" for topic in TOPICS if not topic.is_from_drivers)
"""Ends of names of topics that only a simulator publishes, in whichever namespace it is."""


@dataclass(frozen=True)
class PlayerSettings(Settings):
    """Parameters of players: what ``ros2 bag play`` has under the same names, and more."""

    path: str | None = setting(
        description="bag to play; `path_player` takes tracker recordings, too",
        default=None,
        file=True,
    )
    rate: float = setting(_SPEED, "speed factor", default=1.0, live=True)
    loop: bool = setting(description="start again at the end", default=False, live=True)
    paused: bool = setting(
        description="hold the probe, and publish nothing else; not in lockstep",
        default=False,
        live=True,
    )
    time: float = setting(_SPAN, "from the start: setting it jumps there", default=0.0, live=True)
    clock: float = setting(
        Quantity("frequency", 0.0, 1000.0),
        "rate of the recording's time on `/clock`; poses are then stamped with it; 0: no `/clock`",
        default=0.0,
    )
    stay: bool = setting(
        description="at the end, hold the probe until `time` is set; else the node ends",
        default=False,
    )


@dataclass(frozen=True)
class PathPlayerSettings(PlayerSettings):
    """Parameters of ``path_player``."""

    topic: str | None = setting(
        description="of the poses in the bag; not given: the only PoseStamped topic", default=None
    )
    lockstep: bool = setting(
        description="send each pose after the image of the one before", default=False
    )
    await_topics: tuple[str, ...] = setting(
        description="topics: begin when each has a publisher", default=()
    )
    await_recorded: tuple[str, ...] = setting(
        description="topics: begin when session_recorder subscribes to each", default=()
    )
    begun: float = setting(
        Quantity("time", 0.0, 1e10),
        "time of the first pose since 1970, to play on where the path would be by now; 0: from the "
        "start",
        default=0.0,
    )


@dataclass(frozen=True)
class SessionPlayerSettings(PlayerSettings):
    """Parameters of ``session_player``."""

    exclude: tuple[str, ...] = setting(description="topics to leave out", default=())


@dataclass(frozen=True)
class SessionRecorderSettings(Settings):
    """Parameters of ``session_recorder``."""

    file: str = setting(
        description="MCAP file to write, or a new folder for a bag", default="session.mcap"
    )
    if_exists: str = setting(
        description="if a recording of that name exists: refuse to start, or go on in a further "
        "file beside it",
        choices=("refuse", "further"),
        default="refuse",
    )
    compression: str = setting(
        description="of the file's chunks", choices=("none", "zstd"), default="none"
    )
    topics: tuple[str, ...] = setting(
        description="to record, by names in this namespace or from `/`; none: all of the "
        "namespace except those on demand and those of other simulators",
        default=(),
    )
    also: tuple[str, ...] = setting(
        description="more topics to record: those on demand, such as tissue/structures, or outside "
        "the namespace",
        default=(),
    )
    exclude: tuple[str, ...] = setting(description="topics to leave out", default=())
    max_cache_size: int = setting(
        Quantity("number", 0, 2**53),
        "bytes of messages that may wait for the disk; 0: publishers in this process wait",
        default=100 * 1024 * 1024,
    )
    paused: bool = setting(
        description="record nothing, but keep the newest latched messages until it goes on",
        default=False,
        live=True,
    )
    scene: str | None = setting(
        description="recorded scene, to attach with the files that it names",
        default=None,
    )
    volume: str | None = setting(
        description="volume file in place of the scene's", default=None, file=True
    )
    path: str | None = setting(
        description="bag or tracker recording played in place of the scene's path",
        default=None,
        file=True,
    )
    parameters: str = setting(
        description="of all nodes, as YAML, to attach as parameters.yaml", default=""
    )
    attach: tuple[str, ...] = setting(description="more files to attach", default=())

    def records_topic(self, topic: str, namespace: str = "/") -> bool:
        """Return whether a recorder in this namespace records a topic of that full name.

        It records topics of another simulator, and those made on demand, only by name.
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


@dataclass(frozen=True)
class SessionControlSettings(Settings):
    """Parameters of ``session_control``."""

    live = True

    scene: str = setting(
        description="scene file, name of an installed one, or `case:NAME`; each setting, also of "
        "the same text, loads it",
        default="upper_arm",
    )
    volume: str | None = setting(
        description="volume file in place of the scene's; only for the scene set with it",
        default=None,
    )
    record: str | None = setting(
        description="new MCAP file to record to; none ends the recording", default=None
    )
    replay: str | None = setting(
        description="bag to play; setting the same again plays from the start; none ends it",
        default=None,
    )
    replay_as: str = setting(
        description="path: the probe moves as recorded; recording: all recorded topics replace "
        "the simulation, which goes on afterwards",
        choices=("path", "recording"),
        default="path",
    )
    replay_rate: float = setting(_SPEED, "speed factor", default=1.0)
    replay_loop: bool = setting(description="start again at the end", default=False)
    replay_paused: bool = setting(description="hold the replay", default=False)
    replay_time: float = setting(_SPAN, "from the start: setting it jumps there", default=0.0)


_MARKERS = Quantity("frequency", 0.1, 1000.0)


@dataclass(frozen=True)
class SceneNodeSettings(Settings):
    """Parameters of every node that works on a scene."""

    scene: str = setting(description="scene file, or name of an installed one", default="upper_arm")
    volume: str | None = setting(
        description="volume file in place of the scene's", default=None, file=True
    )
    lockstep: bool = setting(
        description="work on every message, in order, instead of the newest", default=False
    )
    threads: int = setting(Quantity("number", 1, 256), "of numerical work", default=1)
    realtime: bool = setting(
        description="priority over ordinary programs, if the system allows it; not in lockstep",
        default=True,
    )


@dataclass(frozen=True)
class ProbeTrackerSettings(Settings):
    """Parameters of ``probe_tracker``."""

    source: str | None = setting(
        description="replaces tracker.source of the scene", choice=TRACKERS, default=None
    )
    filter: str = setting(
        description="of the poses; replaces tracker.filter.method of the scene",
        choice=FILTERS,
        default="none",
        live=True,
    )


@dataclass(frozen=True)
class TissueDeformerSettings(Settings):
    """Parameters of ``tissue_deformer``."""

    live = True

    solver: str = setting(
        description="method that deforms the tissue", choice=SOLVERS, default="fem"
    )
    compare_with: str | None = setting(
        description="second method, which runs on the same poses",
        choice=SOLVERS,
        default=None,
    )

    def check(self) -> None:
        """Require two different methods."""
        if self.compare_with == self.solver:
            raise self.make_error(
                "compare_with", f"{self.solver} is in use already: compare with another solver"
            )


@dataclass(frozen=True)
class StructureMarkersSettings(Settings):
    """Parameters of ``tissue_deformer`` where the scene has structures."""

    marker_rate: float = setting(
        _MARKERS, "highest rate of the structures' markers", default=20.0, live=True
    )
    structure_triangles: int = setting(
        Quantity("number", 100, 10_000_000),
        "approximate number for all structures around labels",
        default=40_000,
    )


@dataclass(frozen=True)
class SkinDeformerSettings(Settings):
    """Parameters of ``skin_deformer``."""

    marker_rate: float = setting(_MARKERS, "highest rate of markers", default=20.0, live=True)
    marker_opacity: float = setting(
        Quantity("number", 0.0, 1.0),
        "of the skin's markers; 1 hides what lies below",
        default=0.6,
        live=True,
    )


@dataclass(frozen=True)
class ImageWriterSettings(Settings):
    """Parameters of ``image_writer``."""

    folder: str = setting(description="for the PNG files", default="images")
    labels: str | None = setting(
        description="folder for the labels of each image, as PNG files; none: not written",
        default=None,
    )
    displacement: str | None = setting(
        description="folder for the tissue's displacement in each image, as NumPy's .npy files of "
        "rows, columns, and 2 (lateral and axial, m); none: not written",
        default=None,
    )


@dataclass(frozen=True)
class CameraDriverSettings(Settings):
    """Parameters of ``camera_driver``."""

    source: str = setting(
        description="camera's number, a stream's address or a video file", default="0"
    )
    camera_info: str | None = setting(
        description="file of `us-sim calibrate camera`", default=None, file=True
    )
    frame_id: str = setting(description="frame of the images", default="camera_optical")
    encoding: str = setting(description="of the images", choices=("mono8", "bgr8"), default="mono8")
    rate: float = setting(
        Quantity("frequency", 0.0, 1e3),
        "of images, for a camera or instead of a file's own; 0: as it is",
        default=0.0,
    )
    loop: bool = setting(description="start a file again at its end", default=False)
    latency: float = setting(
        Quantity("time", -1.0, 10.0),
        "from the middle of the exposure to the image's arrival",
        default=0.0,
    )


@dataclass(frozen=True)
class SpaceMouseDriverSettings(Settings):
    """Parameters of ``space_mouse_driver``."""

    frame_id: str = setting(description="frame of the messages", default="spacenav")
    rate: float = setting(
        Quantity("frequency", 1.0, 1000.0), "messages while nothing changes", default=100.0
    )


@dataclass(frozen=True)
class OpenIGTLinkBridgeSettings(Settings):
    """Parameters of ``openigtlink_bridge``."""

    host: str | None = setting(
        description="address to listen at; none: all of this computer's", default="localhost"
    )
    port: int = setting(
        Quantity("number", 0, 65535), "TCP port; 0 is any that is free", default=18944
    )
    reference: str = setting(
        description="frame of the images: the volume file's own, or patient",
        choices=("volume", "patient"),
        default="volume",
    )


@dataclass(frozen=True)
class ScorerSettings(Settings):
    """Parameters of ``scorer``."""

    exercise: str | None = setting(
        description="file of an exercise, or name of an installed one, in place of the scene's",
        default=None,
    )
    student: str = setting(description="name that results bear", default="")
    results: str | None = setting(
        description="folder, or address of fsspec, for each result", default=None
    )
    chosen: tuple[str, ...] = setting(description="settings that results shall tell", default=())
    answers: tuple[str, ...] = setting(
        description="of the student, if the exercise asks, for each point: compressible, not "
        "compressible, not seen, or - for none yet",
        default=(),
        live=True,
    )
    thrombus: str = setting(
        description="the student's answer: the number of a point at it, or none; empty for no "
        "answer yet",
        default="",
        live=True,
    )
    begun: float = setting(
        Quantity("time", 0.0, 1e10),
        "start (since 1970) of the attempt that a killed scorer lost, now void; 0: none",
        default=0.0,
    )


NODES: dict[str, tuple[type[Settings], ...]] = {
    "probe_tracker": (SceneNodeSettings, ProbeTrackerSettings),
    "tissue_deformer": (SceneNodeSettings, TissueDeformerSettings, StructureMarkersSettings),
    "skin_deformer": (SceneNodeSettings, SkinDeformerSettings),
    "slice_interpolator": (SceneNodeSettings, AnnotatedImageSettings, Imaging),
    "haptic_renderer": (SceneNodeSettings,),
    "scorer": (SceneNodeSettings, ScorerSettings, ScoreSettings),
    "openigtlink_bridge": (SceneNodeSettings, OpenIGTLinkBridgeSettings),
    "path_player": (PathPlayerSettings,),
    "session_player": (SessionPlayerSettings,),
    "session_recorder": (SessionRecorderSettings,),
    "session_control": (SessionControlSettings,),
    "camera_driver": (CameraDriverSettings,),
    "space_mouse_driver": (SpaceMouseDriverSettings,),
    "probe_robot": (RobotSettings,),
    "image_writer": (ImageWriterSettings,),
    "viewer": (ViewerSettings,),
}
"""Settings that are parameters of a node; `parameters_of` adds those of parts of its scene."""

RCLPY_PARAMETERS = ("use_sim_time", "qos_overrides.", "start_type_description_service")
"""Parameters that rclpy itself declares, or prefixes of them."""


def is_live(settings: type[Settings], name: str) -> bool:
    """Return whether a setting may change while the node runs."""
    return settings.live or rules_of(settings)[name].live


def parameters_of(node: str, scene: Scene | None = None) -> Iterator[tuple[str, type[Settings]]]:
    """Yield the settings that are parameters of a node, each with the prefix of their names.

    Parts of the scene that it works on have parameters, too.
    """
    for settings in NODES[node]:
        yield "", settings
    if node == "probe_tracker":
        for name in FILTERS:
            if rules_of(FILTERS.load_settings(name)):
                yield f"{name}.", FILTERS.load_settings(name)
    if node == "skin_deformer":
        yield "membrane.", MembraneSettings
    if node == "slice_interpolator" and scene is not None:
        yield from _imaging_parameters(scene)
    if node == "tissue_deformer" and scene is not None and scene.tissue is not None:
        for solver in SOLVERS.importable:
            yield f"{solver}.", SOLVERS.load_settings(solver)
        for label, material in scene.tissue.materials.items():
            yield f"materials.{label}.", type(material)


def _imaging_parameters(scene: Scene) -> Iterator[tuple[str, type[Settings]]]:
    yield "", type(build_probe(scene))
    yield "acoustics.", SoundSettings
    for label in scene.imaging.acoustics.tissues:
        yield f"{TISSUE_PARAMETERS}{label}.", TissueAcoustics
    yield "m_mode.", type(scene.m_mode)
    if scene.tissue is not None:
        yield "strain.", type(scene.strain)
    if scene.flows:
        yield "colour.", type(scene.colour)
        yield "spectrum.", type(scene.spectrum)
    for name, flow in scene.flows.items():
        yield f"flow.{name}.", type(flow)


def check_parameters(node: str, scene: Scene | None, given: Mapping[str, str]) -> dict[str, object]:
    """Convert a person's YAML texts, by name, to values of a node's parameters in SI units.

    Raises:
        UsSimError: there is no such parameter, or its value is refused.
    """
    if not given:
        return {}
    known: dict[str, tuple[type[Settings], str]] = {}
    for prefix, settings in parameters_of(node, scene):
        of_probe = settings not in NODES[node] and not prefix
        for name in rules_of(settings):
            if not of_probe or is_live(settings, name):
                known.setdefault(prefix + name, (settings, name))
    return {name: _checked(node, name, text, known) for name, text in given.items()}


def _checked(
    node: str, name: str, text: str, known: Mapping[str, tuple[type[Settings], str]]
) -> object:
    option = f"--param {node}.{name}"
    if name not in known and not name.startswith(RCLPY_PARAMETERS):
        raise UsSimError(
            f"{option}: {describe_unknown(name, known)} (`us-sim reference {node}` says more)"
        )
    try:
        value = load_yaml(text)
    except YamlError as error:
        raise UsSimError(f"{option}={text[:80]}: {error}") from error
    if name not in known:
        return value
    settings, field = known[name]
    kind = kinds_of(settings)[field]
    try:
        made = convert_value(kind, to_setting_value(kind, value), rules_of(settings)[field])
    except RefusedValueError as refusal:
        raise UsSimError(f"{option}: {refusal}") from refusal
    return to_parameter_value(kind, made)


def to_setting_value(kind: Any, raw: Any) -> Any:
    """Convert a parameter's value to that of a setting of this type."""
    if kind is str and isinstance(raw, int | float):
        return str(raw)  # a camera's number, say
    is_list = not isinstance(raw, str) and hasattr(raw, "__iter__")
    if may_be_none(kind) and not (any(raw) if is_list else raw):
        return None
    if get_origin(kind) is tuple and get_args(kind)[0] is str:
        return tuple(text for text in raw or () if text)
    return raw


def to_parameter_value(kind: Any, value: Any) -> Any:
    """Convert the value of a setting of this type to that of a parameter.

    ROS has no parameter without a value: a number that is not given is 0, a text empty, and a list
    has one zero or empty text, since an empty list has no type.
    """
    lists = [each for each in (kind, *get_args(kind)) if get_origin(each) is tuple]
    if lists:
        return list(value or ()) or ([""] if get_args(lists[0])[0] is str else [0.0])
    if value is not None:
        return value
    return next({int: 0, float: 0.0}.get(each, "") for each in get_args(kind))


def may_be_none(kind: Any) -> bool:
    """Return whether a setting of this type need not be given."""
    return type(None) in get_args(kind)
