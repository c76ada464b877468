"""The vein of the installed arm: it empties under a press, and the artery beside it does not."""

import numpy as np
import pytest

from us_sim.geometry.pose import Pose
from us_sim.scene.building import build_tissue_model, load_volume
from us_sim.scene.reading import load_scene
from us_sim.tissue.elasticity.materials import label_fractions
from us_sim.tissue.solvers.fem_nonlinear import FemNonlinear


@pytest.fixture(scope="module")
def arm():
    """The model, and volumes of vein and artery under the probe's middle, by tetrahedron."""
    scene = load_scene("upper_arm")
    volume = load_volume(scene)
    model = build_tissue_model(scene, volume)
    mesh = model.mesh
    present, fractions = label_fractions(mesh, volume.labels, volume.patient_to_index)
    middle = np.abs(mesh.nodes[mesh.tetrahedra].mean(axis=1)[:, 1]) < 0.004
    numbers = {name: label for label, name in volume.label_names.items()}
    vessels = {
        name: fractions[:, present == numbers[name]].ravel() * mesh.volumes * middle
        for name in ("vein", "artery")
    }
    return model, vessels


def test_its_vein_is_a_lumen_at_the_pressure_of_veins_and_nothing_else_is(arm):
    model, vessels = arm
    lumen = model.materials.lumen_fraction
    assert lumen @ model.mesh.volumes == pytest.approx(np.pi * 3.5e-3 * 2.75e-3 * 0.06, rel=0.15)
    assert 700.0 <= model.materials.lumen_pressure.max() <= 2000.0  # 5 to 15 mmHg
    assert (lumen[vessels["vein"] > 0] > 0).all()


@pytest.mark.slow
def test_a_press_of_12_mm_closes_it_and_it_opens_again(arm):
    model, vessels = arm
    solver = FemNonlinear(model)

    def open_fractions(deformation):
        corners = deformation.nodes[model.mesh.tetrahedra]
        ratio = np.linalg.det(corners[:, 1:] - corners[:, :1]) / (6 * model.mesh.volumes)
        assert ratio.min() > 0.0
        return [volume @ ratio / volume.sum() for volume in vessels.values()]

    veins, forces = [], []
    for depth in np.linspace(0.0, 0.012, 41):
        deformation = solver.deform(Pose(position=[0.0, 0.0, depth]))
        vein, artery = open_fractions(deformation)
        veins.append(vein)
        forces.append(-deformation.force[2])
        assert deformation.residual <= 0.01
    assert veins[0] == pytest.approx(1.0)
    # Two newtons on 6 cm2, 3 kPa on the skin, are felt; twelve empty it.
    assert np.interp(2.0, forces, veins) < 0.92
    assert veins[-1] < 0.25
    assert artery > 0.8
    assert (np.diff(veins) < 2e-3).all()
    for _ in range(2):
        deformation = solver.deform(Pose(position=[0.0, 0.0, -0.001]))
    np.testing.assert_array_equal(deformation.nodes, model.mesh.nodes)
