"""Beads inside a box whose faces move as prescribed, predicted and measured."""

import gzip

import numpy as np
import pytest
from scipy.io import savemat
from scipy.sparse.linalg import spsolve
from scipy.spatial import KDTree

from us_sim.errors import UsSimError
from us_sim.evaluation.measured.beads import FILE, Beads, grow_links, read_beads
from us_sim.evaluation.measured.hydrogel import (
    Case,
    PrescribedBox,
    faces_fit,
    noise_floor,
    predict_beads,
)
from us_sim.tissue.elasticity.material import Material

_SIZE = 1e-4  # m
_LOWER, _UPPER = np.zeros(3), np.full(3, _SIZE)


def _length(vectors):
    return np.sqrt((vectors**2).sum(axis=1).mean())


@pytest.mark.slow
def test_beads_of_a_large_homogeneous_deformation_are_predicted_exactly():
    random = np.random.default_rng(3)
    slope = np.array([[0.35, 0.2, 0.0], [-0.1, -0.3, 0.25], [0.05, 0.0, 0.15]])
    places = random.uniform(0, _SIZE, (4000, 3))
    beads = Beads(places, places @ slope.T, np.full(4000, np.linalg.det(np.eye(3) + slope)))
    depth = np.minimum(places, _SIZE - places).min(axis=1)
    near, inside = beads[depth < 0.1 * _SIZE], beads[depth >= 0.1 * _SIZE]
    box = PrescribedBox(*(_LOWER, _UPPER, _SIZE / 6), lambda points: faces_fit(near, points))
    field = box.nonlinear(0.48)
    assert abs(box.at(field, inside.places) - inside.displacement).max() < 1e-5 * _SIZE
    assert box.volume_ratio(field, places[:50]) == pytest.approx(beads.volume_ratio[:50])
    assert _length(noise_floor(beads, random)) < 1e-9 * _SIZE


@pytest.mark.slow
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


def test_springs_are_hookes_law_of_poissons_ratio_a_quarter_where_strains_are_small():
    def faces(points):
        x, y, z = (points / _SIZE).T
        dent = 1e-4 * _SIZE * np.exp(-(((x - 0.5) ** 2 + (y - 0.4) ** 2) / 0.1)) * z**2
        return np.stack([0 * x, 0 * x, -dent], axis=1)

    box = PrescribedBox(_LOWER, _UPPER, _SIZE / 10, faces)
    alone = box.springs(0.45)
    assert _length(alone - box.linear(0.25)) < 0.5 * _length(alone - box.linear(0.45))


@pytest.fixture(scope="module")
def real_file(shared_file):
    return shared_file(f"hydrogel-indentation/{FILE}")


@pytest.fixture(scope="module")
def beads(real_file):
    """Those of the real gel; to link them takes seconds."""
    return read_beads(real_file)


@pytest.mark.slow
def test_beads_of_the_real_gel_are_predicted(beads):
    """Fitted on one side of the axis, judged on the other, by the noise of the measurement."""
    floor = noise_floor(beads, np.random.default_rng(1))
    rows = [row for row in predict_beads(Case(beads, 60e-6), floor, 24e-6) if "all" in row["case"]]
    errors = {row["line"]: row["error"] / row["floor"] for row in rows}
    assert rows[0]["det_measured"] > 0.99
    assert errors["nonlinear"] <= 1.5
    assert abs(errors["linear, graded"] - errors["nonlinear, graded"]) < 0.1
    tall = Case(beads, 92e-6)
    box = tall.box(24e-6)
    harmonic, uniform, graded = (
        _length(tall.error(box, field)[tall.judged])
        for field in (box.harmonic, box.nonlinear(0.49), box.nonlinear(0.46, 5e4))
    )
    assert uniform < 0.6 * harmonic
    assert graded < 0.6 * uniform


def test_links_are_those_that_were_made_by_another_program(real_file, beads):
    with gzip.open(real_file.with_name("linked_beads.csv.gz"), "rt") as stream:
        other = np.genfromtxt(stream, delimiter=",", names=True)
    places = np.stack([other[name] for name in ("xA_px", "yA_px", "zA_px")], axis=1)
    moved = np.stack([other[name] for name in ("ux_px", "uy_px", "uz_px")], axis=1)
    distance, same = KDTree(places).query(beads.places / 0.4e-6)
    both = distance < 1e-3
    assert len(beads.places) > 24_000
    assert both.mean() > 0.98
    difference = abs(moved[same] - beads.displacement / 0.4e-6).max(axis=1)[both]
    assert (difference < 1e-3).mean() > 0.998
    assert abs(np.median(other["local_detF"][same] - beads.volume_ratio)) < 2e-3


def test_links_grow_through_a_deformation_in_which_nearest_beads_are_wrong_ones():
    random = np.random.default_rng(0)
    before = random.uniform(0, 200, (3000, 3))
    z = before[:, 2:]
    order = random.permutation(3000)
    after = (before + np.array([0.5, -0.3, -0.2]) * z**2 / 400)[order]
    truth = np.argsort(order)
    found = grow_links(before, after, np.where(before[:, 2] < 40, truth, -1))
    linked = found >= 0
    assert linked.mean() > 0.97
    assert (found == truth)[linked].mean() > 0.995
    assert (KDTree(after).query(before)[1] == truth).mean() < 0.5


def _content(**changed):
    places = np.random.default_rng(0).uniform(0, 100, (1500, 3))
    links = np.arange(1, 1501)[:, None]
    content = {"before": places, "after": places, "links": links} | changed
    both, single = np.empty((1, 2), dtype=object), np.empty((1, 1), dtype=object)
    both[0, 0], both[0, 1], single[0, 0] = content["before"], content["after"], content["links"]
    return {"parCoord_prev": both, "track_A2B_prev": single}


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ({"other": 1.0}, "parCoord_prev"),
        (_content(links=np.ones((7, 1))), "7 links"),
        (_content(after=np.full((1500, 3), np.nan)), "not finite"),
        (_content(links=np.zeros((1500, 1))), "too few"),
        (b"no such file", "cannot be read"),
        (None, "cannot be read"),
    ],
)
def test_a_file_that_holds_no_beads_is_refused(tmp_path, content, problem):
    file = tmp_path / FILE
    if isinstance(content, dict):
        savemat(file, content)
    elif content is not None:
        file.write_bytes(content)
    with pytest.raises(UsSimError, match=problem):
        read_beads(file)
