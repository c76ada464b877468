"""Tracker recordings of Plus: transforms chained, what cannot be believed left out and counted."""

import numpy as np
import pytest

from us_sim.errors import TrackingError
from us_sim.geometry.pose import Pose
from us_sim.recording.path import read_path, read_tracker_recording

IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
MOVED = "0 -1 0 10 1 0 0 20 0 0 1 30 0 0 0 1"


@pytest.fixture
def recordings(shared_data):
    return shared_data / "plus-tracker-recordings"


def write(folder, samples, *, size=None, end="ElementDataFile = LOCAL\n"):
    """A recording without images, of fields by sample."""
    lines = [
        "ObjectType = Image",
        "NDims = 3",
        f"DimSize = {size or f'0 0 {len(samples)}'}",
        "ElementType = MET_OTHER",
    ]
    for number, fields in enumerate(samples):
        lines += [f"Seq_Frame{number:04}_{key} = {value}" for key, value in fields.items()]
    path = folder / "recording.igs.mha"
    path.write_text("\n".join(lines) + "\n" + end)
    return path


def sample(time=0.0, **transforms):
    return {f"{name}Transform": value for name, value in transforms.items()} | {"Timestamp": time}


def test_millimetres_become_metres_and_the_recorders_clock_stays(tmp_path):
    recording = read_tracker_recording(write(tmp_path, [sample(7.25, ProbeToTracker=MOVED)]))
    assert recording.times == [7.25]
    expected = np.array([[0, -1, 0, 0.01], [1, 0, 0, 0.02], [0, 0, 1, 0.03], [0, 0, 0, 1]])
    np.testing.assert_allclose(recording.transforms["ProbeToTracker"].matrices[0], expected)
    path = recording.make_probe_path("Probe")
    assert path.stamps == [7_250_000_000]
    assert (path.frame_id, path.rejected, path.note) == ("Tracker", 0, "")


def test_a_body_is_led_to_a_reference_by_way_of_the_tracker(tmp_path):
    other = "0 0 1 -5 0 1 0 6 -1 0 0 7 0 0 0 1"
    path = write(tmp_path, [sample(ProbeToTracker=MOVED, ReferenceToTracker=other)])
    recording = read_tracker_recording(path)
    probe, reference = (
        Pose.from_matrix(recording.transforms[name].matrices[0])
        for name in ("ProbeToTracker", "ReferenceToTracker")
    )
    for name, expected in (
        ("ProbeToReference", reference.inverse() @ probe),
        ("TrackerToProbe", probe.inverse()),
    ):
        found = recording.make_probe_path(name).pose_at(0).matrix
        np.testing.assert_allclose(found, expected.matrix, atol=1e-12)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ({"ProbeToTrackerTransformStatus": "INVALID"}, "ProbeToTrackerTransformStatus is not OK"),
        (
            {"ProbeToTrackerTransform": "0.2 0 0 0 0 0.2 0 0 0 0 0.2 0 0 0 0 1"},
            "a transform that is not rigid",
        ),
        ({"ProbeToTrackerTransform": IDENTITY}, "an identity among poses that are none"),
    ],
)
def test_what_is_no_pose_is_not_valid_and_counted(tmp_path, bad, reason):
    good = sample(ProbeToTracker=MOVED)
    recording = read_tracker_recording(write(tmp_path, [good, good | bad, good]))
    assert recording.count_left_out("ProbeToTracker") == {reason: 1}
    assert recording.transforms["ProbeToTracker"].valid.tolist() == [True, False, True]
    assert np.isnan(recording.transforms["ProbeToTracker"].matrices[1]).all()
    path = recording.make_probe_path()
    assert (len(path), path.rejected) == (2, 1)
    assert reason in path.note


def test_a_sample_without_a_time_is_left_out_whole(tmp_path):
    samples = [sample(ProbeToTracker=MOVED), sample("never", ProbeToTracker=MOVED)]
    recording = read_tracker_recording(write(tmp_path, samples))
    assert (len(recording), recording.untimed) == (1, 1)
    assert (
        recording.make_probe_path().note
        == "1 of the 2 poses of ProbeToTracker are left out " + ("(1 without a time)")
    )


def test_a_rotation_that_a_tracker_rounded_is_made_one_again(tmp_path):
    rounded = "1.0003 0 0 10 0 1.0003 0 20 0 0 1.0003 30 0 0 0 1"
    recording = read_tracker_recording(write(tmp_path, [sample(ProbeToTracker=rounded)]))
    np.testing.assert_allclose(
        recording.transforms["ProbeToTracker"].matrices[0, :3, :3], np.eye(3)
    )


def test_names_that_lead_nowhere_say_which_there_are(tmp_path):
    path = write(tmp_path, [sample(ProbeToTracker=MOVED, StylusToTracker=MOVED)])
    recording = read_tracker_recording(path)
    for call in (
        lambda: recording.make_probe_path(),
        lambda: recording.make_probe_path("Needle"),
        lambda: recording.make_probe_path("ProbeToPatient"),
        lambda: recording.make_probe_path("Tracker"),
        lambda: recording.make_probe_path("ProbeToProbe"),
    ):
        with pytest.raises(TrackingError, match="ProbeToTracker, StylusToTracker"):
            call()


def test_bodies_whose_names_hold_to_are_read_as_plus_reads_them(tmp_path):
    names = ["ToolToTracker", "ToolTipToTool", "TorsoToTracker", "TestToolToTracker"]
    path = write(tmp_path, [sample(**dict.fromkeys(names, MOVED))])
    recording = read_tracker_recording(path)
    assert sorted(recording.transforms) == sorted(names)
    for body, reference in (("Torso", "Tracker"), ("TestTool", "Tracker"), ("ToolTip", "Tool")):
        assert recording.make_probe_path(body).frame_id == reference
    tip = recording.make_probe_path("ToolTipToTracker").pose_at(0).matrix
    tool = recording.transforms["ToolToTracker"].matrices[0]
    np.testing.assert_allclose(tip, tool @ tool, atol=1e-12)


def test_a_recording_may_be_nrrd(tmp_path):
    lines = ["NRRD0004", "type: uint8", "dimension: 4", "sizes: 0 0 0 2", "encoding: raw"]
    lines += ["kinds: domain domain domain list", "Seq_Frame0000_Timestamp:=1.5"]
    lines += [f"Seq_Frame000{k}_ToolToTrackerTransform:={MOVED}" for k in (0, 1)]
    lines += ["Seq_Frame0001_Timestamp:=1.75"]
    path = tmp_path / "recording.igs.nrrd"
    path.write_text("\n".join(lines) + "\n\n")
    recorded = read_path(path)
    assert (recorded.topic, recorded.duration) == ("ToolToTracker", 0.25)
    np.testing.assert_allclose(recorded.positions[1], [0.01, 0.02, 0.03])


def test_the_invalid_sample_and_the_outlier_of_a_real_recording_are_left_out(recordings):
    recording = read_tracker_recording(recordings / "TransformInterpolationTest.igs.mha")
    assert len(recording) == 500
    assert {name: recording.count_left_out(name) for name in recording.transforms} == {
        "ProbeToTracker": {"ProbeToTrackerTransformStatus is not OK": 1},
        "ReferenceToTracker": {"an identity among poses that are none": 1},
    }
    path = recording.make_probe_path("ProbeToReference")
    assert (len(path), path.rejected) == (499, 1)
    # Without them the probe only moves by millimetres against the reference.
    assert np.ptp(path.positions, axis=0).max() < 0.02


@pytest.mark.parametrize(
    ("name", "samples", "rate"),
    [
        ("EightLandmarkPointsTrackedForPhantomRegistration", 1000, 15.0),
        ("WaterTankBottomTranslationTrackerBuffer-trimmed", 801, 38.6),
    ],
)
def test_real_recordings_are_read_whole(recordings, name, samples, rate):
    recording = read_tracker_recording(recordings / f"{name}.igs.mha")
    assert (len(recording), recording.untimed) == (samples, 0)
    assert all(series.valid.all() for series in recording.transforms.values())
    assert (samples - 1) / np.ptp(recording.times) == pytest.approx(rate, rel=0.02)
    stylus = recording.transforms["StylusToTracker"].matrices
    np.testing.assert_allclose(np.linalg.det(stylus[:, :3, :3]), 1.0, atol=1e-12)


@pytest.mark.parametrize(
    ("samples", "more", "word"),
    [
        ([sample(ProbeToTracker=MOVED)], {"end": ""}, "no ElementDataFile"),
        ([sample(ProbeToTracker=MOVED)], {"size": "0 0 none"}, "DimSize"),
        ([{"Timestamp": "1"}], {}, "holds no transforms"),
        ([sample("nan", ProbeToTracker=MOVED)], {}, "none of its 1 samples holds a time"),
    ],
)
def test_recordings_of_no_use_are_refused(tmp_path, samples, more, word):
    with pytest.raises(TrackingError, match=word):
        read_tracker_recording(write(tmp_path, samples, **more))


def test_files_without_a_tracker_are_refused(tmp_path, recordings):
    (tmp_path / "picture.mha").write_bytes(bytes(1000))
    for path, word in (
        (tmp_path / "missing.igs.mha", "no such file"),
        (tmp_path / "picture.mha", "image"),
        (recordings / "WaterTankBottomTranslationVideoBuffer.igs.mha", "holds no transforms"),
    ):
        with pytest.raises(TrackingError, match=word):
            read_tracker_recording(path)


def test_a_body_that_only_stands_at_the_origin_is_believed(tmp_path):
    recording = read_tracker_recording(write(tmp_path, [sample(ProbeToTracker=IDENTITY)] * 3))
    assert recording.transforms["ProbeToTracker"].valid.all()
