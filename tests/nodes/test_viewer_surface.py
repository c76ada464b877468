"""On which surface the viewer puts the probe, whatever comes of it and in which order."""

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh
from std_msgs.msg import Int32MultiArray

from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.messages import cloud_message, mesh_message, tetrahedra_message
from us_sim.nodes.qos import LATCHED
from us_sim.skin.surface import plane_surface
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.viewer.feeds import RestMesh
from us_sim.viewer.hand import ViewerSurface


class Stander(GuardedNode):
    """A node that knows a surface."""

    def __init__(self, **kwargs):
        super().__init__("stander", **kwargs)
        self.health = Health(self, "test")
        self.changes = 0
        self.surface = ViewerSurface(self, RestMesh(self), self._count)

    def _count(self):
        self.changes += 1


@pytest.fixture
def stander(bench):
    return bench.make(Stander)


def offer_skin(bench, height):
    sheet = plane_surface((0.1, 0.1), 0.02)
    publisher = bench.peer.create_publisher(Mesh, "skin/mesh", LATCHED)
    publisher.publish(mesh_message(np.add(sheet.vertices, [0, 0, height]), sheet.triangles))
    return publisher


def offer_tissue(bench, top):
    sides = ((-0.03, 0.03), (-0.02, 0.02), (top, top + 0.04))
    mesh = box_mesh(*(uniform_planes(*side, 4) for side in sides))
    rest = bench.peer.create_publisher(PointCloud2, "tissue/rest", LATCHED)
    corners = bench.peer.create_publisher(Int32MultiArray, "tissue/tetrahedra", LATCHED)
    columns = dict(zip("xyz", mesh.nodes.T, strict=True))
    rest.publish(cloud_message(columns, Time(), "patient"))
    corners.publish(tetrahedra_message(mesh.tetrahedra))
    return rest, corners


def height(stander):
    best = stander.surface.best
    return None if best is None else best.above(0.0, 0.0).point[2]


def test_without_anything_it_is_the_plane(stander):
    assert height(stander) == 0.0


def test_the_upper_side_of_the_tissue(bench, stander):
    offer_tissue(bench, 0.012)
    bench.spin_until(lambda: stander.changes == 1)
    surface = stander.surface.best
    assert height(stander) == pytest.approx(0.012)
    np.testing.assert_allclose(surface.lower, [-0.03, -0.02, 0.012], atol=1e-6)
    np.testing.assert_allclose(surface.upper, [0.03, 0.02, 0.012], atol=1e-6)
    np.testing.assert_allclose(surface.above(0.0, 0.0).normal, [0, 0, -1], atol=1e-9)


def test_the_skin_goes_before_the_tissue(bench, stander):
    offer_tissue(bench, 0.012)
    skin = offer_skin(bench, 0.01)
    bench.spin_until(lambda: stander.changes == 2)
    assert height(stander) == pytest.approx(0.01)
    bench.peer.destroy_publisher(skin)  # another scene, without
    bench.spin_until(lambda: height(stander) == pytest.approx(0.012))


def test_what_is_offered_is_awaited(bench, stander):
    bench.peer.create_publisher(Mesh, "skin/mesh", LATCHED)
    bench.spin_until(lambda: stander.surface.best is None)


def test_a_skin_that_is_none_is_refused_and_said(bench, stander):
    publisher = bench.peer.create_publisher(Mesh, "skin/mesh", LATCHED)
    publisher.publish(mesh_message(np.zeros((3, 3)), np.array([[0, 1, 2]])))
    bench.spin_until(lambda: stander.health.problems("mesh") == 1)
    assert "no triangle with an area" in stander.health._last_problem
