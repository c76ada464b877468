"""The arm's vein under a probe: pressure of tissue in closed form, and laws of its closing."""

import numpy as np
import pytest

from us_sim.evaluation.measured import vein
from us_sim.evaluation.measured.vein import (
    MODULI,
    VENOUS,
    mean_pressure,
    measure_closing,
    press,
)
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


@pytest.mark.slow
def test_softer_tissue_lets_the_vein_close_at_less(lying):
    soft = press(VENOUS["lying"], 10, MODULI["of volunteers"])
    assert soft.at(0.5, soft.interface) < lying.at(0.5, lying.interface) - 3.0


@pytest.mark.slow
def test_pressures_are_read_where_the_vein_counts_as_closed(lying, monkeypatch):
    monkeypatch.setattr(vein, "press", lambda *_: lying)
    under, beside = measure_closing("lying", "of the scene", 10)
    assert under["predicted"] == lying.at(0.2, lying.interface)
    assert beside["predicted"] == lying.at(0.2, lying.beside)
    assert under["error"] == pytest.approx(under["predicted"] - 22.5)
