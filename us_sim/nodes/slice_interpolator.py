"""Makes the B-mode image at the probe's plane through the deformed tissue."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64MultiArray, Int32MultiArray

from us_sim.geometry.pose import Pose
from us_sim.nodes.messages import affine_message
from us_sim.nodes.parameters import Group, LiveSettings
from us_sim.nodes.process import run_node
from us_sim.nodes.qos import LATCHED
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.settings import is_live
from us_sim.nodes.streams import frame_streams
from us_sim.nodes.streams.annotated_image import AnnotatedImage
from us_sim.recording.decoding import nanoseconds_of, pose_from, tetrahedra_from, vectors_from
from us_sim.scene.building import probe_of, scanner_of, skin_surface_of, volume_of
from us_sim.settings.setting import rules_of
from us_sim.slicing.acoustics.settings import Acoustics, SoundSettings
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import TISSUE_PARAMETERS, Imaging

Console = Callable[[Probe, Imaging, Acoustics], None]


class ScannerConsole:
    """The probe's live settings, those of image formation, and those of sound, also by tissue.

    Args:
        node: that gets the parameters.
        prepare: called with them before a change is taken; what it raises refuses it.
        use: called with them when parameters have been set.
    """

    def __init__(self, node: SceneNode, prepare: Console, use: Console) -> None:
        probe, imaging = probe_of(node.scene), node.scene.imaging
        live = [name for name in rules_of(type(probe)) if is_live(type(probe), name)]
        groups = {
            "probe": Group(probe, names=live),
            "imaging": Group(imaging, names=rules_of(Imaging)),
            "acoustics": Group(imaging.acoustics, "acoustics.", rules_of(SoundSettings)),
        }
        for label, tissue in imaging.acoustics.tissues.items():
            prefix = f"{TISSUE_PARAMETERS}{label}."
            groups[prefix] = Group(tissue, prefix)
        console = LiveSettings(
            node, groups, lambda to: prepare(*_together(to)), lambda to: use(*_together(to))
        )
        self.values = _together(console.values)


def _together(values: dict[str, Any]) -> tuple[Probe, Imaging, Acoustics]:
    tissues = {
        key.removeprefix(TISSUE_PARAMETERS)[:-1]: value
        for key, value in values.items()
        if key.startswith(TISSUE_PARAMETERS)
    }
    acoustics = dataclasses.replace(values["acoustics"], tissues=tissues)
    return values["probe"], values["imaging"], acoustics


SKINS_REMEMBERED = 64


class SkinShapes:
    """``skin/nodes``, by their stamps.

    Live, an image does not wait for the skin, which is there before the tissue all but always; in
    lockstep it does, so that it is the same every time.

    Args:
        node: that makes the images.
        scanner: is told of the skin at rest.
        came: called when there is skin for a pose, in lockstep.
    """

    def __init__(self, node: SceneNode, scanner: BMode, came: Callable[[], None]) -> None:
        surface = skin_surface_of(node.scene)
        scanner.touch(surface.vertices, surface.triangles)
        self._node, self._came = node, came
        self._shape = surface.vertices.shape
        self._shapes: dict[int, NDArray[np.float64]] = {}
        node.listen(PointCloud2, "skin/nodes", self._take)

    def at(self, stamp: int) -> NDArray[np.float64] | None:
        """(V, 3) m, of a pose's stamp (ns); None where it has not come."""
        return self._shapes.get(stamp)

    def is_awaited(self, stamp: int) -> bool:
        """Whether an image of that stamp has to wait."""
        return self._node.lockstep and stamp not in self._shapes

    def _take(self, message: PointCloud2) -> None:
        vertices = vectors_from(message, "patient")
        if vertices.shape != self._shape:
            self._node.health.problem(
                "skin",
                f"skin/nodes has {len(vertices)} vertices, and the scene's skin {self._shape[0]}: "
                f"contact is with the tissue; start both with the same scene",
            )
            return
        self._shapes[nanoseconds_of(message.header.stamp)] = vertices
        while len(self._shapes) > SKINS_REMEMBERED:
            del self._shapes[next(iter(self._shapes))]
        if self._node.lockstep:
            self._came()


_BEYOND = 1e-3  # m, by which an image may be too deep before that is said

_NONE, _POOR = 0.02, 0.5  # coupling, averaged over the face, below which contact is none or poor
_SEEN = ("contact", "no_colour", "no_spectrum")
"""Diagnostics that are sent at once when they change: they say why an image shows nothing."""

REMEMBERED = 256  # poses kept for the deformed nodes that carry their stamps


class SliceInterpolator(SceneNode):
    """``probe/pose`` and, with tissue, ``tissue/nodes`` in; ``ultrasound/image`` out.

    With tissue an image is made for every set of nodes, at the pose with the same stamp; without,
    for every pose, through the volume as it is. ``ultrasound/image_to_probe``, latched, says where
    its pixels are. ``ultrasound/image_annotated`` is for the eye, see `AnnotatedImage`, and
    `frame_streams` are further topics, each made of the same frame for those who subscribe. What a
    sonographer sets are parameters, see `ScannerConsole`.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("slice_interpolator", **kwargs)
        # Before the volume, which may take a minute to make.
        probe, imaging, acoustics = ScannerConsole(self, self._prepare, self._use).values
        volume = volume_of(self.scene)
        self._scanner = scanner_of(self.scene, volume, threads=self.threads)
        self.get_logger().info(f"preparing {self.scene.slice.name} on {self.scene.volume.name}")
        self._scanner.prepare(probe, imaging, acoustics)
        self._scanner.use(probe, imaging, acoustics)
        self._rest: Any = None
        self._tetrahedra: Any = None
        self._carried = False
        self._poses: dict[int, Pose] = {}
        self._is_said = False  # that the image is too deep
        self._seen: dict[str, str] = {}  # `_SEEN` in the diagnostics that were sent
        self._number = 0  # of what images are made from
        self._unpaired: PointCloud2 | None = None
        self._skin: SkinShapes | None = None
        self._streams = frame_streams(self, volume, probe)
        self._places = self.latched(Float64MultiArray, "ultrasound/image_to_probe")
        self._places.publish(affine_message(probe.image_to_probe))
        self._annotated = AnnotatedImage(self, probe, volume.label_names, self._streams)
        if self.scene.tissue is None:
            self.newest(PoseStamped, "probe/pose", self._image_rigid)
        else:
            self.listen(PointCloud2, "tissue/rest", self._take_rest, LATCHED)
            self.listen(Int32MultiArray, "tissue/tetrahedra", self._take_tetrahedra, LATCHED)
            if self.scene.skin is not None and imaging.contact:
                self._skin = SkinShapes(self, self._scanner, self._image_unpaired)
            self.listen(PoseStamped, "probe/pose", self._remember)
            self.newest(PointCloud2, "tissue/nodes", self._image_deformed)
        self.health.state = "ready"
        self.get_logger().info("ready")

    def _prepare(self, probe: Probe, imaging: Imaging, acoustics: Acoustics) -> None:
        self._scanner.prepare(probe, imaging, acoustics)
        for stream in self._streams:
            stream.prepare(probe)

    def _use(self, probe: Probe, imaging: Imaging, acoustics: Acoustics) -> None:
        changed = probe != self._scanner.probe
        self._scanner.use(probe, imaging, acoustics)
        if changed:
            self._is_said = False
            self._places.publish(affine_message(probe.image_to_probe))
            self._annotated.show_probe(probe)

    def _take_rest(self, message: PointCloud2) -> None:
        self._rest = message
        self._take_mesh()

    def _take_tetrahedra(self, message: Int32MultiArray) -> None:
        self._tetrahedra = message
        self._take_mesh()

    def _take_mesh(self) -> None:
        if self._rest is None or self._tetrahedra is None:
            return
        nodes = vectors_from(self._rest, "patient")
        self._scanner.carry(nodes, tetrahedra_from(self._tetrahedra))
        self._carried = True

    def _remember(self, message: PoseStamped) -> None:
        self._poses[_nanoseconds(message)] = self._pose(message)
        while len(self._poses) > REMEMBERED:
            del self._poses[next(iter(self._poses))]
        self._image_unpaired()

    def _pose(self, message: PoseStamped) -> Pose:
        pose = pose_from(message, "patient")
        self._annotated.pose_came(message.header.stamp)
        return pose

    def _image_unpaired(self) -> None:
        """Make the image whose other half may have come."""
        if self._unpaired is not None and _nanoseconds(self._unpaired) in self._poses:
            self._image_deformed(self._unpaired)

    def _image_deformed(self, message: PointCloud2) -> None:
        stamp = _nanoseconds(message)
        pose = self._poses.get(stamp)
        awaited = self._skin is not None and self._skin.is_awaited(stamp)
        if pose is None or not self._carried or awaited:
            self._unpaired = message
            return
        self._unpaired = None
        self._image(message, pose, message)

    def _image_rigid(self, message: PoseStamped) -> None:
        self._image(message, self._pose(message), None)

    def _image(
        self, source: PoseStamped | PointCloud2, pose: Pose, tissue: PointCloud2 | None
    ) -> None:
        self._number += 1
        wanted = [stream for stream in self._streams if stream.is_wanted]
        if not (wanted or self._annotated.is_wanted):
            return
        stamp = source.header.stamp
        nodes = None if tissue is None else vectors_from(tissue, "patient")
        came = nanoseconds_of(stamp)
        skin = None if self._skin is None else self._skin.at(came)
        frame = self._scanner.frame(pose, nodes, skin=skin, number=self._number, time=1e-9 * came)
        self.health.values = self._reach(pose)  # what streams say of this frame comes on top
        for stream in wanted:
            stream.show(frame, stamp)
        self._annotated.show(frame, stamp)
        self.health.state = "imaging"
        self.health.values |= {
            "probe_pose": self._annotated.state,
            "skipped_tetrahedra": str(self._scanner.skipped),
            **_contact(frame),
        }
        seen = {key: self.health.values.get(key, "") for key in _SEEN}
        if seen != self._seen:
            self._seen = seen
            self.health.report()

    def _reach(self, pose: Pose) -> dict[str, str]:
        """Report in diagnostics that the image ends beyond the tissue or volume.

        It is said once where not only the press makes it do so, so that a smaller depth helps.
        """
        too_deep = self._scanner.beyond(pose)
        if too_deep < _BEYOND:
            return {}
        if not self._is_said and self._scanner.beyond(pose, pressed=False) >= _BEYOND:
            self._is_said = True
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


def _nanoseconds(message: PoseStamped | PointCloud2) -> int:
    return nanoseconds_of(message.header.stamp)


main = partial(run_node, SliceInterpolator)


if __name__ == "__main__":
    sys.exit(main())
