"""The arm's vein under a probe: pressure of tissue in closed form, and laws of its closing."""

import numpy as np
import pytest

from us_sim.evaluation.measured import vein
from us_sim.evaluation.measured.vein import (
    MODULI,
    PUBLISHED,
    VENOUS,
    mean_pressure,
    measure_vein,
    press,
    round_vein_pressure,
)
from us_sim.evaluation.report import ReportFolder
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.model import TissueModel


@pytest.mark.parametrize("poisson", [0.1, 0.3, 0.45])
def test_the_mean_pressure_of_small_strains_is_that_of_hooke(poisson):
    model = TissueModel.block(nodes=(4, 4, 4), material=Material(10e3, poisson))
    strain = 1e-5 * np.array([[-3.0, 1.0, 0.0], [1.0, 2.0, 0.5], [0.0, 0.5, -4.0]])
    pressure = mean_pressure(model, model.mesh.nodes @ (np.eye(3) + strain))
    bulk = 10e3 / (3.0 * (1.0 - 2.0 * poisson))
    np.testing.assert_allclose(pressure, -bulk * np.trace(strain), rtol=1e-4)


def test_a_turn_presses_nothing():
    model = TissueModel.block(nodes=(4, 4, 4), material=Material(10e3, 0.45))
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(mean_pressure(model, model.mesh.nodes @ turn), 0.0, atol=1e-8)


@pytest.fixture(scope="module")
def lying():
    """The vein of somebody who lies, pressed in ten steps, which takes seconds."""
    return press(VENOUS["lying"], 10)


@pytest.mark.slow
def test_a_vein_of_higher_pressure_closes_at_a_higher_one(lying):
    low, high = lying, press(VENOUS["standing"], 10)
    assert low.area[0] == high.area[0] == 1.0
    assert (high.area[1:] >= low.area[1:]).all()
    assert high.at(0.5, high.interface) > low.at(0.5, low.interface) + 10.0
    assert np.isnan(low.at(0.0, low.interface))


def test_a_round_vein_closes_a_little_as_lames_solution_says():
    # Of an incompressible solid: the radius falls by p / 2 mu of itself (Lame, 1852).
    shear = 10e3 / 3.0
    assert round_vein_pressure(10e3, (1 - 1e-4) ** 2) == pytest.approx(2e-4 * shear, rel=1e-3)


@pytest.mark.slow
def test_softer_tissue_lets_the_vein_close_at_less(lying):
    soft = press(VENOUS["lying"], 10, MODULI["of volunteers"])
    assert soft.at(0.5, soft.interface) < lying.at(0.5, lying.interface) - 3.0


@pytest.mark.slow
def test_the_study_needs_no_data_and_reports_each_posture(lying, tmp_path, monkeypatch):
    monkeypatch.setattr(vein, "press", lambda *_, **__: lying)
    section = measure_vein(tmp_path / "none", ReportFolder("measured", tmp_path, True))
    assert (tmp_path / "measured_vein.png").exists()
    cases = {finding.case for finding in section.findings}
    assert cases == {f"{name}, moduli {moduli}" for name in PUBLISHED for moduli in MODULI}
    seen = {finding.predicted for finding in section.findings}
    assert seen == {lying.at(0.2, of) for of in (lying.interface, lying.beside)}
    for finding in section.findings:
        assert finding.error == pytest.approx(finding.predicted - finding.measured)
    assert "lying" in section.text
