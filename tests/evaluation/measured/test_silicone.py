"""Compressed silicones: against published numbers and fits, other elements, and a made-up test."""

import json

import numpy as np
import pytest

from us_sim.errors import UsSimError
from us_sim.evaluation.measured.silicone import (
    COMPRESSIONS,
    HEIGHT,
    RADIUS,
    at,
    predict_silicones,
    read_silicones,
    read_test,
    slipping_force,
    sticking_force,
)


@pytest.fixture(scope="session")
def compressions(shared_file):
    return shared_file("ecoflex-compression")


@pytest.fixture(scope="session")
def silicones(compressions):
    return {silicone.name: silicone for silicone in read_silicones(compressions / "data")}


def mean_of(silicone):
    return np.concatenate([silicone.first, silicone.second]).mean(axis=0)


@pytest.mark.parametrize(
    ("name", "forces"),
    [
        ("EF10_50T", (0.95, 3.16, 5.54, 13.82, 35.19)),
        ("EF30_50T", (1.9, 6.46, 11.52, 29.09, 68.51)),
        ("EF10_100T", (0.47, 1.43, 2.5, 6.4, 17.85)),
        ("EF10_0T", (3.38, 11.66, 19.99, 48.4, 118.5)),
    ],
)
def test_forces_of_a_test_at_1_to_15_mm_are_those_known(silicones, name, forces):
    part = np.array([1.0, 3.0, 5.0, 10.0, 15.0]) * 1e-3 / HEIGHT
    first = silicones[name].first[0]
    assert np.interp(part, COMPRESSIONS, first) == pytest.approx(forces, rel=0.01, abs=0.006)


def test_published_fits_of_yeohs_law_give_the_forces(compressions, silicones):
    published = json.loads((compressions / "data/hyperelastic_parameters.json").read_text())
    assert len(silicones) == 19
    some = [at(compression) for compression in (0.2, 0.4, 0.6)]
    errors = []
    for name, silicone in silicones.items():
        first, second, third = published["engineering"][name]["Yeoh_o3"]["parameters"]  # kPa
        left = 1 - COMPRESSIONS
        invariant = left**2 + 2 / left - 3
        slope = 1e3 * (first + 2 * second * invariant + 3 * third * invariant**2)
        forces = np.pi * RADIUS**2 * 2 * slope * (left**-2 - left)
        errors.append(forces[some] / mean_of(silicone)[some] - 1)
    assert np.median(np.abs(errors)) < 0.03
    assert np.max(np.abs(errors)) < 0.15


def test_the_law_falls_less_behind_where_silicones_stiffen(compressions):
    rows = predict_silicones(compressions / "data", "slip", 8)
    errors = {row["quantity"].removeprefix("force at "): row["error"] for row in rows}
    assert max(errors[f"{part} %, slip, neo-Hookean"] for part in (10, 20, 30)) < 8
    assert errors["66 %, slip, neo-Hookean"] > 30
    assert errors["66 %, slip, stiffening, s from 60 %"] < 8


@pytest.mark.slow
def test_a_small_compression_of_a_cylinder_that_sticks_is_that_of_other_elements():
    skfem = pytest.importorskip("skfem")
    helpers = pytest.importorskip("skfem.helpers")
    # Half of the cylinder by symmetry, axisymmetric quadratic elements, finer towards the rim.
    shear, bulk_part = 1.0, 2 * 0.49 / (1 - 2 * 0.49)
    fine = 1 - (1 - np.linspace(0, 1, 17)) ** 2.5
    mesh = skfem.MeshQuad.init_tensor(RADIUS * fine, HEIGHT / 2 * fine)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementQuad2()), intorder=6)

    @skfem.BilinearForm
    def stiffness(u, v, w):
        radius = w.x[0]
        one, other = helpers.sym_grad(u), helpers.sym_grad(v)
        hoop, other_hoop = u[0] / radius, v[0] / radius
        swelling = (helpers.trace(one) + hoop) * (helpers.trace(other) + other_hoop)
        shearing = helpers.ddot(one, other) + hoop * other_hoop
        return (bulk_part * swelling + 2 * shear * shearing) * radius

    matrix = stiffness.assemble(basis)
    platen = basis.get_dofs(lambda x: np.isclose(x[1], HEIGHT / 2))
    axis = basis.get_dofs(lambda x: np.isclose(x[0], 0))
    middle = basis.get_dofs(lambda x: np.isclose(x[1], 0))
    held = np.unique(np.concatenate([platen.all(), axis.all(["u^1"]), middle.all(["u^2"])]))
    moved = np.zeros(matrix.shape[0])
    moved[platen.all(["u^2"])] = -HEIGHT / 2
    solved = skfem.solve(*skfem.condense(matrix, x=moved, D=held))
    expected = 2 * np.pi * float(solved @ (matrix @ solved)) / (HEIGHT / 2)  # N at strain 1
    errors = [sticking_force([1e-3], cells)[0] / 1e-3 / expected - 1 for cells in (6, 12)]
    assert 0.0 < errors[1] < 0.6 * errors[0] < 0.05


def write_test(file, forces):
    rows = [
        f"0,{30 * part},{force},0,0,0,0" for part, force in zip(COMPRESSIONS, forces, strict=True)
    ]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("A title;\nTime (s),Compression (mm),Load (N)\n" + "\n".join(rows) + "\n")


@pytest.mark.parametrize("platens", ["slip", pytest.param("stick", marks=pytest.mark.slow)])
def test_constants_of_a_made_up_silicone_are_found_and_its_forces_predicted(tmp_path, platens):
    for specimen in "AB":
        file = tmp_path / "EF" / f"EF_{specimen}1.csv"
        write_test(file, 5e3 * slipping_force(COMPRESSIONS, 0.4))
    rows = {row["quantity"]: row["error"] for row in predict_silicones(tmp_path, platens, 8)}
    assert rows[f"force at 10 %, {platens}, neo-Hookean"] < (0.2 if platens == "slip" else 2.0)  # %
    if platens == "slip":
        for compression in (40, 50, 66):
            assert rows[f"force at {compression} %, slip, stiffening, s from 60 %"] < 0.2
        assert rows["force at 66 %, slip, neo-Hookean"] > 30
        assert "force at 60 %, slip, stiffening, s from 60 %" not in rows  # it is fitted there


HEAD = "Time (s),Compression (mm),Load (N)\n"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("Compression test;\n", "no line"),
        (f"{HEAD}0,0,0\n1,heavy,2\n", ":3:"),
        (f"{HEAD}0,0,0\n1,3,2\n", "66 %"),
    ],
)
def test_a_file_that_is_no_test_is_refused(tmp_path, text, word):
    file = tmp_path / "EF" / "EF_A1.csv"
    file.parent.mkdir()
    with pytest.raises(UsSimError, match="specimens A and B"):
        read_silicones(tmp_path)
    file.write_text(text)
    with pytest.raises(UsSimError, match=f"EF_A1.csv.*{word}"):
        read_test(file)
