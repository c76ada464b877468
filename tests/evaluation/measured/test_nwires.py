"""N-wires: Plus' stated errors and matrix, and files that cannot be used."""

import shutil

import numpy as np
import pytest

from us_sim.errors import UsSimError
from us_sim.evaluation.measured.nwires import (
    calibrated,
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


def test_on_the_middle_wires_points_the_calibration_is_that_of_plus(folder):
    recording = read_recording(folder, "calibration")
    published = read_calibration(folder / RESULT, "Probe").transforms["ImageToProbe"]
    found = calibrated(recording, "middle points")
    corners = np.array([[c, r, 0, 1] for c in (0, 819) for r in (0, 615)]).T
    assert np.linalg.norm(((found.image_to_body - published) @ corners)[:3], axis=0).max() < 0.3e-3
    wires = calibrated(recording, "wires")
    apart = np.linalg.norm(((wires.image_to_body - published) @ corners)[:3], axis=0).max()
    assert apart > 3e-3  # a tilt that the deviation tells to be open
    assert wires.turn_deviation > 5 * found.turn_deviation
    assert wires.edge_deviation > 5 * found.edge_deviation
    assert recording.to_wires(published).mean() == pytest.approx(0.428e-3, abs=1e-6)


def test_the_study_reports_each_calibration_and_the_volume(folder, tmp_path):
    section = measure_nwires(folder, ReportFolder("measured", tmp_path, True))
    assert (tmp_path / "measured_nwires.png").exists()
    found = {(f.case, f.quantity): f.error for f in section.findings}
    assert found["volume", "offset from that of Plus"] < 0.05  # mm, a tenth of a voxel
    assert found["volume", "equal voxels"] > -1.0
    assert found["middle points", "3-D error, validation"] == pytest.approx(0.54, abs=0.02)


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
