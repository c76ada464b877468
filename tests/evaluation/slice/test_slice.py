"""`us-sim evaluate slice` in small: its measures, its files, and its sentences when it cannot."""

import csv
import re
from dataclasses import replace

import numpy as np
import pytest

from us_sim.command.main import main
from us_sim.evaluation.slice import report as evaluation
from us_sim.evaluation.slice.cases import (
    Case,
    exact_slice,
    sampled,
    speckle,
    voxel_distance,
)
from us_sim.evaluation.slice.measure import (
    SLICING_METHODS,
    VtkSlicer,
    compare,
)
from us_sim.settings.registry import SLICERS
from us_sim.volume.volume import Volume

COLUMNS = {
    *("method", "size", "nodes", "tets", "threads", "ms_median", "ms_p99", "coverage_mismatch_px"),
    *("max_grey_difference", "mean_grey_difference", "max_voxel_error", "deformation", "plane"),
    *("cpu_ms_median", "images"),
}
SMALL = Case(48, (6, 5, 5), "pressed_12mm", "straight")


@pytest.fixture(scope="module")
def block():
    """A small case with its mesh, first frame, volume, and what the image must show."""
    mesh, frame = SMALL.mesh(), replace(SMALL, plane="oblique").frames(1)[0]
    volume = speckle()
    exact = exact_slice(volume, mesh.nodes, mesh.tetrahedra, frame.nodes, frame.plane)
    return mesh, frame, volume, exact


@pytest.mark.slow
def test_the_reference_of_an_affine_deformation_is_its_inverse():
    mesh, plane = SMALL.mesh(), replace(SMALL, plane="corner").frames(1)[0].plane
    stretch = np.array([[1.1, 0.05, 0.0], [0.0, 0.9, 0.1], [-0.05, 0.0, 0.8]])
    move = np.array([0.002, -0.001, 0.003])
    volume = speckle()
    exact = exact_slice(volume, mesh.nodes, mesh.tetrahedra, mesh.nodes @ stretch.T + move, plane)
    rest = (plane.pixels() - move) @ np.linalg.inv(stretch).T
    inside = ((rest > [-0.1, -0.05, 0]) & (rest < [0.1, 0.05, 0.1])).all(axis=-1)
    was = ((plane.pixels() > [-0.1, -0.05, 0]) & (plane.pixels() < [0.1, 0.05, 0.1])).all(axis=-1)
    assert np.array_equal(exact.tissue, inside)
    assert 0.3 < inside.mean() < 1.0
    np.testing.assert_allclose(exact.rest[inside], rest[inside], atol=1e-15)
    assert np.array_equal(np.isnan(exact.rest[..., 0]), was & ~inside)
    np.testing.assert_allclose(exact.grey[inside], sampled(volume, rest)[inside], atol=1e-6)


def test_sampling_is_trilinear_and_ends_at_the_outer_voxels_faces():
    voxels = np.zeros((2, 2, 2), dtype=np.uint8)
    voxels[1, 1, 1] = 200
    volume = Volume(voxels, np.eye(4))
    places = np.array([[[0.5, 0.5, 1.0], [1.4, 1.4, 1.4], [1.6, 1.0, 1.0], [np.nan] * 3]])
    assert sampled(volume, places)[0] == pytest.approx([50.0, 200.0, 0.0, 0.0])


def test_vtk_finds_what_the_reference_finds(block):
    mesh, frame, volume, exact = block
    vtk = VtkSlicer(volume, mesh.nodes, mesh.tetrahedra)
    image, rest = (
        vtk.image(frame.nodes, frame.plane),
        vtk.rest_coordinates(frame.nodes, frame.plane),
    )
    errors = compare(volume, frame, exact, image, rest, tissue_only=True)
    assert errors["coverage_mismatch_px"] <= 4  # it takes some pixels beside the surface along
    assert errors["max_voxel_error"] < 0.02
    assert errors["max_grey_difference"] <= 1


def test_errors_of_a_known_image_are_what_they_are_by_hand(block):
    _, frame, volume, exact = block
    image, rest = np.rint(exact.grey).astype(np.uint8), exact.rest.copy()
    assert list(compare(volume, frame, exact, image, rest).values())[:-1] == [0, 0, 0, 0]
    row, column = np.argwhere(exact.tissue & (image < 200))[100]
    image[row, column] += 7
    rest[row, column] += volume.index_to_patient[:3, :3] @ [0.03, 0.0, 0.04]
    errors = compare(volume, frame, exact, image, rest)
    assert list(errors.values())[:-1] == [0, 7.0, *map(pytest.approx, (7 / image.size, 0.05))]


def test_each_kind_of_wrong_coverage_is_counted(block):
    _, frame, volume, exact = block
    image = np.rint(exact.grey).astype(np.uint8)
    pixels = frame.plane.pixels()
    moved = exact.tissue & (voxel_distance(volume, exact.rest, pixels) > 1.0)
    black = np.isnan(exact.rest[..., 0])
    missed, rigid, ghost = exact.rest.copy(), exact.rest.copy(), exact.rest.copy()
    missed[tuple(np.argwhere(moved)[:3].T)] = np.nan
    rigid[moved] = pixels[moved]
    ghost[black] = pixels[black]
    for rest, wrong in ((missed, 3), (rigid, moved.sum()), (ghost, black.sum())):
        assert wrong > 0
        assert compare(volume, frame, exact, image, rest)["coverage_mismatch_px"] == wrong


@pytest.mark.slow
def test_rows_plots_and_report_are_written(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluation, "MAIN", SMALL)
    monkeypatch.setattr(evaluation, "SHOWN", (SMALL,))
    monkeypatch.setattr(evaluation, "cases", lambda _: [SMALL, replace(SMALL, size=24)])
    monkeypatch.setattr(evaluation, "_seconds", lambda *_: 0.0)
    out = tmp_path / "slices"
    assert main(["evaluate", "slice", "--quick", "--out", str(out)]) == 0
    with (out / "slice.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert set(rows[0]) == COLUMNS
    assert {row["method"] for row in rows} == set(SLICING_METHODS)
    for row in rows:
        if row["method"] in SLICERS.names:
            assert row["coverage_mismatch_px"] == "0"
            assert float(row["max_grey_difference"]) <= 1
            assert float(row["max_voxel_error"]) < 0.1
    assert len(rows) == 2 * 7
    report = (out / "slice.md").read_text(encoding="utf-8")
    assert "$" not in report
    for picture in re.findall(r"\]\((\S+\.png)\)", report):
        assert (out / picture).stat().st_size > 10_000
    assert "Recorded frames" not in report
