"""How a hand holds the probe on the skin, and the pose that follows.

The motions are those of the American Institute of Ultrasound in Medicine ("Transducer
Manipulation", Journal of Ultrasound in Medicine 18, 1999, 169-175), in frame ``probe``: +x along
the array, +y the elevation, +z into the tissue.

- sliding: the point on the skin moves, along x or along y;
- compressing: the probe moves along the skin's normal;
- rotating: about the normal;
- fanning (or tilting): about x, so the image plane swings through the tissue;
- rocking: about y, within the image plane.

>>> import math
>>> from us_sim.tracking.virtual_hand.rest_surface import RestSurface
>>> from us_sim.tracking.virtual_hand.stance import Stance
>>> skin = RestSurface.plane(0.1)
>>> pressed = Stance([0.02, 0.0, 0.0], press=0.005, fan=math.radians(10))
>>> (1e3 * pressed.pose(skin).position).round(6).tolist()  # mm
[20.0, 0.0, 5.0]
>>> again = Stance.of(pressed.pose(skin), skin)
>>> round(1e3 * again.press, 6), round(math.degrees(again.fan), 6)
(5.0, 10.0)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import PoseError
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import product, rotation_exp
from us_sim.tracking.virtual_hand.rest_surface import RestSurface

DEEPEST = 0.02
"""m that a probe is pressed at most: a vein closes at half of it, and deeper hurts."""
HIGHEST = 0.05
"""m that it is lifted off at most."""
STEEPEST = math.radians(60)
"""rad that it is fanned or rocked at most: more, and its grip would lie on the skin."""


@dataclass(frozen=True, eq=False)
class Stance:
    """The probe on the skin at rest.

    Fan and rock are about the middle of the probe's face, which stays where it is.

    Raises:
        PoseError: a number is not finite.
    """

    point: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    # (3,) m, frame patient; what counts is the point of the skin at rest that is closest to it
    press: float = 0.0  # m inwards along the skin's normal; negative is above it
    rotation: float = 0.0  # rad about the normal, from where x is turned as little as can be
    fan: float = 0.0  # rad about the probe's x
    rock: float = 0.0  # rad about the probe's y

    def __post_init__(self) -> None:
        point = np.array(self.point, dtype=np.float64)
        numbers = [*point.ravel(), self.press, self.rotation, self.fan, self.rock]
        if point.shape != (3,) or not np.isfinite(numbers).all():
            raise PoseError(f"the hand's numbers {numbers} are not finite, or not seven")
        point.flags.writeable = False
        object.__setattr__(self, "point", point)

    @classmethod
    def of(cls, pose: Pose, surface: RestSurface) -> Stance:
        """The stance of a probe that is somewhere already: the way back from `pose`."""
        foot, press = surface.under(pose.position)
        x, y, z, w = _upright(foot.normal)
        turned = Pose(np.zeros(3), product(np.array([-x, -y, -z, w]), pose.orientation)).rotation
        # Rz(rotation) Rx(fan) Ry(rock), taken apart (Diebel 2006, sequence 3-1-2).
        fan = math.asin(float(np.clip(turned[2, 1], -1.0, 1.0)))
        if math.hypot(turned[0, 1], turned[1, 1]) < 1e-9:  # fanned by a quarter turn
            return cls(foot.point, press, math.atan2(turned[1, 0], turned[0, 0]), fan, 0.0)
        rotation = math.atan2(-turned[0, 1], turned[1, 1])
        return cls(foot.point, press, rotation, fan, math.atan2(-turned[2, 0], turned[2, 2]))

    @classmethod
    def home(cls, surface: RestSurface, press: float) -> Stance:
        """Upright above the origin of ``patient``, or on the middle of a surface that is not there.

        Args:
            surface: to stand on.
            press: m.
        """
        middle = 0.5 * (surface.lower + surface.upper)
        inside = (surface.lower[:2] <= 0.0).all() and (surface.upper[:2] >= 0.0).all()
        x, y = (0.0, 0.0) if inside else middle[:2].tolist()
        return cls(surface.above(x, y).point, press)

    def pose(self, surface: RestSurface) -> Pose:
        """The probe in ``patient``, held so."""
        foot = surface.closest(self.point)
        orientation = product(_upright(foot.normal), rotation_exp(_about(2, self.rotation)))
        orientation = product(orientation, rotation_exp(_about(0, self.fan)))
        orientation = product(orientation, rotation_exp(_about(1, self.rock)))
        return Pose(foot.point - self.press * foot.normal, orientation)

    def slid(self, surface: RestSurface, along_x: float, along_y: float) -> Stance:
        """Moved over the skin along the probe's own x and y, m, as it is rotated."""
        foot = surface.closest(self.point)
        turned = product(_upright(foot.normal), rotation_exp(_about(2, self.rotation)))
        way = Pose(np.zeros(3), turned).rotation @ np.array([along_x, along_y, 0.0])
        return replace(self, point=surface.walk(foot, way).point)

    def within_reach(self) -> Stance:
        """Pressed and turned no further than a hand may."""
        return replace(
            self,
            press=min(max(self.press, -HIGHEST), DEEPEST),
            rotation=half_turn(self.rotation),
            fan=min(max(self.fan, -STEEPEST), STEEPEST),
            rock=min(max(self.rock, -STEEPEST), STEEPEST),
        )


def half_turn(angle: float) -> float:
    """The same angle (rad) within half a turn to either side."""
    return math.remainder(angle, 2.0 * math.pi)


def _about(axis: int, angle: float) -> NDArray[np.float64]:
    """(3,) rad, the rotation vector of a turn about one axis."""
    vector = np.zeros(3)
    vector[axis] = angle
    return vector


def _upright(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4,) quaternion of the smallest turn that brings +z to the inside of a normal (3,).

    So x stays along the patient's x as far as the skin lets it. On skin that faces exactly down
    every such turn is half a one: it is then about y.
    """
    x, y, z = (-normal).tolist()
    if z < -1.0 + 1e-12:
        return np.array([0.0, 1.0, 0.0, 0.0])
    quaternion = np.array([-y, x, 0.0, 1.0 + z])
    return np.asarray(quaternion / np.linalg.norm(quaternion))
