"""Beads inside a box whose faces move as prescribed, predicted and measured."""

import gzip

import numpy as np
import pytest
from scipy.io import savemat
from scipy.sparse.linalg import spsolve
from scipy.spatial import KDTree

from us_sim.errors import UsSimError
from us_sim.evaluation.measured import hydrogel
from us_sim.evaluation.measured.hydrogel import (
    FILE,
    PrescribedBox,
    fit_near,
    grow_links,
    predict_beads,
    read_beads,
)
from us_sim.evaluation.tissue.finite_elements import NeoHookeanHexahedra
from us_sim.tissue.elasticity.material import Material

_SIZE = 1e-4  # m


def _length(vectors):
    return np.sqrt((vectors**2).sum(axis=1).mean())


@pytest.fixture
def _cube(monkeypatch):
    monkeypatch.setattr(hydrogel, "_LOWER", np.zeros(3))
    monkeypatch.setattr(hydrogel, "_UPPER", np.full(3, _SIZE))


@pytest.mark.usefixtures("_cube")
def test_faces_of_a_homogeneous_deformation_and_what_is_between_are_interpolated_exactly():
    random = np.random.default_rng(3)
    slope = np.array([[0.35, 0.2, 0.0], [-0.1, -0.3, 0.25], [0.05, 0.0, 0.15]])
    places = random.uniform(0, _SIZE, (4000, 3))
    depth = np.minimum(places, _SIZE - places).min(axis=1)
    near, inside = places[depth < 0.1 * _SIZE], places[depth >= 0.1 * _SIZE]
    box = PrescribedBox(near, near @ slope.T, _SIZE / 6)
    assert abs(box.interpolate_field(box.harmonic, inside) - inside @ slope.T).max() < 1e-5 * _SIZE


@pytest.mark.slow
@pytest.mark.usefixtures("_cube")
@pytest.mark.parametrize("ratio", [0.3, 0.48])
def test_an_inhomogeneous_deformation_is_that_of_quadratic_elements_of_another_program(
    ratio, monkeypatch
):
    def faces(points):
        """Pressed in around the middle of the top, as by an indenter."""
        x, y, z = (points / _SIZE).T
        dent = np.exp(-(((x - 0.5) ** 2 + (y - 0.4) ** 2) / 0.1)) * z**2
        return _SIZE * np.stack([0.4 * (x - 0.5) * dent, 0.3 * (y - 0.4) * dent, -0.3 * dent], 1)

    planes = np.linspace(0, _SIZE, 6)
    other = NeoHookeanHexahedra((planes, planes, planes), Material(1e3, ratio, 1e3))
    field = faces(other.nodes)
    inside = ((other.nodes > 1e-9) & (other.nodes < _SIZE - 1e-9)).all(axis=1)
    free = np.repeat(inside, 3)
    for _ in range(12):
        slope = -other.compute_forces(field).ravel()[free]
        matrix = other.assemble_stiffness(field).tocsc()[free][:, free]
        field[inside] += spsolve(matrix, slope).reshape(-1, 3)
    assert (
        abs(other.compute_forces(field)[inside]).max()
        < 1e-9 * abs(other.compute_forces(field)).max()
    )

    monkeypatch.setattr(hydrogel, "fit_near", lambda *of, **_: faces(of[2]))
    points = np.random.default_rng(0).uniform(0.1 * _SIZE, 0.9 * _SIZE, (400, 3))
    expected = other.interpolate_field(field, points)
    errors = []
    for cells in (8, 16):
        box = PrescribedBox(points, points, _SIZE / cells)
        errors.append(
            _length(box.interpolate_field(box.find_equilibrium(ratio), points) - expected)
        )
    mechanics = _length(box.interpolate_field(box.harmonic, points) - expected)
    assert errors[1] < 0.5 * errors[0]
    assert errors[1] < 0.1 * mechanics


@pytest.fixture(scope="module")
def real_file(shared_file):
    return shared_file(f"hydrogel-indentation/{FILE}")


@pytest.fixture(scope="module")
def beads(real_file):
    """Those of the real gel; to link them takes seconds."""
    return read_beads(real_file)


@pytest.mark.slow
def test_beads_of_the_real_gel_are_predicted(real_file, beads, monkeypatch):
    """Fitted on one side of the axis, judged on the other, by the noise of the measurement."""
    monkeypatch.setattr(hydrogel, "read_beads", lambda _: beads)
    harmonic, uniform, graded, *_ = (
        row["error"] / row["floor"] for row in predict_beads(real_file, 24e-6)
    )
    assert uniform < 0.6 * harmonic
    assert graded < 0.6 * uniform


def test_links_are_those_that_were_made_by_another_program(real_file, beads):
    with gzip.open(real_file.with_name("linked_beads.csv.gz"), "rt") as stream:
        other = np.genfromtxt(stream, delimiter=",", names=True)
    places = np.stack([other[name] for name in ("xA_px", "yA_px", "zA_px")], axis=1)
    moved = np.stack([other[name] for name in ("ux_px", "uy_px", "uz_px")], axis=1)
    mine, displacement = (vectors / 0.4e-6 for vectors in beads)
    distance, same = KDTree(places).query(mine)
    both = distance < 1e-3
    assert len(mine) > 23_000
    assert both.mean() > 0.98
    difference = abs(moved[same] - displacement).max(axis=1)[both]
    assert (difference < 1e-3).mean() > 0.995


def test_links_grow_through_a_deformation_in_which_nearest_beads_are_wrong_ones():
    random = np.random.default_rng(0)
    before = random.uniform(0, 80e-6, (3000, 3))
    z = before[:, 2:]
    order = random.permutation(3000)
    after = (before + np.array([0.5, -0.3, -0.2]) * z**2 / 160e-6)[order]
    truth = np.argsort(order)
    found = grow_links(before, after, np.where(before[:, 2] < 16e-6, truth, -1))
    linked = found >= 0
    assert linked.mean() > 0.97
    assert (found == truth)[linked].mean() > 0.995
    assert (KDTree(after).query(before)[1] == truth).mean() < 0.5


def test_a_quadratic_displacement_is_fitted_exactly():
    places = np.random.default_rng(0).uniform(0, _SIZE, (300, 3))
    moved = places[:, ::-1] * places / _SIZE + 0.1 * places
    points = np.full((1, 3), 0.4 * _SIZE)
    found = fit_near(places, moved, points, 45, degree=2)
    np.testing.assert_allclose(found, points * points / _SIZE + 0.1 * points, rtol=1e-6)


@pytest.mark.parametrize("content", [{"other": 1.0}, b"no such file", None])
def test_a_file_that_holds_no_beads_is_refused(tmp_path, content):
    file = tmp_path / FILE
    if isinstance(content, dict):
        savemat(file, content)
    elif content is not None:
        file.write_bytes(content)
    with pytest.raises(UsSimError, match="cannot be read"):
        read_beads(file)
