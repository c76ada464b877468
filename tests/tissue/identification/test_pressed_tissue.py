"""Slopes of a press by its moduli: against presses with other moduli, and by their own law."""

import numpy as np
import pytest

from us_sim.geometry.pose import Pose
from us_sim.tissue.identification.press_model import PressModel

POSE = Pose([0.004, 0.003, 0.008], [0.05, 0.02, 0.0, 1.0])


@pytest.fixture(scope="module")
def felt(press):
    tissue = press.tissue

    def felt(moduli):
        return PressModel(tissue.model, tissue.materials_for, list(moduli), [POSE]).predict(moduli)

    return felt


def test_slopes_are_those_between_presses_with_other_moduli(press, felt):
    here, step = felt(press.moduli), 0.01
    for p, name in enumerate(press.moduli):
        more, less = (
            felt({**press.moduli, name: press.moduli[name] * np.exp(change)}).wrenches[0]
            for change in (step, -step)
        )
        between = (more - less) / (2 * step)
        assert np.allclose(here.slopes[0, :, p], between, atol=2e-3 * np.abs(between).max())


def test_all_moduli_twice_as_large_make_twice_the_force(press, felt):
    here = felt(press.moduli)
    twice = felt({name: 2 * modulus for name, modulus in press.moduli.items()})
    assert np.allclose(twice.wrenches, 2 * here.wrenches, rtol=1e-4, atol=1e-6)
    # Euler's theorem on homogeneous functions: the slopes add up to the function.
    assert np.allclose(here.slopes.sum(axis=2), here.wrenches, rtol=1e-3, atol=1e-4)
