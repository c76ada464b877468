"""Ways in which a camera may see a body: poses before it, and bodies to look at."""

from collections.abc import Iterator

import numpy as np

from us_sim.geometry.pose import Pose
from us_sim.tracking.camera.markers import compute_square_corners
from us_sim.tracking.camera.model import CameraModel
from us_sim.tracking.camera.rigid_body import RigidBody

WEBCAM = CameraModel(
    640, 480, [[600, 0, 319.5], [0, 600, 239.5], [0, 0, 1]], [-0.25, 0.08, 0.001, -0.001, 0.0]
)


def faceted_grip(count: int = 4, size: float = 0.03) -> RigidBody:
    """Markers two by two, or two by three, on facets that lean away from the middle."""
    rows = count // 2
    corners = []
    for k in range(count):
        x, y = 2.0 * (k % 2) - 1, 2.0 * (k // 2) - (rows - 1)
        facet = turned([0, 1, 0], 0.4 * x) @ turned([1, 0, 0], -0.3 * y)
        place = [0.02 * x, 0.02 * y, -0.008 * abs(y)]
        corners.append(
            Pose(place, facet.orientation).transform_points(compute_square_corners(size))
        )
    return RigidBody("4X4_50", np.arange(count), np.array(corners))


def random_views(
    count: int, distance: float, angles: tuple[float, float], seed: int
) -> Iterator[Pose]:
    """Poses that show a body's front at an angle (degrees) in a range, near the image's middle."""
    random = np.random.default_rng(seed)
    for _ in range(count):
        angle = np.radians(random.uniform(*angles))
        about, spin = random.uniform(0, 2 * np.pi, 2)
        place = np.array([*random.uniform(-0.15, 0.15, 2), 1.0]) * distance
        aim = np.cross([0.0, 0.0, 1.0], place / np.linalg.norm(place))
        sight = Pose(np.zeros(3), [*aim, 1.0 + place[2] / np.linalg.norm(place)])
        lean = turned([np.cos(about), np.sin(about), 0], angle)
        facing = turned([1, 0, 0], np.pi)
        yield Pose(place, (sight @ lean @ facing @ turned([0, 0, 1], spin)).orientation)


def turned(axis: list[float], angle: float) -> Pose:
    """A rotation about a unit axis."""
    return Pose(np.zeros(3), [*(np.sin(angle / 2) * np.array(axis)), np.cos(angle / 2)])
