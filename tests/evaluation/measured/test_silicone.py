"""Compressed silicones: against published numbers and fits, other elements, and a made-up test."""

import json

import numpy as np
import pytest

from us_sim.errors import UsSimError
from us_sim.evaluation.measured.silicone import (
    COMPRESSIONS,
    HEIGHT,
    RADIUS,
    compute_slipping_force,
    find_index,
    predict_silicones,
    read_silicones,
    read_test,
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
    some = [find_index(compression) for compression in (0.2, 0.4, 0.6)]
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


def test_the_law_holds_until_silicones_stiffen(compressions):
    rows = list(predict_silicones(compressions / "data"))
    errors = {row["x"]: row["error"] for row in rows}
    assert max(errors[part] for part in (10.0, 20.0, 30.0)) < 8
    assert errors[66.0] > 30


def write_test(file, forces):
    rows = [
        f"0,{30 * part},{force},0,0,0,0" for part, force in zip(COMPRESSIONS, forces, strict=True)
    ]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("A title;\nTime (s),Compression (mm),Load (N)\n" + "\n".join(rows) + "\n")


def test_the_modulus_of_a_made_up_silicone_is_found_and_its_forces_predicted(tmp_path):
    for specimen in "AB":
        file = tmp_path / "EF" / f"EF_{specimen}1.csv"
        write_test(file, 5e3 * compute_slipping_force(COMPRESSIONS))
    assert max(row["error"] for row in predict_silicones(tmp_path)) < 0.2  # %


HEAD = "Time (s),Compression (mm),Load (N)\n"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("Compression test;\n", "no line"),
        (f"{HEAD}0,0,0\n1,heavy,2\n", "heavy"),
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
