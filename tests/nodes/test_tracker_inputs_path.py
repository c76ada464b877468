"""A recording in place of a tracker: at its own pace, under the present's stamps."""

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image, PointCloud2

from us_sim.errors import UsSimError
from us_sim.nodes.probe_tracker import ProbeTracker
from us_sim.recording.path import ProbePath, read_path, write_path

STEP = 10_000_000  # ns


@pytest.fixture
def bag(tmp_path):
    """Twenty poses, 10 ms apart, going down."""
    stamps = 1_600_000_000_000_000_000 + STEP * np.arange(20)
    positions = np.zeros((20, 3))
    positions[:, 2] = 1e-3 * np.arange(20)
    orientations = np.tile([0.0, 0, 0, 1], (20, 1))
    file = tmp_path / "path.mcap"
    write_path(file, ProbePath("/tracker/pose", "patient", stamps, positions, orientations))
    return file


@pytest.fixture
def recording(tmp_path):
    """Three samples of a probe and a reference that has moved by 5 mm, one of them not seen."""
    lines = ["ObjectType = Image", "NDims = 3", "DimSize = 0 0 3", "ElementType = MET_OTHER"]
    for number in range(3):
        frame = f"Seq_Frame{number:04}_"
        lines += [
            f"{frame}ProbeToTrackerTransform = 1 0 0 {number + 1} 0 1 0 0 0 0 1 0 0 0 0 1",
            f"{frame}ProbeToTrackerTransformStatus = {'INVALID' if number == 1 else 'OK'}",
            f"{frame}ReferenceToTrackerTransform = 1 0 0 -5 0 1 0 0 0 0 1 0 0 0 0 1",
            f"{frame}Timestamp = {100 + 0.02 * number}",
        ]
    file = tmp_path / "tracker.igs.mha"
    file.write_text("\n".join([*lines, "ElementDataFile = LOCAL", ""]))
    return file


def scene_with(tmp_path, small_scene, **tracker):
    file = tmp_path / "scene.yaml"
    lines = [f"  {key}: {value}" for key, value in {"source": "path", **tracker}.items()]
    file.write_text("\n".join([small_scene.read_text(), "tracker:", *lines, ""]))
    return str(file)


def publish_the_rest(bench):
    """The topics by which the scene's other nodes say that they are ready."""
    bench.peer.create_publisher(Image, "ultrasound/image", 10)
    for topic in ("tissue/nodes", "skin/nodes"):
        bench.peer.create_publisher(PointCloud2, topic, 10)


def test_a_bags_poses_come_once_and_as_far_apart_as_recorded(bench, tmp_path, small_scene, bag):
    scene = scene_with(tmp_path, small_scene, file=bag)
    node = bench.make(ProbeTracker, scene=scene)
    poses = bench.collect(PoseStamped, "probe/pose")
    bench.spin_for(60)
    assert node.health.received == 0, "it began though the other nodes are not ready"
    publish_the_rest(bench)
    before = node.get_clock().now().nanoseconds
    bench.spin_until(lambda: len(poses) == 20)
    bench.spin_for(5)
    assert len(poses) == 20
    np.testing.assert_allclose([p.pose.position.z for p in poses], 1e-3 * np.arange(20))
    stamps = [p.header.stamp.sec * 10**9 + p.header.stamp.nanosec for p in poses]
    np.testing.assert_array_equal(np.diff(stamps), STEP)
    assert before <= stamps[0]
    assert stamps[-1] <= node.get_clock().now().nanoseconds


def test_a_recording_of_plus_leads_from_the_probe_to_the_reference(
    bench, tmp_path, small_scene, recording
):
    scene = scene_with(
        tmp_path, small_scene, file=recording, body="ProbeToReference", frame="Reference"
    )
    bench.make(ProbeTracker, scene=scene)
    publish_the_rest(bench)
    poses = bench.collect(PoseStamped, "probe/pose")
    bench.spin_until(lambda: len(poses) == 2)
    np.testing.assert_allclose([p.pose.position.x for p in poses], [0.006, 0.008])


def test_the_path_of_a_command_takes_a_recording_too(recording):
    path = read_path(recording, "ProbeToReference")
    assert (len(path), path.rejected, path.frame_id) == (2, 1, "Reference")
    np.testing.assert_array_equal(np.diff(path.stamps), 40_000_000)


def test_another_source_may_be_named_at_the_start(bench, tmp_path, small_scene):
    scene = scene_with(tmp_path, small_scene)
    bench.make(ProbeTracker, scene=scene, source="pose", lockstep=True)
    bench.publisher(PoseStamped, "tracker/pose")


@pytest.mark.parametrize(
    ("tracker", "parameters", "sentence"),
    [
        ({}, {}, "tracker.file: is missing"),
        ({"file": "{bag}"}, {"lockstep": True}, "give the recording with --path"),
        (
            {"file": "{recording}", "body": "ProbeToTracker", "frame": "moon"},
            {},
            "in frame 'Tracker'",
        ),
        ({"file": "{bag}", "body": "nothing"}, {}, "nothing"),
        (
            {"file": "{recording}"},
            {},
            "name one by tracker.body, of ProbeToTracker, Ref",
        ),
        ({}, {"source": "moon"}, "probe_tracker.source: 'moon' is not one of pose, pose_array"),
    ],
)
def test_what_cannot_be_played_is_refused_in_a_sentence(
    bench, tmp_path, small_scene, bag, recording, tracker, parameters, sentence
):
    files = {"bag": bag, "recording": recording}
    tracker = {key: value.format(**files) for key, value in tracker.items()}
    scene = scene_with(tmp_path, small_scene, **tracker)
    with pytest.raises(UsSimError, match=sentence):
        bench.make(ProbeTracker, scene=scene, **parameters)
