"""What a scene says of its tracker, made into objects, each only when it is asked for.

>>> from us_sim.scene.reading import load_scene
>>> from us_sim.scene.tracker_building import tracking_of
>>> tracking_of(load_scene("upper_arm")).filter.lag
0.0
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from us_sim.geometry.pose import Placement, Pose
from us_sim.scene.scene import Scene
from us_sim.settings.registry import TRACKERS

if TYPE_CHECKING:
    from us_sim.tracking.camera.rigid_body import RigidBody
    from us_sim.tracking.filters import PoseFilter
    from us_sim.tracking.haptic import HapticRendering
    from us_sim.tracking.probe_tracking import ProbeTracking


def tracking_of(scene: Scene, filter: PoseFilter | None = None) -> ProbeTracking:
    """What turns the measurements of the scene's tracker into the probe's poses.

    Args:
        scene: with the tracker.
        filter: in place of the scene's.

    Raises:
        CalibrationError: a file of a registration or calibration cannot be used.
        TrackingError: the times make no sense.
    """
    from us_sim.tracking.filters import create_filter
    from us_sim.tracking.probe_tracking import ProbeTracking

    tracker = scene.tracker
    gate = None
    if tracker.gate is not None:
        from us_sim.tracking.outlier_gate import OutlierGate

        gate = OutlierGate(tracker.gate)
    return ProbeTracking(
        *tracker_poses_of(scene),
        filter or create_filter(tracker.filter.name, tracker.filter.given),
        gate,
        time_offset=tracker.time_offset,
        coast_for=tracker.coast_for,
        lost_after=tracker.lost_after,
    )


def source_settings(scene: Scene, source: str) -> Any:
    """The settings of a source of poses: the scene's where it names that source, else the defaults.

    Raises:
        TrackingError: there is no such source.
    """
    chosen = scene.tracker.source
    if chosen.name == source and chosen.given is not None:
        return chosen.given
    return TRACKERS.settings(source)()


def tracker_poses_of(scene: Scene) -> tuple[Pose, Pose]:
    """Registration (the device in ``patient``) and calibration (the probe in the body).

    Raises:
        CalibrationError: a file of one of them cannot be used.
    """
    tracker = scene.tracker
    return _pose_or_file(tracker.registration), _pose_or_file(tracker.calibration)


def haptic_rendering_of(scene: Scene) -> HapticRendering:
    """What tells the wrench on the handle of the scene's haptic arm.

    Raises:
        CalibrationError: a file of a registration or calibration cannot be used.
    """
    from us_sim.tracking.haptic import HapticDevice, HapticRendering

    tracker = scene.tracker
    settings = source_settings(scene, "haptic")
    device = HapticDevice(settings, *tracker_poses_of(scene))
    return HapticRendering(settings, device, time_offset=tracker.time_offset)


def _pose_or_file(given: Placement | str | None) -> Pose:
    if isinstance(given, str):
        from us_sim.tracking.calibration.transform_file import read_transform

        return read_transform(given)
    return given.pose if given is not None else Pose()


def camera_body_of(scene: Scene) -> RigidBody:
    """The markers on the probe that the scene's camera looks for.

    Raises:
        TrackingError: their file cannot be used.
    """
    from us_sim.tracking.camera.rigid_body import RigidBody

    settings = source_settings(scene, "camera")
    if settings.body:
        from us_sim.tracking.camera.rigid_body import read_rigid_body

        return read_rigid_body(settings.body, settings.dictionary)
    return RigidBody.single(settings.dictionary, settings.marker, settings.size)
