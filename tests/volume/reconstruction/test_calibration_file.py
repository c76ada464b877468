"""Calibrations of sweeps: Plus' XML, and what `us-sim calibrate probe` writes."""

import numpy as np
import pytest

from us_sim.errors import VolumeError
from us_sim.geometry.pose import Pose
from us_sim.tracking.calibration.transform_file import write_transform
from us_sim.volume.reconstruction.calibration_file import read_calibration


def test_what_calibrate_probe_writes_is_read(tmp_path):
    matrix = np.diag([1e-4, 2e-4, 1.5e-4, 1.0])
    matrix[:3, 3] = (0.01, 0.02, 0.03)
    file = tmp_path / "probe.yaml"
    more = {"image_to_body": matrix}
    write_transform(file, Pose(), from_frame="probe", to_frame="body", method="", more=more)
    found = read_calibration(file, "Transducer").transforms
    np.testing.assert_allclose(found["ImageToTransducer"], matrix)


MATRIX = "0.1 0 0 5 0 0.1 0 0 0 0 0.1 0 0 0 0 1"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.xml", "<a", "is not XML"),
        ("a.xml", "<a/>", "holds no <Transform"),
        ("a.xml", '<!DOCTYPE a [<!ENTITY b "c">]><a/>', "defines entities"),
        ("a.xml", '<a><Transform From="I" To="P" Matrix="1 2"/></a>', "not 16 numbers"),
        ("a.xml", f'<a><Transform From="I" To="P" Matrix="{"0 " * 16}"/></a>', "singular"),
        (
            "a.xml",
            f'<a><Transform From="I" To="P" Matrix="{MATRIX}"/>'
            '<VolumeReconstruction FanAnglesDeg="4"/></a>',
            "FanAnglesDeg is '4' where 2 numbers belong",
        ),
        (
            "a.xml",
            f'<a><Transform From="I" To="P" Matrix="{MATRIX}"/><VolumeReconstruction '
            'FanAnglesDeg="-4 4" FanRadiusStartPixel="9" FanRadiusStopPixel="2"/></a>',
            "9 must be less than 2",
        ),
        ("a.yaml", "position: [0, 0, 0]", "holds no image_to_body"),
        ("a.yaml", "image_to_body: 3", "holds no image_to_body"),
        ("a.yaml", "image_to_body: [[1, 2], [3, 4]]", "holds no image_to_body"),
        ("a.yaml", "a: [", "neither XML nor YAML"),
        ("a.yaml", None, "cannot be read: No such file"),
    ],
)
def test_a_file_without_a_calibration_is_refused(tmp_path, name, text, message):
    file = tmp_path / name
    if text is not None:
        file.write_text(text)
    with pytest.raises(VolumeError, match=message) as refused:
        read_calibration(file, "Probe")
    assert str(refused.value).startswith(f"{file}: ")
