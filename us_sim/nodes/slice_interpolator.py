"""Imaging of the deformed tissue in the probe's plane."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray, Int32MultiArray

from us_sim.geometry.pose import Pose
from us_sim.nodes.guarded_node import keep_newest
from us_sim.nodes.messages import affine_message
from us_sim.nodes.parameters import LiveSettings
from us_sim.nodes.process import node_main
from us_sim.nodes.qos import LATCHED
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.settings import is_live
from us_sim.nodes.streams import create_frame_streams
from us_sim.nodes.streams.annotated_image import AnnotatedImage
from us_sim.recording.decoding import nanoseconds_of, pose_from, tetrahedra_from, vectors_from
from us_sim.scene.building import build_probe, build_scanner, load_skin_surface, load_volume
from us_sim.settings.setting import rules_of
from us_sim.slicing.acoustics.settings import Acoustics, SoundSettings
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import TISSUE_PARAMETERS, Imaging

_BEYOND = 1e-3  # m, by which an image may be too deep without a report
_NONE, _POOR = 0.02, 0.5  # coupling, averaged over the face, below which contact is none or poor
_SEEN = ("contact", "no_colour", "no_spectrum")
"""Diagnostics that are sent at once when they change: the reasons of an empty image."""
REST, TETRAHEDRA = "tissue/rest", "tissue/tetrahedra"
REMEMBERED = 256  # poses kept for the deformed nodes that carry their stamps
SKINS_REMEMBERED = 64


def _collect_console(values: dict[str, Any]) -> tuple[Probe, Imaging, Acoustics]:
    tissues = {
        key.removeprefix(TISSUE_PARAMETERS)[:-1]: value
        for key, value in values.items()
        if key.startswith(TISSUE_PARAMETERS)
    }
    acoustics = dataclasses.replace(values["acoustics."], tissues=tissues)
    return values["probe"], values["imaging"], acoustics


class SliceInterpolator(SceneNode):
    """``probe/pose`` and, with tissue, ``tissue/nodes`` in; ``ultrasound/image`` out.

    With tissue an image is made for every set of nodes, at the pose with the same stamp; without,
    for every pose, through the volume as it is. ``ultrasound/image_to_probe``, latched, is the map
    of its pixels. ``ultrasound/image_annotated``, see `AnnotatedImage`, and the topics of
    `create_frame_streams` are made of the same frame for their subscribers. The sonographer's
    settings are parameters.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("slice_interpolator", **kwargs)
        # Before the volume, which may take a minute to make.
        console = self._declare_console()
        probe, imaging, acoustics = _collect_console(console.values)
        volume = load_volume(self.scene)
        self._scanner = build_scanner(self.scene, volume, threads=self.threads)
        self.get_logger().info(f"preparing {self.scene.slice.name} on {self.scene.volume.name}")
        self._scanner.prepare_settings(probe, imaging, acoustics)
        self._scanner.apply_settings(probe, imaging, acoustics)
        self._mesh: dict[str, Any] = {}  # messages by topic
        self._has_mesh = False
        self._poses: dict[int, Pose] = {}
        self._has_warned = False  # that the image is too deep
        self._seen: dict[str, str] = {}  # `_SEEN` in the diagnostics that were sent
        self._number = 0  # of the frame
        self._unpaired: PointCloud2 | None = None
        self._skins: dict[int, NDArray[np.float64]] | None = None  # (V, 3) m, by stamps
        self._streams = create_frame_streams(self, volume, probe)
        self._places = self.create_latched_publisher(Float64MultiArray, "ultrasound/image_to_probe")
        self._places.publish(affine_message(probe.image_to_probe))
        self._annotated = AnnotatedImage(self, probe, volume.label_names, self._streams)
        if self.scene.tissue is None:
            self.subscribe(PoseStamped, "probe/pose", self._on_rigid_pose, newest=True)
        else:
            for kind, topic in ((PointCloud2, REST), (Int32MultiArray, TETRAHEDRA)):
                self.subscribe(kind, topic, partial(self._on_mesh, topic), LATCHED)
            if self.scene.skin is not None and imaging.contact:
                surface = load_skin_surface(self.scene)
                self._scanner.attach_skin(surface.vertices, surface.triangles)
                self._skins, self._vertices = {}, len(surface.vertices)
                self.subscribe(PointCloud2, "skin/nodes", self._on_skin)
            self.subscribe(PoseStamped, "probe/pose", self._on_pose)
            self.subscribe(PointCloud2, "tissue/nodes", self._on_nodes, newest=True)
        self.health.state = "ready"
        self.get_logger().info("ready")

    def _declare_console(self) -> LiveSettings:
        """Declare the sonographer's settings: of probe, image and sound, also by tissue."""
        probe, imaging = build_probe(self.scene), self.scene.imaging
        tissues = imaging.acoustics.tissues.items()
        return LiveSettings(
            self,
            {"probe": probe, "imaging": imaging, "acoustics.": imaging.acoustics}
            | {f"{TISSUE_PARAMETERS}{label}.": tissue for label, tissue in tissues},
            check=lambda to: self._prepare(*_collect_console(to)),
            use=lambda to: self._apply_settings(*_collect_console(to)),
            names={
                "probe": [name for name in rules_of(type(probe)) if is_live(type(probe), name)],
                "imaging": rules_of(Imaging),
                "acoustics.": rules_of(SoundSettings),
            },
        )

    def _prepare(self, probe: Probe, imaging: Imaging, acoustics: Acoustics) -> None:
        self._scanner.prepare_settings(probe, imaging, acoustics)
        for stream in self._streams:
            stream.prepare(probe)

    def _apply_settings(self, probe: Probe, imaging: Imaging, acoustics: Acoustics) -> None:
        changed = probe != self._scanner.probe
        self._scanner.apply_settings(probe, imaging, acoustics)
        if changed:
            self._has_warned = False
            self._places.publish(affine_message(probe.image_to_probe))
            self._annotated.change_probe(probe)

    def _on_mesh(self, topic: str, message: PointCloud2 | Int32MultiArray) -> None:
        self._mesh[topic] = message
        if len(self._mesh) == 2:
            nodes = vectors_from(self._mesh[REST], "patient")
            self._scanner.attach_mesh(nodes, tetrahedra_from(self._mesh[TETRAHEDRA]))
            self._has_mesh = True

    def _on_pose(self, message: PoseStamped) -> None:
        pose = self._pose(message)
        keep_newest(self._poses, nanoseconds_of(message.header.stamp), pose, REMEMBERED)
        self._image_unpaired()

    def _on_skin(self, message: PointCloud2) -> None:
        vertices = vectors_from(message, "patient")
        if len(vertices) != self._vertices:
            self.health.count_problem(
                "skin",
                f"skin/nodes has {len(vertices)} vertices, and the scene's skin {self._vertices}: "
                f"contact is with the tissue; start both with the same scene",
            )
        elif self._skins is not None:
            stamp = nanoseconds_of(message.header.stamp)
            keep_newest(self._skins, stamp, vertices, SKINS_REMEMBERED)
            if self.lockstep:
                self._image_unpaired()

    def _pose(self, message: PoseStamped) -> Pose:
        pose = pose_from(message, "patient")
        self._annotated.on_usable_pose()
        return pose

    def _image_unpaired(self) -> None:
        """Make the image of waiting nodes if their pose has come."""
        nodes = self._unpaired
        if nodes is not None and nanoseconds_of(nodes.header.stamp) in self._poses:
            self._on_nodes(nodes)

    def _on_nodes(self, message: PointCloud2) -> None:
        stamp = nanoseconds_of(message.header.stamp)
        pose = self._poses.get(stamp)
        # Live, the skin nearly always comes before the tissue, and is not waited for.
        has_skin = self._skins is None or not self.lockstep or stamp in self._skins
        if pose is None or not self._has_mesh or not has_skin:
            self._unpaired = message
            return
        self._unpaired = None
        self._publish_image(message, pose, message)

    def _on_rigid_pose(self, message: PoseStamped) -> None:
        self._publish_image(message, self._pose(message), None)

    def _publish_image(
        self, source: PoseStamped | PointCloud2, pose: Pose, tissue: PointCloud2 | None
    ) -> None:
        self._number += 1
        wanted = [stream for stream in self._streams if stream.is_wanted]
        if not (wanted or self._annotated.is_wanted):
            return
        stamp = source.header.stamp
        nodes = None if tissue is None else vectors_from(tissue, "patient")
        time = nanoseconds_of(stamp)
        skin = None if self._skins is None else self._skins.get(time)
        frame = self._scanner.make_frame(
            pose, nodes, skin=skin, number=self._number, time=1e-9 * time
        )
        self.health.values = self._report_reach(pose)  # what streams say of this frame comes on top
        for stream in wanted:
            stream.publish_frame(frame, stamp)
        self._annotated.publish_frame(frame, stamp)
        self.health.state = "imaging"
        self.health.values |= {
            "probe_pose": self._annotated.state,
            "skipped_tetrahedra": str(self._scanner.skipped),
            **_contact(frame),
        }
        seen = {key: self.health.values.get(key, "") for key in _SEEN}
        if seen != self._seen:
            self._seen = seen
            self.health.publish_report()

    def _report_reach(self, pose: Pose) -> dict[str, str]:
        """Return, for diagnostics, how far the image reaches beyond the tissue or volume.

        Warn once if it does so without a press, too, so that a smaller depth helps.
        """
        scanner = self._scanner
        too_deep = scanner.measure_excess_depth(pose)
        if too_deep < _BEYOND:
            return {}
        if not self._has_warned and scanner.measure_excess_depth(pose, pressed=False) >= _BEYOND:
            self._has_warned = True
            what = "tissue's mesh" if self.scene.tissue is not None else "volume"
            self.get_logger().warning(
                f"the image reaches {1e3 * too_deep:.0f} mm beyond the {what}: what lies there is "
                f"shown as it is without tissue, and black beyond the volume; set a smaller depth"
            )
        return {"beyond_mm": f"{1e3 * too_deep:.0f}"}


def _contact(frame: Frame) -> dict[str, str]:
    if frame.contact is None:
        return {}
    coupling = float(frame.contact[0].mean())
    word = "none" if coupling < _NONE else "poor" if coupling < _POOR else "good"
    return {"contact": word, "coupling": f"{coupling:.2f}"}


main = node_main(SliceInterpolator, __name__)
