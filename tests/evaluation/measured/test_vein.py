"""The arm's vein under a probe: laws of its closing."""

import numpy as np
import pytest

from us_sim.evaluation.measured import vein
from us_sim.evaluation.measured.vein import (
    MODULI,
    VENOUS,
    measure_closing,
    press_vein,
)


@pytest.fixture(scope="module")
def lying():
    """The vein of somebody who lies, pressed in ten steps, which takes seconds."""
    return press_vein(VENOUS["lying"], 10)


@pytest.mark.slow
def test_a_vein_of_higher_pressure_closes_at_a_higher_one(lying):
    low, high = lying, press_vein(VENOUS["standing"], 10)
    assert low.area[0] == high.area[0] == 1.0
    assert (high.area[1:] >= low.area[1:]).all()
    assert high.find_pressure(0.5) > low.find_pressure(0.5) + 10.0
    assert np.isnan(low.find_pressure(0.0))


@pytest.mark.slow
def test_softer_tissue_lets_the_vein_close_at_less(lying):
    soft = press_vein(VENOUS["lying"], 10, MODULI["of volunteers"])
    assert soft.find_pressure(0.5) < lying.find_pressure(0.5) - 3.0


@pytest.mark.slow
def test_pressures_are_read_where_the_vein_counts_as_closed(lying, monkeypatch):
    monkeypatch.setattr(vein, "press_vein", lambda *_: lying)
    (row,) = measure_closing("lying", "of the scene", 10)
    assert row["predicted"] == lying.find_pressure(0.2)
    assert row["error"] == pytest.approx(row["predicted"] - 22.5)
