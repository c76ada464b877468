"""Beads inside a box whose faces move as prescribed, predicted and measured."""

import gzip

import numpy as np
import pytest
from scipy.sparse.linalg import spsolve

from us_sim.errors import UsSimError
from us_sim.evaluation.measured.hydrogel import (
    Beads,
    Case,
    PrescribedBox,
    local_fit,
    noise_floor,
    outcome,
    read_beads,
)
from us_sim.tissue.elasticity.material import Material

_SIZE = 1e-4  # m
_LOWER, _UPPER = np.zeros(3), np.full(3, _SIZE)
_HEAD = (
    "xA_px,yA_px,zA_px,ux_px,uy_px,uz_px,local_affine_residual_px,"
    "linked_fraction_of_24_neighbours,local_detF\n"
)


def _length(vectors):
    return np.sqrt((vectors**2).sum(axis=1).mean())


def test_beads_of_a_large_homogeneous_deformation_are_predicted_exactly():
    random = np.random.default_rng(3)
    slope = np.array([[0.35, 0.2, 0.0], [-0.1, -0.3, 0.25], [0.05, 0.0, 0.15]])
    places = random.uniform(0, _SIZE, (4000, 3))
    beads = Beads(places, places @ slope.T, np.full(4000, np.linalg.det(np.eye(3) + slope)))
    depth = np.minimum(places, _SIZE - places).min(axis=1)
    near, inside = beads[depth < 0.1 * _SIZE], beads[depth >= 0.1 * _SIZE]
    box = PrescribedBox(
        *(_LOWER, _UPPER, _SIZE / 6), lambda points: local_fit(near, points, 45, quadratic=True)
    )
    field = box.nonlinear(0.48)
    assert abs(box.at(field, inside.places) - inside.displacement).max() < 1e-5 * _SIZE
    assert box.volume_ratio(field, places[:50]) == pytest.approx(beads.volume_ratio[:50])
    assert _length(noise_floor(beads, random)) < 1e-9 * _SIZE


@pytest.mark.parametrize("ratio", [0.3, 0.48])
def test_an_inhomogeneous_deformation_is_that_of_quadratic_elements_of_another_program(ratio):
    elements = pytest.importorskip("us_sim.evaluation.tissue.finite_elements")

    def faces(points):
        """Pressed in around the middle of the top, as by an indenter."""
        x, y, z = (points / _SIZE).T
        dent = np.exp(-(((x - 0.5) ** 2 + (y - 0.4) ** 2) / 0.1)) * z**2
        return _SIZE * np.stack([0.4 * (x - 0.5) * dent, 0.3 * (y - 0.4) * dent, -0.3 * dent], 1)

    planes = np.linspace(0, _SIZE, 6)
    other = elements.NeoHookeanHexahedra((planes, planes, planes), Material(1e3, ratio, 1e3))
    field = faces(other.nodes)
    inside = ((other.nodes > 1e-9) & (other.nodes < _SIZE - 1e-9)).all(axis=1)
    free = np.repeat(inside, 3)
    for _ in range(12):
        slope = -other.forces(field).ravel()[free]
        matrix = other.stiffness(field).tocsc()[free][:, free]
        field[inside] += spsolve(matrix, slope).reshape(-1, 3)
    assert abs(other.forces(field)[inside]).max() < 1e-9 * abs(other.forces(field)).max()

    points = np.random.default_rng(0).uniform(0.1 * _SIZE, 0.9 * _SIZE, (400, 3))
    expected = other.at(field, points)
    errors = []
    for cells in (8, 16):
        box = PrescribedBox(_LOWER, _UPPER, _SIZE / cells, faces)
        errors.append(_length(box.at(box.nonlinear(ratio), points) - expected))
    mechanics = _length(box.at(box.harmonic, points) - expected)
    assert errors[1] < 0.5 * errors[0]
    assert errors[1] < 0.1 * mechanics
    assert errors[1] < 0.5 * _length(box.at(box.linear(ratio), points) - expected)


def test_beads_of_the_real_gel_are_predicted(shared_file):
    """Fitted on one side of the axis, judged on the other, by the noise of the measurement."""
    beads = read_beads(shared_file("hydrogel-indentation/linked_beads.csv.gz"))
    floor = noise_floor(beads, np.random.default_rng(1))
    low = outcome(Case(beads, 60e-6), floor, 24e-6)
    whole = low.parts["all"]
    assert np.median(low.beads.volume_ratio) > 0.99
    assert low.part(whole, "nonlinear") <= 1.5 * low.part_floor(whole)
    tall = Case(beads, 92e-6)
    box = tall.box(24e-6)
    harmonic, uniform, graded = (
        _length(tall.error(box, field)[tall.judged])
        for field in (box.harmonic, box.nonlinear(0.49), box.nonlinear(0.46, 5e4))
    )
    assert uniform < 0.6 * harmonic
    assert graded < 0.6 * uniform


@pytest.mark.filterwarnings("ignore:genfromtxt")
@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("xA_px,yA_px\n1,2\n", "no column zA_px"),
        (_HEAD + "1,2,3,0,0,0,0,1,1\n1,2,three,0,0,0,0,1,1\n", "row 3 .* no number"),
        (_HEAD + "1,2,3,0,0,0,0,1,1\n1,2,3\n", "cannot be read"),
        (_HEAD + "1,2,3,0,0,0,0,1,1\n", "1 well linked beads are too few"),
        ("", "cannot be read|no column"),
    ],
)
def test_a_malformed_table_is_refused(tmp_path, text, problem):
    file = tmp_path / "beads.csv.gz"
    file.write_bytes(gzip.compress(text.encode()))
    with pytest.raises(UsSimError, match=problem):
        read_beads(file)


@pytest.mark.parametrize("content", [b"no gzip", gzip.compress(bytes(5000))[:20], None])
def test_a_broken_file_is_refused(tmp_path, content):
    file = tmp_path / "beads.csv.gz"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(UsSimError, match="cannot be read"):
        read_beads(file)
