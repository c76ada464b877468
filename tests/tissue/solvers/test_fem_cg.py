"""Linear contact against exact solutions, and how it behaves under rough handling."""

import numpy as np
import pytest
from scipy.sparse import bmat, csc_array, csr_array
from scipy.sparse.linalg import spsolve
from tissue_block import at, block, block_mesh, settle

from us_sim.geometry.collider import Capsule, RoundedBox, Sphere
from us_sim.geometry.collider_distance import measure_distances
from us_sim.tissue.contact.probe_gap import measure_gaps
from us_sim.tissue.elasticity.linear_tetrahedra import assemble_stiffness
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import make_uniform_materials
from us_sim.tissue.solvers.fem_cg import FemCg, FemCgSettings

PLATE = RoundedBox(0.5, 0.4, 0.1, 0.01)  # covers the whole block


def test_uniaxial_compression_has_hookes_force_and_a_linear_field():
    spongy = Material(young_modulus=10e3, poisson_ratio=0.0, density=1000.0)
    model = block((9, 5, 5), PLATE, materials=make_uniform_materials(block_mesh((9, 5, 5)), spongy))
    deformation = settle(FemCg(model, FemCgSettings(tolerance=1e-10)), at(x=0.01, z=0.005))
    # E A d / L = 10 kPa * 0.02 m2 * 5 mm / 100 mm
    np.testing.assert_allclose(deformation.force, [0, 0, -10], atol=1e-6)
    # The block's centre is 10 mm behind the probe's origin along x.
    np.testing.assert_allclose(deformation.torque, [0, -0.1, 0], atol=1e-6)
    expected = model.mesh.nodes.copy()
    expected[:, 2] += 0.005 * (1 - expected[:, 2] / 0.1)
    np.testing.assert_allclose(deformation.nodes, expected, atol=1e-9)
    assert len(deformation.contact_nodes) == 9 * 5


@pytest.mark.parametrize("collider", [Sphere(0.03), RoundedBox(0.06, 0.03, 0.1, 0.004)])
@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_converges_to_the_direct_solution_of_its_contact_set(collider, tilt):
    model = block((13, 7, 6), collider)
    pose = at(x=0.013, y=0.004, z=0.012, orientation=(tilt / 2, tilt / 3, 0.0, 1.0))
    deformation = settle(FemCg(model, FemCgSettings(tolerance=1e-10)), pose)
    assert len(deformation.contact_nodes) > 3
    assert deformation.residual <= 1e-10

    # Minimise u K u / 2 with the touched nodes' normal displacements as found.
    displacement = deformation.nodes - model.mesh.nodes
    touched = deformation.contact_nodes
    _, normal = measure_gaps(collider, pose, deformation.nodes[touched], model.contact_spacing)
    count = len(touched)
    rows = np.repeat(np.arange(count), 3)
    columns = (3 * touched[:, None] + np.arange(3)).ravel()
    constraint = csr_array((normal.ravel(), (rows, columns)), shape=(count, displacement.size))
    free = np.repeat(~model.fixed, 3)
    matrix = assemble_stiffness(model.mesh, model.materials).tocsr()[free][:, free]
    constraint = constraint[:, free]
    system = csc_array(bmat([[matrix, constraint.T], [constraint, None]]))
    right = np.zeros(system.shape[0])
    right[-count:] = constraint @ displacement.ravel()[free]
    solution = spsolve(system, right)
    # The solver lets normals lag by up to a milliradian behind a sliding node.
    scale = abs(displacement).max()
    np.testing.assert_allclose(
        displacement.ravel()[free], solution[:-count], atol=2e-3 * scale, rtol=0
    )
    pushes = -solution[-count:]
    assert (pushes > 0).all()
    total = -(pushes[:, None] * normal).sum(axis=0) @ pose.rotation
    np.testing.assert_allclose(deformation.force, total, atol=5e-3 * np.linalg.norm(total))


@pytest.mark.parametrize(
    "collider", [Sphere(0.03), Capsule(0.01, 0.04), RoundedBox(0.05, 0.015, 0.1, 0.003)]
)
def test_rough_handling_is_survived_and_forgotten(collider):
    model = block((13, 7, 6), collider)
    solver, fresh = FemCg(model), FemCg(model)
    slanted = (0.0, 0.25, 0.0, 1.0)
    aside = at(x=0.05, y=0.03, z=0.02, orientation=slanted)
    presses = [at(z=0.03), at(z=0.002), at(x=0.02, z=0.025), None, at(z=0.06), at(z=0.3)]
    handling = [*presses, aside, at(z=-1.0), at(z=0.15)]
    for pose in handling:
        for _ in range(4):
            deformation = solver.deform(pose)
            assert np.isfinite(deformation.nodes).all()
            assert np.isfinite(deformation.residual)
            np.testing.assert_array_equal(
                deformation.nodes[model.fixed], model.mesh.nodes[model.fixed]
            )
    settle(solver, None)
    found = settle(solver, at(x=0.01, z=0.01))
    expected = settle(fresh, at(x=0.01, z=0.01))
    np.testing.assert_allclose(found.nodes, expected.nodes, atol=5e-5)
    np.testing.assert_allclose(found.force, expected.force, atol=0.02)


@pytest.mark.parametrize("collider", [Sphere(0.03), RoundedBox(0.05, 0.04, 0.1, 0.003)])
def test_no_node_stays_inside_the_probe_and_none_is_pulled(collider):
    model = block((13, 7, 6), collider)
    deformation = settle(FemCg(model), at(z=0.015))
    reachable = deformation.nodes[model.contact_nodes]
    distance, _ = measure_distances(collider, at(z=0.015), reachable)
    assert distance.min() > -2e-5
    touched = np.isin(model.contact_nodes, deformation.contact_nodes)
    assert abs(distance[touched]).max() < 2e-5
    assert deformation.force[2] < 0
