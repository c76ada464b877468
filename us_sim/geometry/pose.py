"""Rigid transforms in metres and unit quaternions (x, y, z, w)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import PoseError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

# m: the coordinates of poses are no larger, so that no product of a few of them overflows.
_FARTHEST = 1e15
_LONGEST = 1e6  # Of a quaternion's components


@dataclass(frozen=True, eq=False)
class Pose:
    """A rotation followed by a translation, from a child frame (``probe``) to its parent.

    Args:
        position: (3,) m, the child's origin in the parent frame.
        orientation: (4,) quaternion x, y, z, w; normalised here.

    Raises:
        PoseError: a number is not finite, the quaternion's norm is below 1e-6, a component of it
            above 1e6, or the position so far away that products of it would not be finite.

    Examples:
        >>> import numpy as np
        >>> pressed = Pose(position=[0.0, 0.0, 0.012], orientation=[0.0, 0.0, 0.0, 1.0])
        >>> pressed.transform_points(np.array([[0.0, 0.0, 0.03]]))
        array([[0.   , 0.   , 0.042]])
    """

    position: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    orientation: NDArray[np.float64] = field(default_factory=lambda: np.array([0.0, 0, 0, 1]))

    def __post_init__(self) -> None:
        position = np.array(self.position, dtype=np.float64)
        orientation = np.array(self.orientation, dtype=np.float64)
        if position.shape != (3,) or orientation.shape != (4,):
            raise PoseError(
                f"a pose needs 3 coordinates and 4 quaternion components, "
                f"not {position.shape} and {orientation.shape}"
            )
        place, turn = position.tolist(), orientation.tolist()  # of few numbers faster than arrays
        if not all(map(math.isfinite, (*place, *turn))):
            raise PoseError(f"the pose is not finite: position {place}, orientation {turn}")
        if max(map(abs, turn)) > _LONGEST:  # nor may the norm overflow
            raise PoseError(f"the pose's quaternion is {turn}, where one of length 1 is meant")
        norm = float(np.linalg.norm(orientation))
        if norm < 1e-6:
            raise PoseError("the pose's quaternion is zero, so it has no orientation")
        if max(map(abs, place)) > _FARTHEST:
            raise PoseError(f"the pose is at {place}, beyond any place: positions are in metres")
        orientation /= norm
        position.flags.writeable = orientation.flags.writeable = False
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "orientation", orientation)

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Pose:
        """Return the pose of a 4×4 homogeneous rigid matrix.

        Raises:
            PoseError: the upper left block is not a rotation to 1e-3 (scaled, sheared, mirrored).
        """
        matrix = np.asarray(matrix, dtype=np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise PoseError("a rigid transform is a finite 4×4 matrix")
        rotation = matrix[:3, :3]
        is_orthogonal = np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-3)
        if not is_orthogonal or np.linalg.det(rotation) < 0:
            raise PoseError("the matrix is not rigid: its upper left 3×3 block is not a rotation")
        from scipy.spatial.transform import Rotation  # which most that hold poses do without

        return cls(matrix[:3, 3], Rotation.from_matrix(rotation).as_quat())

    @property
    def rotation(self) -> NDArray[np.float64]:
        """(3, 3) rotation matrix, child to parent."""
        x, y, z, w = self.orientation
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(4, 4) homogeneous matrix, child to parent."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.position
        return matrix

    def transform_points(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transform points (N, 3) m from the child frame to the parent frame."""
        return points @ self.rotation.T + self.position

    def inverse(self) -> Pose:
        """Return the transform from parent to child."""
        return Pose(-self.rotation.T @ self.position, self.orientation * [-1.0, -1.0, -1.0, 1.0])

    def __matmul__(self, other: Pose) -> Pose:
        """Return the transform that does ``other`` first, then this."""
        turn = multiply_quaternions(self.orientation, other.orientation)
        return Pose(self.rotation @ other.position + self.position, turn)


def multiply_quaternions(
    first: NDArray[np.float64], second: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the quaternion (4,) x, y, z, w that rotates by the second, then by the first."""
    x1, y1, z1, w1 = first.tolist()
    x2, y2, z2, w2 = second.tolist()
    return np.array(
        [
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
        ]
    )


def is_same_pose(a: Pose | None, b: Pose | None) -> bool:
    """Return True if two poses are the same, to the last bit."""
    if a is None or b is None:
        return a is b
    return np.array_equal(a.position, b.position) and np.array_equal(a.orientation, b.orientation)


PLACE = Quantity("length", -10.0, 10.0)  # A coordinate of something near the patient


@dataclass(frozen=True)
class Placement(Settings):
    """A position and an orientation."""

    position: tuple[float, float, float] = setting(PLACE, "x, y, z", default=(0.0, 0.0, 0.0))
    orientation: tuple[float, float, float, float] = setting(
        Quantity("number", -1.0, 1.0), "quaternion x, y, z, w", default=(0.0, 0.0, 0.0, 1.0)
    )

    def check(self) -> None:
        """Refuse a quaternion that is no rotation."""
        if math.hypot(*self.orientation) < 1e-6:
            raise self.make_error(
                "orientation", "is zero, so it is no orientation: give [0, 0, 0, 1] for none"
            )

    @property
    def pose(self) -> Pose:
        """The placement as a rigid transform."""
        return Pose(np.array(self.position), np.array(self.orientation))
