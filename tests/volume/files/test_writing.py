"""Written volumes lie where they were, and 3D Slicer's segments have their names and colours."""

import gzip

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


def volume_at(rotation, spacing, origin, *, mirrored=False, labels=None, names=None):
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.as_matrix() * spacing
    if mirrored:
        matrix[:, 1] *= -1
    matrix[:3, 3] = origin
    voxels = np.arange(3 * 4 * 5, dtype=np.uint8).reshape(3, 4, 5)
    return Volume(voxels, matrix, labels=labels, label_names=names or {})


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
    write_volume(file, volume)
    again = read_volume(file)
    np.testing.assert_array_equal(again.intensities, volume.intensities)
    apart = np.abs(again.index_to_patient - volume.index_to_patient).max()
    # NIfTI's numbers have 32 bits.
    assert apart < closeness


def test_itk_finds_a_voxel_where_the_volume_has_it(tmp_path):
    volume = volume_at(
        Rotation.from_euler("xyz", [0.3, -0.2, 0.9]), [1e-3, 2e-3, 3e-3], [0.1, 0, 0]
    )
    write_volume(tmp_path / "volume.nrrd", volume, {"Depth": "4 cm"})
    image = sitk.ReadImage(str(tmp_path / "volume.nrrd"))
    assert image.GetPixel(2, 1, 3) == volume.intensities[2, 1, 3]
    there = volume.index_to_patient @ [2, 1, 3, 1]
    np.testing.assert_allclose(image.TransformIndexToPhysicalPoint((2, 1, 3)), 1e3 * there[:3])
    assert image.GetMetaData("Depth") == "4 cm"


def test_3d_slicer_reads_the_names_and_colours_of_segments(tmp_path):
    labels = np.zeros((3, 4, 5), np.uint8)
    labels[1:, 2, 2], labels[0, 0, 0] = 3, 200
    plain = Rotation.identity()
    names = {0: "tissue", 3: "portal vein", 200: "rib"}
    volume = volume_at(plain, [1e-3] * 3, [0, 0, 0], labels=labels, names=names)
    file = tmp_path / "labels.seg.nrrd"
    write_labels(file, volume, {200: (1.0, 0.5, 0.25)})
    data = file.read_bytes()
    header, _, packed = data.partition(b"\n\n")
    lines = header.decode().splitlines()
    said = dict(line.split(":=") for line in lines if ":=" in line)
    # The fields that the format asks for, as 3D Slicer's documentation names them.
    assert said["Segment0_Name"] == "portal vein"
    assert said["Segment0_LabelValue"] == "3"
    assert said["Segment0_Layer"] == "0"
    assert said["Segment0_Color"] == "0.25 0.4 0.85"
    assert said["Segment0_Extent"] == "0 2 0 3 0 4"
    assert (said["Segment1_Name"], said["Segment1_Color"]) == ("rib", "1 0.5 0.25")
    assert "Segment2_Name" not in said
    assert "kinds: domain domain domain" in lines
    stored = np.frombuffer(gzip.decompress(packed), np.uint8).reshape(5, 4, 3)
    np.testing.assert_array_equal(stored.transpose(2, 1, 0), labels)


@pytest.mark.parametrize("name", ["volume.png", "volume", "volume.seg.nrrd"])
def test_a_name_that_says_no_format_is_refused(tmp_path, name):
    volume = volume_at(Rotation.identity(), [1e-3] * 3, [0, 0, 0])
    with pytest.raises(VolumeError, match=r"name"):
        write_volume(tmp_path / name, volume)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_leaves_nothing(tmp_path):
    volume = volume_at(Rotation.identity(), [1e-3] * 3, [0, 0, 0])
    with pytest.raises(VolumeError, match="no labels"):
        write_labels(tmp_path / "labels.nrrd", volume)
    with pytest.raises(VolumeError, match="cannot stand"):
        write_volume(tmp_path / "volume.nrrd", volume, {"a key": "two\nlines"})
    with pytest.raises(VolumeError, match="cannot be written"):
        write_volume(tmp_path / "nowhere" / "volume.nrrd", volume)
    sheared = np.diag([1e-3, 1e-3, 1e-3, 1.0])
    sheared[0, 1] = 5e-4
    with pytest.raises(VolumeError, match="right angles"):
        write_volume(tmp_path / "volume.mha", Volume(volume.intensities, sheared))
    assert not list(tmp_path.iterdir())


def test_a_file_is_replaced_only_by_a_whole_one(tmp_path):
    file = tmp_path / "volume.mha"
    file.write_text("precious")
    write_volume(file, volume_at(Rotation.identity(), [1e-3] * 3, [0, 0, 0]))
    assert read_volume(file).shape == (3, 4, 5)
    assert list(tmp_path.iterdir()) == [file]
