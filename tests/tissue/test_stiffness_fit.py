"""Moduli of a known press are found within their intervals; what is no press is refused."""

from dataclasses import replace

import numpy as np
import pytest
from tissue_block import block_mesh

from us_sim.errors import CalibrationError
from us_sim.geometry.collider import Sphere
from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import LabelFractions, average_over_labels
from us_sim.tissue.model import TissueModel, face_nodes
from us_sim.tissue.stiffness_fit import (
    RecordedPress,
    StiffnessSettings,
    compute_half_widths,
    fit_stiffness,
    pair_press,
    simulate_wrenches,
)

TRUE = {"fat": 6e3, "muscle": 18e3}  # Pa
START = {"fat": 10e3, "muscle": 10e3}
TARE = np.array([0.3, -0.2, 0.5, 0.01, 0.0, 0.02])  # N and N m, which the sensor adds
FEW = StiffnessSettings(poses=14)
MESH = block_mesh((6, 6, 5))


def constants(moduli):
    """Fat over muscle, the border aslant."""
    centre = MESH.nodes[MESH.tetrahedra].mean(axis=1)
    muscle = centre[:, 2] > 0.03 + 0.3 * centre[:, 0]
    fractions = LabelFractions(np.arange(2, dtype=np.uint8), np.eye(2)[muscle.astype(int)])
    return average_over_labels(
        fractions, {k: Material(moduli[name], 0.45) for k, name in enumerate(TRUE)}
    )


MODEL = TissueModel(
    MESH,
    constants(START),
    np.isin(np.arange(len(MESH.nodes)), face_nodes(MESH, "bottom")),
    Sphere(0.05),
    face_nodes(MESH, "top"),
)


@pytest.fixture(scope="module")
def press():
    """Three seconds in which the probe comes down, slides along and lifts."""
    times = np.linspace(0.0, 3.0, 31)
    depths = 0.012 * np.sin(np.pi * times / 3) ** 2 - 0.002
    places = np.column_stack([0.03 * np.cos(1.5 * times), 0.0 * times, depths])
    poses = [Pose(place) for place in places]
    felt = simulate_wrenches(replace(MODEL, materials=constants(TRUE)), poses, depths)
    return RecordedPress(times, poses, felt + TARE)


@pytest.mark.slow
def test_moduli_are_found_within_their_intervals(press):
    noise = 0.01 * np.repeat(np.abs(press.wrenches).reshape(-1, 2, 3).max(axis=(0, 2)), 3)
    errors = np.random.default_rng(1).normal(size=press.wrenches.shape) * noise
    found = fit_stiffness(
        MODEL, constants, START, replace(press, wrenches=press.wrenches + errors), FEW
    )
    for name, true in TRUE.items():
        assert found.moduli[name] == pytest.approx(true, rel=0.05)
        factor = found.factors[name]
        assert 1.0 < factor < 1.3
        assert true / factor < found.moduli[name] < true * factor
    np.testing.assert_allclose(found.offset, TARE, atol=4 * noise.max())


@pytest.mark.slow
def test_what_no_force_tells_is_refused_by_name(press):
    def with_bone(moduli):
        made = constants(moduli)
        modulus = made.young_modulus.copy()
        modulus[-1] = moduli["bone"]  # in a corner of the face that is held
        return replace(made, young_modulus=modulus)

    errors = np.random.default_rng(2).normal(scale=0.01, size=press.wrenches.shape)
    noisy = replace(press, wrenches=press.wrenches + errors)
    with pytest.raises(CalibrationError, match="--keep bone"):
        fit_stiffness(MODEL, with_bone, {**TRUE, "bone": 1e5}, noisy, FEW)


@pytest.mark.parametrize(
    ("change", "settings", "word"),
    [
        (lambda press: replace(press, wrenches=TARE - press.wrenches), FEW, "sign"),
        (lambda press: replace(press, poses=[Pose([0, 0, -0.01])] * 31), FEW, "registration"),
        (lambda press: press, replace(FEW, keep=("lung",)), "--keep"),
        (lambda press: press, replace(FEW, keep=("fat", "muscle")), "--keep"),
    ],
)
def test_what_is_no_press_of_this_tissue_is_refused(press, change, settings, word):
    with pytest.raises(CalibrationError, match=word):
        fit_stiffness(MODEL, constants, START, change(press), settings)


def test_poses_get_the_wrench_that_is_nearest_in_time():
    stamps = np.arange(20) * 100_000_000
    poses, wrenches = [Pose()] * 20, np.arange(120.0).reshape(20, 6)
    late = replace(FEW, time_offset=0.05)
    made = pair_press(stamps, poses, stamps[::-1] + 52_000_000, wrenches, late)
    np.testing.assert_array_equal(made.wrenches, wrenches[::-1])
    for felt_at, felt, word in (
        (stamps + 52_000_000, wrenches, "clock"),
        (stamps, np.ones((20, 6)), "never"),
        (stamps, np.full((20, 6), np.nan), "finite"),
    ):
        with pytest.raises(CalibrationError, match=word):
            pair_press(stamps, poses, felt_at, felt, FEW)


def test_intervals_are_those_of_linear_regression_or_wider():
    random = np.random.default_rng(3)
    inside = 0
    for _ in range(200):
        slopes = random.normal(size=(160, 2))
        left = random.normal(size=160)
        error = np.linalg.lstsq(slopes, left, rcond=None)[0]
        widths = compute_half_widths(slopes, left - slopes @ error)
        inside += (np.abs(error) < widths).sum()
        assert widths.max() < 0.5  # 2.36 / sqrt(160) is 0.19
    assert inside >= 0.95 * 400
    assert compute_half_widths(np.eye(160)[:, :1] * 0.0 + [[1.0, 0.0]], left)[1] > 100
