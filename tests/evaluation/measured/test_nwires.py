"""N-wires: Plus' stated errors and matrix, and files that cannot be used."""

import shutil

import pytest

from us_sim.errors import UsSimError
from us_sim.evaluation.measured.nwires import (
    measure_nwires,
    plus_mean,
    read_recording,
)
from us_sim.evaluation.report import ReportFolder
from us_sim.volume.reconstruction.calibration_file import read_calibration

RESULT = "FreehandCalibration3NWires_fCal2.0.results.xml"


@pytest.fixture(scope="session")
def folder(shared_file):
    return shared_file("plus-nwire-calibration")


@pytest.mark.parametrize(("which", "stated"), [("calibration", 0.479116), ("validation", 0.539932)])
def test_the_3d_error_of_plus_matrix_is_the_one_that_plus_states(folder, which, stated):
    matrix = read_calibration(folder / RESULT, "Probe").transforms["ImageToProbe"]
    errors = read_recording(folder, which).to_middles(matrix)
    assert 1e3 * plus_mean(errors) == pytest.approx(stated, abs=1e-5)


def test_the_study_reports_plus_errors_and_the_volume(folder, tmp_path):
    section = measure_nwires(folder, ReportFolder("measured", tmp_path, True))
    assert (tmp_path / "measured_nwires.png").exists()
    found = {(f.case, f.quantity): f.error for f in section.findings}
    assert found["volume", "offset from that of Plus"] < 0.06  # mm, of voxels of 0.5 mm
    assert found["volume", "correlation with that of Plus"] > -0.02
    assert found["matrix of Plus", "3-D error, validation"] == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("fault", ["missing", "not XML", "cut"])
def test_a_result_that_cannot_be_used_is_refused(folder, tmp_path, fault):
    for file in folder.iterdir():
        shutil.copyfile(file, tmp_path / file.name)
    path = tmp_path / RESULT
    if fault == "missing":
        path.unlink()
    elif fault == "not XML":
        path.write_text("<a")
    else:
        path.write_text(path.read_text().replace('<Point WireName="7:G1_g1"', "<No ", 1))
    with pytest.raises(UsSimError, match="fetch"):
        read_recording(tmp_path, "validation")
