"""Written volumes lie where they were, and 3D Slicer's segments have their names and colours."""

import dataclasses

import numpy as np
import pytest
import SimpleITK as sitk
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from us_sim.errors import VolumeError
from us_sim.volume.files.readers import read_volume
from us_sim.volume.files.writing import write_labels, write_volume
from us_sim.volume.volume import Volume


def volume_at(rotation, spacing, origin, *, mirrored=False, **more):
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.as_matrix() * spacing
    if mirrored:
        matrix[:, 1] *= -1
    matrix[:3, 3] = origin
    return Volume(np.arange(3 * 4 * 5, dtype=np.uint8).reshape(3, 4, 5), matrix, **more)


PLAIN = volume_at(Rotation.identity(), [1e-3] * 3, [0, 0, 0])


@pytest.mark.parametrize(
    ("ending", "closeness"), [(".nrrd", 1e-15), (".mha", 1e-15), (".nii.gz", 1e-8)]
)
@settings(
    max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    spacing=st.tuples(*[st.floats(1e-4, 5e-3)] * 3),
    origin=st.tuples(*[st.floats(-0.2, 0.2)] * 3),
    mirrored=st.booleans(),
)
def test_every_format_keeps_the_voxels_and_their_place(
    tmp_path, ending, closeness, turn, spacing, origin, mirrored
):
    volume = volume_at(Rotation.from_rotvec(turn), spacing, origin, mirrored=mirrored)
    file = tmp_path / f"volume{ending}"
    file.write_text("replaced")
    write_volume(file, volume)
    assert list(tmp_path.iterdir()) == [file]
    again = read_volume(file)
    np.testing.assert_array_equal(again.intensities, volume.intensities)
    apart = np.abs(again.index_to_patient - volume.index_to_patient).max()
    assert apart < closeness  # NIfTI's numbers have 32 bits
    image = sitk.ReadImage(str(file))
    np.testing.assert_array_equal(sitk.GetArrayFromImage(image).T, volume.intensities)
    placed = 1e-3 * np.array(image.TransformIndexToPhysicalPoint((2, 1, 3)))
    np.testing.assert_allclose(placed, (volume.index_to_patient @ [2, 1, 3, 1])[:3], atol=1e-7)


def test_3d_slicer_reads_the_names_and_colours_of_segments(tmp_path):
    labels = np.zeros((3, 4, 5), np.uint8)
    labels[1:, 2, 2], labels[0, 0, 0] = 3, 200
    names = {0: "tissue", 3: "portal vein", 200: "rib"}
    file = tmp_path / "labels.seg.nrrd"
    volume = dataclasses.replace(PLAIN, labels=labels, label_names=names)
    write_labels(file, volume, {200: (1.0, 0.5, 0.25)})
    image = sitk.ReadImage(str(file))
    # The fields that the format asks for, as 3D Slicer's documentation names them.
    for key, value in {
        "Segment0_Name": "portal vein",
        "Segment0_LabelValue": "3",
        "Segment0_Layer": "0",
        "Segment0_Color": "0.25 0.4 0.85",
        "Segment0_Extent": "0 2 0 3 0 4",
        "Segment1_Name": "rib",
        "Segment1_Color": "1 0.5 0.25",
    }.items():
        assert image.GetMetaData(key) == value
    assert not image.HasMetaDataKey("Segment2_Name")
    assert b"kinds: domain domain domain\n" in file.read_bytes()
    np.testing.assert_array_equal(sitk.GetArrayFromImage(image).T, labels)


SHEARED = np.array([[1e-3, 5e-4, 0, 0], [0, 1e-3, 0, 0], [0, 0, 1e-3, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("name", "volume", "write", "word"),
    [
        ("volume.png", PLAIN, write_volume, "name"),
        ("volume.mha", Volume(PLAIN.intensities, SHEARED), write_volume, "right angles"),
        ("labels.nrrd", PLAIN, write_labels, "no labels"),
    ],
)
def test_what_cannot_be_written_leaves_nothing(tmp_path, name, volume, write, word):
    with pytest.raises(VolumeError, match=word):
        write(tmp_path / name, volume)
    assert not list(tmp_path.iterdir())
