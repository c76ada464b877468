"""Node selections of a box, and what a model refuses."""

import numpy as np
import pytest
from old_gmsh import as_vtu
from tissue_block import SOFT, block, block_mesh

from us_sim.errors import MeshError
from us_sim.geometry.collider import Sphere
from us_sim.tissue.elasticity.materials import label_fractions, make_uniform_materials
from us_sim.tissue.mesh.file import read_mesh
from us_sim.tissue.model import (
    FACES,
    TissueModel,
    face_nodes,
    facing_nodes,
    nodes_in_label,
)


@pytest.mark.parametrize(
    ("face", "axis", "value"),
    [
        ("top", 2, 0.0),
        ("bottom", 2, 0.1),
        ("left", 0, -0.1),
        ("right", 0, 0.1),
        ("front", 1, -0.05),
        ("back", 1, 0.05),
    ],
)
def test_faces_are_the_planes_they_are_named_after(face, axis, value):
    mesh = block_mesh((6, 5, 4))
    nodes = face_nodes(mesh, face)
    assert (mesh.nodes[nodes, axis] == value).all()
    assert len(nodes) == {0: 5 * 4, 1: 6 * 4, 2: 6 * 5}[axis]
    assert nodes.dtype == np.int32


def test_faces_of_an_organ_are_its_boundary_near_its_bounding_box(shared_data, tmp_path):
    organ, _ = read_mesh(as_vtu(shared_data / "meshes-sofa" / "liver2.msh", tmp_path), 0.03)
    low, high = organ.nodes.min(axis=0), organ.nodes.max(axis=0)
    bottom = face_nodes(organ, "bottom")
    deepest = organ.nodes[organ.boundary].reshape(-1, 3)[:, 2] > high[2] - 0.05 * (high - low)[2]
    np.testing.assert_array_equal(bottom, np.unique(organ.boundary.ravel()[deepest]))
    assert len(face_nodes(organ, "bottom", margin=0.03)) > len(bottom) > 3
    assert len(face_nodes(organ, "bottom", margin=1e-9)) == 1


def test_what_looks_at_the_probe_is_the_near_half_of_an_organ(shared_data, tmp_path):
    file = as_vtu(shared_data / "meshes-sofa" / "truthcylinder1.msh", tmp_path)
    cylinder, _ = read_mesh(file, 1e-3)
    x, _, z = (cylinder.nodes - cylinder.nodes.mean(axis=0))[facing_nodes(cylinder)].T
    radius = np.ptp(cylinder.nodes[:, 2]) / 2
    # Its axis is y: what looks at the probe is the half of the mantle with z < 0.
    assert z.max() < 0.02 * radius
    np.testing.assert_allclose(np.hypot(x, z), radius, rtol=0.05)


def test_an_unknown_face_is_refused():
    assert "bottom" in FACES
    with pytest.raises(MeshError, match="lid"):
        face_nodes(block_mesh((2, 2, 2)), "lid")


def test_nodes_within_bone_are_found():
    mesh = block_mesh((21, 11, 11))  # 10 mm apart
    index = np.diag([1000.0, 1000.0, 1000.0, 1.0])
    index[:3, 3] = [99.5, 49.5, -0.5]
    labels = np.ones((200, 100, 100), dtype=np.uint8)
    labels[75:125, :, 55:85] = 6  # x from -25 to 25 mm, z from 55 to 85 mm
    fractions = label_fractions(mesh, labels, index)
    found = mesh.nodes[nodes_in_label(mesh, fractions, 6)]
    np.testing.assert_allclose(np.unique(found[:, 0]), [-0.02, -0.01, 0, 0.01, 0.02], atol=1e-12)
    np.testing.assert_allclose(np.unique(found[:, 2]), [0.06, 0.07, 0.08], atol=1e-12)
    assert len(nodes_in_label(mesh, fractions, 9)) == 0


def test_lumped_mass_is_the_tissues_mass():
    assert block().lumped_mass.sum() == pytest.approx(2.0)


MESH = block_mesh((3, 3, 3))
FREE = np.zeros(27, dtype=bool)


@pytest.mark.parametrize(
    ("fixed", "contact", "words"),
    [
        (np.zeros(26, dtype=bool), [0], "27 booleans"),
        (np.zeros(27), [0], "27 booleans"),
        (FREE, [27], "27 to 27"),
        (FREE, [-1], "-1 to -1"),
        (FREE, [1, 1], "twice"),
        (FREE, [0.5], "node indices"),
        (FREE, [[1, 2]], "node indices"),
    ],
)
def test_models_that_do_not_fit_their_mesh_are_refused(fixed, contact, words):
    with pytest.raises(MeshError, match=words):
        TissueModel(
            MESH, make_uniform_materials(MESH, SOFT), fixed, Sphere(0.03), np.array(contact)
        )
