"""Publishes what the tissue answers near the probe, for those who need it more often than it is
solved.
"""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from std_msgs.msg import Float64MultiArray

from us_sim.errors import TrackingError
from us_sim.geometry.pose import Pose
from us_sim.nodes.conversions import contact_model_message, nanoseconds_of
from us_sim.nodes.scene_node import SceneNode
from us_sim.tissue.deformation import Deformation
from us_sim.tissue.solvers.switching import SwitchableTissue
from us_sim.tracking.haptic import ContactModel, SecantStiffness, wrench_in_patient


class ContactModelPublisher:
    """``tissue/contact_model``: the wrench at a pose of the probe and how it changes from there.

    Args:
        node: that publishes it.
    """

    def __init__(self, node: SceneNode) -> None:
        self._node = node
        self._publisher = node.stream(Float64MultiArray, "tissue/contact_model")
        self._secant = SecantStiffness()

    @property
    def is_wanted(self) -> bool:
        """Whether somebody subscribes."""
        return bool(self._publisher.get_subscription_count())

    def publish(
        self, tissue: SwitchableTissue, pose: Pose, deformation: Deformation, stamp: TimeMessage
    ) -> None:
        """Publish the model at a pose, just solved for, under its stamp."""
        wrench = wrench_in_patient(pose, deformation.force, deformation.torque)
        try:
            stiffness = tissue.contact_stiffness()
        except np.linalg.LinAlgError:
            stiffness = None
        try:
            if stiffness is None:
                stiffness = self._secant.at(pose, wrench)
            model = ContactModel(nanoseconds_of(stamp), pose, wrench, stiffness)
        except TrackingError as error:
            self._secant.forget()
            self._node.health.problem("contact_model", f"{error}; it is not published")
            return
        self._publisher.publish(contact_model_message(model))
        self._node.health.published("tissue/contact_model")
