"""The topics of the graph, without any ROS: contents, publishers and subscribers of each.

>>> from us_sim.nodes.topics import TOPICS
>>> [topic.name for topic in TOPICS if topic.latched and "slice_interpolator" in topic.publishers]
['ultrasound/image_to_probe']
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Topic:
    """One topic, by its name in the simulator's namespace."""

    name: str
    type_name: str  # package and message: geometry_msgs/PoseStamped
    description: str  # for a person
    publishers: tuple[str, ...] = ()  # nodes of this package; none where a driver publishes it
    subscribers: tuple[str, ...] = ()
    latched: bool = False  # kept for those who come later, else of each moment
    on_demand: bool = False  # not recorded, and so not computed, unless the recorder names it

    @property
    def from_drivers(self) -> bool:
        """Whether it comes from outside this package, or from a node in place of a driver."""
        stand_ins = {"path_player", "camera_driver", "space_mouse_driver", "probe_robot", "viewer"}
        return set(self.publishers) <= stand_ins


def _topic(entry: str) -> Topic:
    """A topic from its entry below: ``name: type [flag]``, ``publishers -> subscribers | text``."""
    head, _, body = entry.partition("\n")
    name, _, kind = head.partition(": ")
    type_name, _, flags = kind.partition(" ")
    nodes, _, description = " ".join(body.split()).partition(" | ")
    publishers, _, subscribers = nodes.partition(" -> ")
    return Topic(
        name,
        type_name,
        description,
        () if publishers == "drivers" else tuple(publishers.split(", ")),
        tuple(filter(None, subscribers.split(", "))),
        latched="[latched]" in flags,
        on_demand="[on_demand]" in flags,
    )


_TABLE = """
tracker/pose: geometry_msgs/PoseStamped
    path_player, probe_robot, viewer -> probe_tracker | the tracked body in the device's frame,
    stamped when it was measured; source `pose`
tracker/poses: geometry_msgs/PoseArray
    drivers -> probe_tracker | several bodies at once; source `pose_array`
tf: tf2_msgs/TFMessage
    probe_tracker -> probe_tracker | published: the probe in `patient`, if somebody subscribes;
    heard: source `tf`
tf_static: tf2_msgs/TFMessage [latched]
    probe_tracker -> probe_tracker | published: the tracker's frame in `patient`, where it has one;
    heard: frames that do not move, source `tf`
camera/image_raw: sensor_msgs/Image
    camera_driver -> probe_tracker | what a camera sees of the markers on the probe; source `camera`
camera/image_raw/compressed: sensor_msgs/CompressedImage
    drivers -> probe_tracker | the same as JPEG or PNG; source `camera`
camera/camera_info: sensor_msgs/CameraInfo
    camera_driver -> probe_tracker | the camera's calibration, with each image; source `camera`
spacenav/joy: sensor_msgs/Joy
    space_mouse_driver -> probe_tracker | a SpaceMouse's six axes and its buttons; source
    `six_dof_mouse`
spacenav/twist: geometry_msgs/Twist
    drivers -> probe_tracker | the axes alone, where no `spacenav/joy` comes; source `six_dof_mouse`
haptic/pose: geometry_msgs/PoseStamped
    drivers -> probe_tracker, haptic_renderer | a haptic arm's handle; source `haptic`
haptic/clutch: std_msgs/Bool
    drivers -> probe_tracker, haptic_renderer | true holds the probe while the handle moves; source
    `haptic`
haptic/wrench: geometry_msgs/WrenchStamped
    haptic_renderer | what the hand shall feel, `tracker.haptic.rate` times a second
robot/twist: geometry_msgs/TwistStamped
    drivers -> probe_robot | the velocity that a robot arm's probe is to have, in frame `probe` or
    `patient`
robot/force: geometry_msgs/WrenchStamped
    drivers -> probe_robot | z, in frame `probe`: N by which it is to press
probe/pose: geometry_msgs/PoseStamped
    probe_tracker -> viewer, tissue_deformer, skin_deformer, slice_interpolator, openigtlink_bridge,
    scorer | the probe in `patient`: registered, checked, filtered; once for
    each measurement
probe/status: diagnostic_msgs/DiagnosticStatus [latched]
    probe_tracker -> viewer | `waiting`, `tracked`, `coasting` or `lost`, each time that changes;
    then also where the probe was last
probe/marker: visualization_msgs/MarkerArray [latched]
    probe_tracker -> viewer | a transducer as the scene's probe is shaped, and the outline of its
    image, in frame `probe`
probe/wrench: geometry_msgs/WrenchStamped
    tissue_deformer -> viewer, scorer, probe_robot | the tissue's force and torque on the probe, in
    frame `probe`; none for a pose at which the tissue's forces are not in balance
tissue/nodes: sensor_msgs/PointCloud2
    tissue_deformer -> slice_interpolator, viewer | where the deformed mesh's nodes are, in mesh
    order
tissue/rest: sensor_msgs/PointCloud2 [latched]
    tissue_deformer -> slice_interpolator, viewer | where they are at rest
tissue/tetrahedra: std_msgs/Int32MultiArray [latched]
    tissue_deformer -> slice_interpolator, viewer | four nodes of each tetrahedron, N × 4
tissue/structures: visualization_msgs/MarkerArray [on_demand]
    tissue_deformer -> viewer | vessels, nerves and bones as deformed, where the scene names
    `structures`
tissue/contact_model: std_msgs/Float64MultiArray
    tissue_deformer -> haptic_renderer | how the wrench changes with the probe's pose, where the
    source is `haptic`
skin/mesh: shape_msgs/Mesh [latched]
    skin_deformer -> viewer | the skin at rest
skin/nodes: sensor_msgs/PointCloud2
    skin_deformer -> slice_interpolator, viewer | where the skin's vertices are, with normals
skin/marker: visualization_msgs/Marker
    skin_deformer | the deformed skin as triangles
ultrasound/image: sensor_msgs/Image
    slice_interpolator -> openigtlink_bridge, image_writer, path_player,
    viewer | `mono8`, in frame `probe`: columns along the array, rows along the depth
ultrasound/image/compressed: sensor_msgs/CompressedImage [on_demand]
    slice_interpolator | the same as JPEG or PNG, as image_transport's plugin `compressed` makes it
ultrasound/image_annotated: sensor_msgs/Image [on_demand]
    slice_interpolator -> viewer | `rgb8`, for the eye: with a depth scale, outlines of structures,
    and its age
ultrasound/image_annotated/compressed: sensor_msgs/CompressedImage [on_demand]
    slice_interpolator | likewise
ultrasound/labels: sensor_msgs/Image [on_demand]
    slice_interpolator -> image_writer, scorer | `mono8`: the number of the volume's label at each
    pixel of the image, 0 for nothing
ultrasound/displacement: sensor_msgs/Image [on_demand]
    slice_interpolator -> image_writer | `32FC2`: how far each pixel's tissue has moved since rest
    along +x and +z of `probe`, m; NaN where there is no tissue
ultrasound/strain: sensor_msgs/Image [on_demand]
    slice_interpolator | `32FC1`: the tissue's strain along each pixel's beam, negative where it got
    shorter; NaN where there is no tissue
ultrasound/strain_estimate: sensor_msgs/Image [on_demand]
    slice_interpolator | `32FC1`: the same between two images, estimated from these alone; NaN where
    nothing was found again
ultrasound/velocity: sensor_msgs/Image [on_demand]
    slice_interpolator | `32FC1`: velocity of blood along the beams of colour Doppler, m/s, towards
    the probe positive, exact; NaN where none flows; where the scene names a `flow`
ultrasound/velocity_estimate: sensor_msgs/Image [on_demand]
    slice_interpolator | `32FC1`: the same in the colour box as a scanner estimates it, aliased and
    noisy; NaN where no colour is shown
ultrasound/spectrum: sensor_msgs/Image [on_demand]
    slice_interpolator | `rgb8`, for the eye: velocities at the gate of pulsed-wave Doppler over
    time, in cm/s; where the scene names a `flow`
ultrasound/m_mode: sensor_msgs/Image [on_demand]
    slice_interpolator | `rgb8`, for the eye: the image's echoes along a line over time
ultrasound/image_to_probe: std_msgs/Float64MultiArray [latched]
    slice_interpolator -> openigtlink_bridge, viewer | 4 × 4, from (column,
    row, 0, 1) of a pixel to metres in frame `probe`
score: diagnostic_msgs/DiagnosticArray [latched]
    scorer -> viewer | once a second: metrics so far as values of the first status; one of each step
    of the exercise follows, OK when it is done, with the points (`target`) or the probe's pose
    (`pose`) where it is to be done as JSON lists
score/picture: sensor_msgs/CompressedImage [latched] [on_demand]
    scorer -> viewer | PNG of the way over the skin, force and areas so far, when `scorer/draw` asks
    for it and once the last step is done; empty at first, and after `scorer/clear`
session/marker: std_msgs/String
    viewer | a text that marks a moment of the recording; of a page that freezes its image `frozen`
session/scenes: diagnostic_msgs/DiagnosticArray [latched] [on_demand]
    session_control -> viewer | scenes and cases that can be loaded: name, description, what loads
    it, and more
session/thumbnails: sensor_msgs/CompressedImage [latched] [on_demand]
    session_control -> viewer | JPEG of what the probe sees in each of them; the frame is what loads
    it
session/bags: diagnostic_msgs/DiagnosticArray [latched] [on_demand]
    session_control -> viewer | bags that can be played: those of the folder `us-sim` runs in, and
    installed ones
diagnostics: diagnostic_msgs/DiagnosticArray
    probe_tracker, tissue_deformer, skin_deformer, slice_interpolator, haptic_renderer,
    scorer, openigtlink_bridge, path_player, session_player, session_recorder,
    camera_driver, space_mouse_driver, probe_robot, session_monitor,
    session_control, viewer -> session_monitor, viewer | once a second: state, rate, latency, what
    was dropped or refused; of `session_monitor` which nodes ended or hung
"""

MARKERS = "session/marker"
"""Topic of texts that mark a moment."""
FROZEN = "frozen"
"""The text of a page that freezes its image."""

TOPICS = tuple(_topic(entry) for entry in re.split(r"\n(?=\S)", _TABLE.strip()))


def published_counts(report: Mapping[str, str]) -> dict[str, int]:
    """Messages by topic that a node has published or recorded, by the values of its diagnostics.

    >>> published_counts({"state": "imaging", "published ultrasound/image": "7"})
    {'ultrasound/image': 7}
    """
    return {
        topic: int(value) if value.isdecimal() and len(value) < 20 else 0
        for key, value in report.items()
        for kind, _, topic in [key.partition(" ")]
        if kind == "published"
    }
