"""`us-sim evaluate slice` in small: its measures, its files, and its sentences when it cannot."""

import csv
import re
from dataclasses import replace

import numpy as np
import pytest

from us_sim.command.main import main
from us_sim.evaluation.block import make_block_mesh as box
from us_sim.evaluation.slice import report as evaluation
from us_sim.evaluation.slice.cases import SliceCase, make_speckle
from us_sim.evaluation.slice.measure import VtkSlicer, compare_images, measure_case
from us_sim.settings.registry import SLICERS
from us_sim.slicing.cutting.slicer import create_slicer

COLUMNS = {
    *("method", "size", "nodes", "tets", "threads", "ms_median", "ms_p99", "coverage_mismatch_px"),
    *("max_grey_difference", "mean_grey_difference", "max_voxel_error", "deformation", "plane"),
    *("cpu_ms_median", "images"),
}
SMALL = SliceCase(48, (6, 5, 5), "pressed_12mm", "straight")


@pytest.fixture(scope="module")
def block():
    """A small case with its mesh, first frame, volume, and what the image must show."""
    mesh, frame = box(SMALL.counts), replace(SMALL, plane="oblique").make_frames(1)[0]
    slicer = create_slicer("per_pixel", make_speckle(), mesh.nodes, mesh.tetrahedra)
    where = frame.nodes, frame.plane
    return (
        mesh,
        frame,
        make_speckle(),
        (slicer.cut_image(*where), slicer.compute_rest_coordinates(*where)),
    )


@pytest.mark.slow
def test_vtk_finds_what_the_reference_finds(block):
    mesh, frame, volume, exact = block
    vtk, where = VtkSlicer(volume, mesh.nodes, mesh.tetrahedra), (frame.nodes, frame.plane)
    found = vtk.cut_image(*where), vtk.compute_rest_coordinates(*where)
    errors = compare_images(volume, frame, exact, *found, tissue_only=True)
    assert errors["coverage_mismatch_px"] <= 4  # it takes some pixels beside the surface along
    assert errors["max_voxel_error"] < 0.02
    assert errors["max_grey_difference"] <= 1


@pytest.mark.slow
def test_errors_of_a_known_image_are_what_they_are_by_hand(block):
    _, frame, volume, (grey, places) = block
    image, rest = grey.copy(), places.copy()
    assert list(compare_images(volume, frame, block[3], image, rest).values()) == [0, 0, 0, 0]
    shown, black = np.isfinite(rest[..., 0]), np.isnan(rest[..., 0])
    row, column = np.argwhere(shown & (image < 200))[100]
    image[row, column] += 7
    rest[row, column] += volume.index_to_patient[:3, :3] @ [0.03, 0.0, 0.04]
    errors = compare_images(volume, frame, block[3], image, rest)
    assert list(errors.values()) == [0, 7, *map(pytest.approx, (7 / image.size, 0.05))]
    rest[tuple(np.argwhere(shown)[:3].T)] = np.nan  # missed
    rest[tuple(np.argwhere(black)[:2].T)] = 0.0  # a ghost
    rest[tuple(np.argwhere(shown)[5])] += volume.index_to_patient[:3, :3] @ [0.2, 0.0, 0.0]
    assert compare_images(volume, frame, block[3], image, rest)["coverage_mismatch_px"] == 3 + 2 + 1


@pytest.mark.slow
def test_rows_plots_and_report_are_written(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluation, "MAIN", SMALL)
    monkeypatch.setattr(evaluation, "list_cases", lambda _: [SMALL, replace(SMALL, size=24)])
    monkeypatch.setattr(evaluation, "measure_case", lambda case, _: measure_case(case, 0.0))
    out = tmp_path / "slices"
    assert main(["evaluate", "slice", "--quick", "--out", str(out)]) == 0
    with (out / "slice.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert set(rows[0]) == COLUMNS
    assert {row["method"] for row in rows} == {"vtk", *SLICERS.names}
    for row in rows:
        if row["method"] in SLICERS.names:
            assert row["coverage_mismatch_px"] == "0"
            assert float(row["max_grey_difference"]) <= 1
            assert float(row["max_voxel_error"]) < 0.1
    assert len(rows) == 2 * 4
    report = (out / "slice.md").read_text(encoding="utf-8")
    assert "$" not in report
    for picture in re.findall(r"\]\((\S+\.png)\)", report):
        assert (out / picture).stat().st_size > 10_000
