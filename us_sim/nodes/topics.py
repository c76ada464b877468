"""The topics of the graph, without any ROS: what each carries, and who publishes and hears it.

>>> from us_sim.nodes.topics import TOPICS
>>> [topic.name for topic in TOPICS if topic.latched and "slice_interpolator" in topic.publishers]
['ultrasound/image_to_probe']
"""

from __future__ import annotations

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
        return set(self.publishers) <= _IN_PLACE_OF_DRIVERS


_IN_PLACE_OF_DRIVERS = {"path_player", "camera_driver", "space_mouse_driver", "viewer"}

_REPORTING = (
    *("probe_tracker", "tissue_deformer", "skin_deformer", "slice_interpolator"),
    *("haptic_renderer", "openigtlink_bridge", "path_player", "session_player"),
    *("session_recorder", "camera_driver", "space_mouse_driver", "session_monitor"),
    *("volume_reconstructor", "session_control", "viewer"),
)

TOPICS = (
    Topic(
        "tracker/pose",
        "geometry_msgs/PoseStamped",
        "the tracked body in the device's frame, stamped when it was measured; source `pose`",
        publishers=("path_player", "viewer"),
        subscribers=("probe_tracker",),
    ),
    Topic(
        "tracker/poses",
        "geometry_msgs/PoseArray",
        "several bodies at once; source `pose_array`",
        subscribers=("probe_tracker",),
    ),
    Topic(
        "tf",
        "tf2_msgs/TFMessage",
        "published: the probe in `patient`, if somebody subscribes; heard: source `tf`",
        publishers=("probe_tracker",),
        subscribers=("probe_tracker",),
    ),
    Topic(
        "tf_static",
        "tf2_msgs/TFMessage",
        "frames that do not move; source `tf`",
        subscribers=("probe_tracker",),
        latched=True,
    ),
    Topic(
        "camera/image_raw",
        "sensor_msgs/Image",
        "what a camera sees of the markers on the probe; source `camera`",
        publishers=("camera_driver",),
        subscribers=("probe_tracker",),
    ),
    Topic(
        "camera/image_raw/compressed",
        "sensor_msgs/CompressedImage",
        "the same as JPEG or PNG; source `camera`",
        subscribers=("probe_tracker",),
    ),
    Topic(
        "camera/camera_info",
        "sensor_msgs/CameraInfo",
        "the camera's calibration, with each image; source `camera`",
        publishers=("camera_driver",),
        subscribers=("probe_tracker",),
    ),
    Topic(
        "spacenav/joy",
        "sensor_msgs/Joy",
        "a SpaceMouse's six axes and its buttons; source `six_dof_mouse`",
        publishers=("space_mouse_driver",),
        subscribers=("probe_tracker",),
    ),
    Topic(
        "spacenav/twist",
        "geometry_msgs/Twist",
        "the axes alone, where no `spacenav/joy` comes; source `six_dof_mouse`",
        subscribers=("probe_tracker",),
    ),
    Topic(
        "haptic/pose",
        "geometry_msgs/PoseStamped",
        "a haptic arm's handle; source `haptic`",
        subscribers=("probe_tracker", "haptic_renderer"),
    ),
    Topic(
        "haptic/clutch",
        "std_msgs/Bool",
        "true holds the probe while the handle moves; source `haptic`",
        subscribers=("probe_tracker", "haptic_renderer"),
    ),
    Topic(
        "haptic/wrench",
        "geometry_msgs/WrenchStamped",
        "what the hand shall feel, `tracker.haptic.rate` times a second",
        publishers=("haptic_renderer",),
    ),
    Topic(
        "probe/pose",
        "geometry_msgs/PoseStamped",
        "the probe in `patient`: registered, checked, filtered; once for each measurement",
        publishers=("probe_tracker",),
        subscribers=(
            "viewer",
            *("tissue_deformer", "skin_deformer", "slice_interpolator"),
            *("openigtlink_bridge", "volume_reconstructor"),
        ),
    ),
    Topic(
        "probe/status",
        "diagnostic_msgs/DiagnosticStatus",
        "`waiting`, `tracked`, `coasting` or `lost`, each time that changes; then also where the "
        "probe was last",
        publishers=("probe_tracker",),
        latched=True,
    ),
    Topic(
        "probe/marker",
        "visualization_msgs/MarkerArray",
        "a transducer as the scene's probe is shaped, and the outline of its image, in frame "
        "`probe`",
        publishers=("probe_tracker",),
        subscribers=("viewer",),
        latched=True,
    ),
    Topic(
        "probe/wrench",
        "geometry_msgs/WrenchStamped",
        "the tissue's force and torque on the probe, in frame `probe`; none for a pose at which "
        "the tissue's forces are not in balance",
        publishers=("tissue_deformer",),
        subscribers=("viewer",),
    ),
    Topic(
        "tissue/nodes",
        "sensor_msgs/PointCloud2",
        "where the deformed mesh's nodes are, in mesh order",
        publishers=("tissue_deformer",),
        subscribers=("slice_interpolator", "viewer"),
    ),
    Topic(
        "tissue/rest",
        "sensor_msgs/PointCloud2",
        "where they are at rest",
        publishers=("tissue_deformer",),
        subscribers=("slice_interpolator", "viewer"),
        latched=True,
    ),
    Topic(
        "tissue/tetrahedra",
        "std_msgs/Int32MultiArray",
        "four nodes of each tetrahedron, N × 4",
        publishers=("tissue_deformer",),
        subscribers=("slice_interpolator", "viewer"),
        latched=True,
    ),
    Topic(
        "tissue/structures",
        "visualization_msgs/MarkerArray",
        "vessels, nerves and bones as deformed, where the scene names `structures`",
        publishers=("tissue_deformer",),
        on_demand=True,
        subscribers=("viewer",),
    ),
    Topic(
        "tissue/contact_model",
        "std_msgs/Float64MultiArray",
        "how the wrench changes with the probe's pose, where the source is `haptic`",
        publishers=("tissue_deformer",),
        subscribers=("haptic_renderer",),
    ),
    Topic(
        "skin/mesh",
        "shape_msgs/Mesh",
        "the skin at rest",
        publishers=("skin_deformer",),
        subscribers=("viewer",),
        latched=True,
    ),
    Topic(
        "skin/nodes",
        "sensor_msgs/PointCloud2",
        "where the skin's vertices are, with normals",
        publishers=("skin_deformer",),
        subscribers=("slice_interpolator", "viewer"),
    ),
    Topic(
        "skin/marker",
        "visualization_msgs/Marker",
        "the deformed skin as triangles",
        publishers=("skin_deformer",),
    ),
    Topic(
        "ultrasound/image",
        "sensor_msgs/Image",
        "`mono8`, in frame `probe`: columns along the array, rows along the depth",
        publishers=("slice_interpolator",),
        subscribers=(
            *("openigtlink_bridge", "image_writer", "path_player", "volume_reconstructor"),
            "viewer",
        ),
    ),
    Topic(
        "ultrasound/image_annotated",
        "sensor_msgs/Image",
        "`rgb8`, for the eye: with a depth scale, outlines of structures, and its age",
        publishers=("slice_interpolator",),
        on_demand=True,
    ),
    Topic(
        "ultrasound/labels",
        "sensor_msgs/Image",
        "`mono8`: the number of the volume's label at each pixel of the image, 0 for nothing",
        publishers=("slice_interpolator",),
        subscribers=("image_writer",),
        on_demand=True,
    ),
    Topic(
        "ultrasound/displacement",
        "sensor_msgs/Image",
        "`32FC2`: how far each pixel's tissue has moved since rest along +x and +z of `probe`, m; "
        "NaN where there is no tissue",
        publishers=("slice_interpolator",),
        subscribers=("image_writer",),
        on_demand=True,
    ),
    Topic(
        "ultrasound/strain",
        "sensor_msgs/Image",
        "`32FC1`: the tissue's strain along each pixel's beam, negative where it got shorter; NaN "
        "where there is no tissue",
        publishers=("slice_interpolator",),
        on_demand=True,
    ),
    Topic(
        "ultrasound/strain_estimate",
        "sensor_msgs/Image",
        "`32FC1`: the same between two images, estimated from these alone; NaN where nothing was "
        "found again",
        publishers=("slice_interpolator",),
        on_demand=True,
    ),
    Topic(
        "ultrasound/velocity",
        "sensor_msgs/Image",
        "`32FC1`: velocity of blood along the beams of colour Doppler, m/s, towards the probe "
        "positive, exact; NaN where none flows; where the scene names a `flow`",
        publishers=("slice_interpolator",),
        on_demand=True,
    ),
    Topic(
        "ultrasound/velocity_estimate",
        "sensor_msgs/Image",
        "`32FC1`: the same in the colour box as a scanner estimates it, aliased and noisy; NaN "
        "where no colour is shown",
        publishers=("slice_interpolator",),
        on_demand=True,
    ),
    Topic(
        "ultrasound/spectrum",
        "sensor_msgs/Image",
        "`rgb8`, for the eye: velocities at the gate of pulsed-wave Doppler over time, in cm/s; "
        "where the scene names a `flow`",
        publishers=("slice_interpolator",),
        on_demand=True,
    ),
    Topic(
        "ultrasound/m_mode",
        "sensor_msgs/Image",
        "`rgb8`, for the eye: the image's echoes along a line over time",
        publishers=("slice_interpolator",),
        on_demand=True,
    ),
    Topic(
        "ultrasound/image_to_probe",
        "std_msgs/Float64MultiArray",
        "4 × 4, from (column, row, 0, 1) of a pixel to metres in frame `probe`",
        publishers=("slice_interpolator",),
        subscribers=("openigtlink_bridge", "volume_reconstructor", "viewer"),
        latched=True,
    ),
    Topic(
        "session/marker",
        "std_msgs/String",
        "a text that marks a moment of the recording",
    ),
    Topic(
        "session/scenes",
        "diagnostic_msgs/DiagnosticArray",
        "scenes and cases that can be loaded: name, description, what loads it, and more",
        publishers=("session_control",),
        latched=True,
        on_demand=True,
    ),
    Topic(
        "session/thumbnails",
        "sensor_msgs/CompressedImage",
        "JPEG of what the probe sees in each of them; the frame is what loads it",
        publishers=("session_control",),
        latched=True,
        on_demand=True,
    ),
    Topic(
        "session/bags",
        "diagnostic_msgs/DiagnosticArray",
        "bags that can be played: those of the folder `us-sim` runs in, and installed ones",
        publishers=("session_control",),
        latched=True,
        on_demand=True,
    ),
    Topic(
        "events/write_split",
        "rosbag2_interfaces/WriteSplitEvent",
        "a file of the recording was ended, and which one was begun",
        publishers=("session_recorder",),
    ),
    Topic(
        "events/rosbag2_messages_lost",
        "rosbag2_interfaces/MessagesLostEvent",
        "how many messages were lost, by topic; where ROS has this type, which Jazzy has not",
        publishers=("session_recorder",),
    ),
    Topic(
        "diagnostics",
        "diagnostic_msgs/DiagnosticArray",
        "once a second: state, rate, latency, what was dropped or refused; of `session_monitor` "
        "which nodes ended or hung",
        publishers=_REPORTING,
        subscribers=("session_monitor",),
    ),
)
