"""Transforms of 3D Slicer against published path lengths, and what Slicer's own scene shows."""

import re
import zipfile

import numpy as np
import pytest
import SimpleITK

from us_sim.errors import CalibrationError, TrackingError, VolumeError
from us_sim.recording.path import read_path
from us_sim.recording.plus_recording import read_tracker_recording
from us_sim.tracking.calibration.transform_file import read_transform_file
from us_sim.volume.sequences.slicer_transforms import read_slicer_sequences, read_slicer_transform


def length(matrices):
    """mm, of the way of the origin."""
    return 1e3 * np.linalg.norm(np.diff(matrices[:, :3, 3], axis=0), axis=1).sum()


def test_path_lengths_are_those_that_perktutor_publishes(shared_data):
    scene = shared_data / "perktutor-truth/InPlane/Scene_InPlane.mrml"
    times, found = read_slicer_sequences(scene)
    assert np.ptp(times) == pytest.approx(27.437, abs=5e-4)
    assert length(found["NeedleToReference"].matrices) == pytest.approx(276.91832, abs=1e-5)
    assert length(found["ImageToReference"].matrices) == pytest.approx(74.85490, abs=1e-5)
    tip = read_tracker_recording(scene).probe_path("NeedleTipToReference")
    assert 1e3 * np.linalg.norm(np.diff(tip.positions, axis=0), axis=1).sum() == pytest.approx(
        280.892, abs=5e-4
    )
    assert (tip.frame_id, len(tip)) == ("Reference", 222)


def test_a_bundle_has_its_times_from_the_scene_beside_it(shared_data, tmp_path):
    bundle = shared_data / "perktutor-truth/InPlane/NeedleToReference-Sequence.mrb"
    path = read_path(bundle)
    assert (path.topic, path.frame_id, len(path)) == ("NeedleToReference", "Reference", 222)
    assert path.duration == pytest.approx(27.437, abs=5e-4)
    alone = tmp_path / bundle.name
    alone.write_bytes(bundle.read_bytes())
    with pytest.raises(TrackingError, match="without times"):
        read_path(alone)


@pytest.mark.parametrize("name", ["NeedleToReference", "NeedleTipToNeedle", "ImageToReference"])
def test_a_file_holds_what_slicer_shows(shared_data, name):
    folder = shared_data / "perktutor-truth/InPlane"
    text = (folder / "Scene_InPlane.mrml").read_text()
    said = re.search(rf'name="{name}".*?matrixTransformToParent="(.*?)"', text, re.DOTALL)
    shown = np.array(said[1].split(), float).reshape(4, 4)
    found = read_slicer_transform(folder / f"{name}.h5")
    scale = 1.0 if name.startswith("Image") else 1e3  # from pixels
    found[:3, :3] *= 1e3 / scale
    found[:3, 3] *= 1e3
    np.testing.assert_allclose(found, shown, atol=1e-5, rtol=1e-5)


def transform_file(path, angle=0.3, shift=(10.0, 20.0, 30.0)):
    """A rotation about z and a shift, as ITK has them."""
    made = SimpleITK.Euler3DTransform((0, 0, 0), 0, 0, angle, shift)
    SimpleITK.WriteTransform(made, str(path))
    return path


@pytest.mark.parametrize("ending", ["h5", "tfm"])
def test_a_scene_takes_a_transform_of_slicer_as_registration(tmp_path, ending):
    found = read_transform_file(transform_file(tmp_path / f"NdiToPatient.{ending}"))
    assert (found.from_frame, found.to_frame) == ("Ndi", "Patient")
    c, s = np.cos(0.3), np.sin(0.3)
    lps = -np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ [10, 20, 30]  # of the inverse
    np.testing.assert_allclose(1e3 * found.pose.position, lps * [-1, -1, 1], atol=1e-9)
    np.testing.assert_allclose(found.pose.rotation[:2, :2], [[c, s], [-s, c]], atol=1e-12)


def test_what_is_no_rigid_transform_is_refused(tmp_path):
    scaled = SimpleITK.ScaleTransform(3, (2.0, 2.0, 2.0))
    bent = SimpleITK.BSplineTransform(3)
    for made, name, said in ((scaled, "a.tfm", "not rigid"), (bent, "b.tfm", "not linear")):
        SimpleITK.WriteTransform(made, str(tmp_path / name))
        with pytest.raises(CalibrationError, match=said):
            read_transform_file(tmp_path / name)
    whole = transform_file(tmp_path / "whole.h5").read_bytes()
    (tmp_path / "cut.h5").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CalibrationError, match=r"cut\.h5: is damaged"):
        read_transform_file(tmp_path / "cut.h5")
    with pytest.raises(CalibrationError, match="No such file"):
        read_transform_file(tmp_path / "none.h5")


def scene(tmp_path, transforms, times="s1:0;s2:0.5", file="../outside.mrb"):
    """A scene that names a sequence in a file."""
    text = (
        f'<MRML><Sequence id="q" name="Probe-Sequence" storageNodeRef="t" indexValues="{times}"/>'
        f'<SequenceStorage id="t" fileName="{file}"/></MRML>'
    )
    with zipfile.ZipFile(tmp_path / "probe.seq.mrb", "w") as bundle:
        nodes = ""
        for k, data in enumerate(transforms, 1):
            bundle.writestr(f"probe/Data/{k}.tfm", data)
            nodes += f'<LinearTransform id="s{k}" name="Probe" storageNodeRef="f{k}"/>'
            nodes += f'<TransformStorage id="f{k}" fileName="Data/{k}.tfm"/>'
        bundle.writestr("probe/probe.mrml", f"<MRML>{nodes}</MRML>")
    made = tmp_path / "scene.mrml"
    made.write_text(text)
    return made


def test_a_sequence_without_frames_in_its_name_is_in_ras(tmp_path):
    data = [transform_file(tmp_path / f"{k}.tfm", 0.0, (k, 0, 0)).read_bytes() for k in (1, 2)]
    path = read_path(scene(tmp_path, data, file="probe.seq.mrb"))
    assert (path.topic, path.frame_id) == ("ProbeToRAS", "RAS")
    np.testing.assert_allclose(path.positions, [[1e-3, 0, 0], [2e-3, 0, 0]])
    assert path.duration == 0.5


@pytest.mark.parametrize(
    ("file", "times", "said"),
    [
        ("../outside.mrb", "s1:0", "does not lie beside it"),
        ("none.mrb", "s1:0", "No such file"),
        ("probe.seq.mrb", "s1:never", "cannot be understood"),
        ("probe.seq.mrb", "other:1", "no sequence"),
        ("probe.seq.mrb", "s1:1", "is damaged"),
    ],
)
def test_what_cannot_be_read_is_one_sentence(tmp_path, file, times, said):
    with pytest.raises(VolumeError, match=said):
        read_slicer_sequences(scene(tmp_path, [b"nothing"], times, file))
