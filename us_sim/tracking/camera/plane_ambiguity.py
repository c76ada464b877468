"""The choice between a plane's two poses, by the evidence of all images so far.

>>> import numpy as np
>>> from us_sim.tracking.camera.body_pose import body_poses
>>> from us_sim.tracking.camera.model import CameraModel
>>> from us_sim.tracking.camera.markers import square
>>> from us_sim.tracking.camera.plane_ambiguity import PlaneAmbiguity
>>> from us_sim.geometry.pose import Pose
>>> camera = CameraModel(640, 480, [[600, 0, 320], [0, 600, 240], [0, 0, 1]])
>>> true = Pose([0.0, 0.0, 1.5], [1.0, 0.0, 0.3, 0.0])  # a marker of 16 pixels
>>> seen = camera.project(true.apply(square(0.04)))
>>> poses, ambiguity = body_poses(camera, square(0.04), seen), PlaneAmbiguity(0.1)
>>> pose = ambiguity.chosen(poses, None)
>>> covariance = ambiguity.settled(poses, pose, None)
>>> [round(float(np.degrees(np.sqrt(np.trace(each[3:, 3:]))))) for each in (
...     pose.covariance, covariance)]  # degrees, without and with the other pose
[1, 16]
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import rotation_between
from us_sim.tracking.camera.body_pose import BodyPose, rotation_angle

_FORGETTING = 0.9  # factor of the evidence of earlier images, from one to the next
_SURE = 12.0  # log likelihood ratio beyond which more does not count: so that it can be unlearned


class PlaneAmbiguity:
    """Chooses between two poses that a plane's image leaves.

    The right one moves as the last one did, and fits the images better in the long run; a single
    image of a small marker may fit the wrong one better by chance.

    Args:
        deviation: pixels, with which the poses were estimated.
    """

    def __init__(self, deviation: float) -> None:
        self._deviation = deviation
        self._evidence = 0.0  # log likelihood ratio of the pose that is followed to the other

    def reset(self) -> None:
        """Forget what was seen."""
        self._evidence = 0.0

    def chosen(self, found: list[BodyPose], before: Pose | None) -> BodyPose:
        """The pose that follows the one before, unless by now the images speak for the other."""
        if len(found) == 1 or before is None:
            return found[0]
        near, far = _by_nearness(found, before)
        return near if _FORGETTING * self._evidence + self._ratio(near, far) >= 0 else far

    def settled(
        self, found: list[BodyPose], pose: BodyPose, before: Pose | None
    ) -> NDArray[np.float64]:
        """Learn from an image of which a pose was chosen.

        Returns:
            (6, 6) its covariance, that of the mixture of both poses about the chosen one: the
            likelier the other is, the wider.
        """
        self._evidence *= _FORGETTING
        if len(found) == 1:
            return pose.covariance
        other = found[1] if pose is found[0] else found[0]
        if before is not None and _by_nearness(found, before)[0] is not pose:
            self._evidence = -self._evidence
        evidence = self._evidence + self._ratio(pose, other)
        self._evidence = float(np.clip(evidence, -_SURE, _SURE))
        probability = 1.0 / (1.0 + np.exp(self._evidence))
        turn = rotation_between(pose.pose.orientation, other.pose.orientation)
        apart = np.concatenate([other.pose.position - pose.pose.position, turn])
        return np.asarray(pose.covariance + probability * np.outer(apart, apart))

    def _ratio(self, one: BodyPose, other: BodyPose) -> float:
        """Log likelihood ratio, with the noise estimated from the better of both."""
        better = one if one.misfit <= other.misfit else other
        return 0.5 * (other.misfit - one.misfit) * (self._deviation / better.deviation) ** 2


def _by_nearness(found: list[BodyPose], before: Pose) -> list[BodyPose]:
    return sorted(found, key=lambda each: rotation_angle(each.pose, before))
