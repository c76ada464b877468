"""Files without an end are refused by whatever reads a text, and pipes are read."""

import os
import threading

import pytest

from us_sim.errors import CalibrationError, SceneError, TrackingError
from us_sim.scene.document import read_document
from us_sim.settings.text_files import read_text
from us_sim.tracking.calibration.landmarks import read_landmarks, read_wires
from us_sim.tracking.calibration.transform_file import read_transform
from us_sim.tracking.camera.model import read_camera_info
from us_sim.tracking.camera.rigid_body import read_rigid_body


def test_a_pipe_is_read(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    writer = threading.Thread(target=lambda: pipe.write_text("Grüße\n", encoding="utf-8"))
    writer.start()
    assert read_text(pipe) == "Grüße\n"
    writer.join()


@pytest.mark.parametrize(
    ("read", "error"),
    [
        (read_landmarks, CalibrationError),
        (read_wires, CalibrationError),
        (read_transform, CalibrationError),
        (read_camera_info, TrackingError),
        (read_rigid_body, TrackingError),
        (lambda path: read_document(path, lambda _: path), SceneError),
    ],
)
@pytest.mark.parametrize("name", ["zero", "zero.xml"])
def test_what_has_no_end_is_refused(tmp_path, read, error, name):
    path = tmp_path / name
    path.symlink_to("/dev/zero")
    with pytest.raises(error, match="more than 64 MiB, and no text is so long"):
        read(path)
