"""`us-sim evaluate slice` in small: its measures, its files, and its sentences when it cannot."""

import csv
import importlib.util
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from us_sim.command.main import main
from us_sim.evaluation.block import LARGEST_MESH, MESHES
from us_sim.evaluation.processes import peak_memory, publishing_ms
from us_sim.evaluation.slice import measure as slice_vtk
from us_sim.evaluation.slice import report as evaluation
from us_sim.evaluation.slice.cases import (
    DEPTHS,
    MAIN,
    PLANES,
    SIZES,
    Case,
    Frame,
    black_and_white,
    cases,
    dented,
    exact_slice,
    sampled,
    speckle,
    voxel_distance,
)
from us_sim.evaluation.slice.measure import (
    SLICING_METHODS,
    Point,
    VtkSlicer,
    compare,
    timed_together,
)
from us_sim.evaluation.slice.report import targets
from us_sim.settings.choice import Option
from us_sim.settings.registry import SLICERS
from us_sim.volume.volume import Volume

COLUMNS = (
    "method,size,nodes,tets,threads,ms_median,ms_p99,coverage_mismatch_px,max_grey_difference,"
    "mean_grey_difference,max_voxel_error"
)
SMALL = Case(48, (6, 5, 5), "pressed_12mm", "straight")


@pytest.fixture(scope="module")
def block():
    """A small case with its mesh, first frame, volume, and what the image must show."""
    mesh, frame = SMALL.mesh(), replace(SMALL, plane="oblique").frames(1)[0]
    volume = speckle()
    exact = exact_slice(volume, mesh.nodes, mesh.tetrahedra, frame.nodes, frame.plane)
    return mesh, frame, volume, exact


def point(method, ms, size=512, nodes=8192, threads=1, **fields):
    known = {"coverage_mismatch_px": 0, "max_grey_difference": 1.0} | fields
    return Point(
        *(method, size, nodes, 5 * nodes, threads, ms, ms),
        deformation=MAIN.deformation,
        plane=MAIN.plane,
        cpu_ms_median=ms,
        **known,
    )


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
    assert vtk.filter_ms > 0 < vtk.sampling_ms


def test_errors_of_a_known_image_are_what_they_are_by_hand(block):
    _, frame, volume, exact = block
    image, rest = np.rint(exact.grey).astype(np.uint8), exact.rest.copy()
    assert set(compare(volume, frame, exact, image, rest).values()) == {0}
    row, column = np.argwhere(exact.tissue & (image < 200))[100]
    image[row, column] += 7
    rest[row, column] += volume.index_to_patient[:3, :3] @ [0.03, 0.0, 0.04]
    errors = compare(volume, frame, exact, image, rest)
    assert list(errors.values()) == [0, 7.0, *map(pytest.approx, (7 / image.size, 0.05))]


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


def test_black_and_white_shows_where_an_image_really_comes_from(block):
    _, frame, volume, exact = block
    right = np.rint(exact.grey).astype(np.uint8)
    off = exact.rest + volume.index_to_patient[:3, :3] @ [0.0, 0.1, 0.0]
    contrast = black_and_white()
    shown, seen = sampled(contrast, exact.rest), np.rint(sampled(contrast, off)).astype(np.uint8)
    errors = compare(volume, frame, exact, right, exact.rest, (shown, seen))
    assert errors["max_voxel_error"] == pytest.approx(0.1, abs=0.01)


def test_the_evaluated_methods_are_those_of_the_package_and_vtk():
    built_in = {name for name, option in SLICERS.options.items() if option.package is None}
    assert set(SLICING_METHODS) == {*built_in, "vtk"}


def test_methods_take_turns():
    order = []

    class Ours:
        def image(self, *_):
            order.append("a")

    class Theirs(VtkSlicer):
        filter_ms = 1.0

        def __init__(self):
            pass

        def image(self, *_):
            order.append("b")
            self.sampling_ms = len(order)

    frame = Frame(None, None)
    timing, other = timed_together([Ours(), Theirs()], [frame], 0.0)
    assert order == (["a"] * 5 + ["b"] * 5) * 3
    assert timing["images"] == 15
    assert 0.0 <= timing["ms_median"] <= timing["ms_p99"]
    assert other["filter_ms"] == 1.0
    assert other["sampling_ms"] == np.median([range(6, 11), range(16, 21), range(26, 31)])


@pytest.mark.slow
def test_no_dent_turns_a_tetrahedron_inside_out():
    for counts in (*MESHES, LARGEST_MESH):
        mesh = Case(64, counts, "rest", "straight").mesh()
        for depth in DEPTHS.values():
            corners = dented(mesh.nodes, depth)[mesh.tetrahedra]
            now = np.linalg.det(corners[:, 1:] - corners[:, :1])
            assert (now / (6 * mesh.volumes)).min() > 0.4


def test_the_plane_along_faces_holds_whole_faces():
    for counts in MESHES:
        case = Case(64, counts, "rest", "faces")
        heights = case.mesh().nodes @ case.frames(1)[0].plane.to_pixel[2, :3]
        heights += case.frames(1)[0].plane.to_pixel[2, 3]
        assert (np.abs(heights) < 1e-9).sum() == counts[0] * counts[2]


def test_the_full_plan_has_every_size_mesh_deformation_and_plane():
    full = cases(quick=False)
    meshes = [*MESHES, LARGEST_MESH]
    assert {(c.size, c.counts) for c in full} == {(s, m) for s in SIZES for m in meshes}
    assert {(c.deformation, c.counts) for c in full} == {(d, m) for d in DEPTHS for m in meshes}
    assert {(c.deformation, c.plane) for c in full} == {(d, p) for d in DEPTHS for p in PLANES}
    assert full[0] == MAIN == cases(quick=True)[0]
    assert {c.size for c in cases(quick=True)} == set(SIZES)


def test_what_is_asked_is_held_against_what_was_seen():
    points = [
        *(point("scan_conversion", ms, nodes=n) for ms, n in ((1.5, 2000), (1.8, 8192))),
        point("scan_conversion", 2.4, nodes=65536, max_grey_difference=2.0),
        point("scan_conversion", 1.3, threads=2),
        *(point("scan_conversion", ms, size=size) for ms, size in ((0.45, 256), (7.2, 1024))),
        point("row_subdivision", 9.9),
        point("vtk", 36.0, coverage_mismatch_px=15),
    ]
    seen = [(t.seen, t.met) for t in targets(points, 512**3 + 299 * 10**6, 0.5)]
    assert seen == [
        ("1.80 ms", True),
        ("1.30 ms", False),
        ("20.0", True),
        ("5.5", True),
        ("0", True),
        ("2", False),
        ("1.60", False),
        ("1.00", True),
        ("299 MB", True),
        ("0.50 ms", True),
    ]
    assert all(t.met is None for t in targets([], None, None))
    slow = replace(point("vtk", 300.0), cpu_ms_median=27.0)
    assert targets([points[1], slow], None, None)[2].seen == "15.0"


@pytest.fixture
def small(monkeypatch):
    """One small case, and nothing around it that takes long."""
    for module in (evaluation, slice_vtk):
        monkeypatch.setattr(module, "MAIN", SMALL)
    monkeypatch.setattr(evaluation, "cases", lambda _: [SMALL, replace(SMALL, size=24)])
    monkeypatch.setattr(evaluation, "_QUICK_SECONDS", (0.0, 0.0))
    monkeypatch.setattr(evaluation, "peak_memory", lambda _: 512**3 + 10**8)
    monkeypatch.setattr(evaluation, "publishing_ms", lambda _: 0.5)
    monkeypatch.setattr(evaluation, "costs", lambda *_: ({}, {}, {}))
    monkeypatch.setattr("us_sim.evaluation.slice.report.SHOWN", (SMALL,))


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_rows_plots_and_report_are_written(tmp_path, capsys):
    out = tmp_path / "slices"
    assert main(["evaluate", "slice", "--quick", "--out", str(out)]) == 0
    with (out / "slice.csv").open(encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    assert ",".join(head).startswith(COLUMNS)
    found = [dict(zip(head, row, strict=True)) for row in rows]
    assert {row["method"] for row in found} == set(SLICING_METHODS)
    for row in found:
        if row["method"] in SLICERS.names:
            assert row["coverage_mismatch_px"] == "0"
            assert float(row["max_grey_difference"]) <= 1
            assert float(row["max_voxel_error"]) < 0.1
    assert len(rows) == 2 * 7
    report = (out / "slice.md").read_text(encoding="utf-8")
    for picture in re.findall(r"\]\((\S+\.png)\)", report):
        assert (out / picture).stat().st_size > 10_000
    assert "| at most 300 MB" in report
    assert slice_vtk.HOW_TO_GET not in report + capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_without_vtk_the_rest_is_measured_and_it_is_said(monkeypatch, tmp_path, capsys):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "vtkmodules" else find(name)
    )
    assert main(["evaluate", "slice", "--quick", "--out", str(tmp_path)]) == 0
    assert slice_vtk.HOW_TO_GET in capsys.readouterr().out
    report = (tmp_path / "slice.md").read_text(encoding="utf-8")
    assert slice_vtk.HOW_TO_GET in report
    assert "VTK's two parts" not in report


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_a_method_that_fails_says_so_and_leaves_the_others(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(SLICERS.options, "per_pixel", Option("us_sim.slicing.nothing:Nothing"))
    assert main(["evaluate", "slice", "--quick", "--out", str(tmp_path)]) == 1
    assert "failed: per_pixel on 48 px, 150 nodes: ModuleNotFoundError" in capsys.readouterr().out
    with (tmp_path / "slice.csv").open(encoding="utf-8") as file:
        median = {row["method"]: row["ms_median"] for row in csv.DictReader(file)}
    assert median["per_pixel"] == ""
    assert float(median["scan_conversion"]) > 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--volume", "a.mha"], "--volume and --sweep belong together"),
        (["--volume", "no.mha", "--sweep", "none.mha"], "no.mha"),
        (["--out", "/proc/no"], "--out /proc/no: cannot be written"),
    ],
)
def test_bad_input_is_refused_in_a_sentence_before_the_run(options, words, tmp_path, capsys):
    assert main(["evaluate", "slice", "--out", str(tmp_path), *options]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("us-sim: ")
    assert words in error


@pytest.mark.slow
def test_processes_of_their_own_tell_memory_and_publishing():
    peak_memory(64)  # compiling holds memory too, once
    small, large = peak_memory(64), peak_memory(256)
    assert small is not None
    assert large is not None
    assert 0.9 * 256**3 < large - small + 64**3 < 1.1 * 256**3 + 8e6
    sent = publishing_ms(64)
    assert sent is not None
    assert 0.0 < sent < 100.0


@pytest.mark.slow
def test_nothing_but_vtk_is_needed_beyond_what_is_always_installed():
    code = (
        "import sys; sys.modules['skfem'] = sys.modules['vtkmodules'] = None;"
        "import us_sim.evaluation.slice.report"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
