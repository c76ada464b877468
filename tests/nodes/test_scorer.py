"""The scoring node: a scan of known motion, force and area, told while it is done."""

import json

import numpy as np
import pytest
from bench import pose_at
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import Trigger

from us_sim.errors import ScoreError
from us_sim.geometry.pose import Pose
from us_sim.nodes.messages import image_message, wrench_message
from us_sim.nodes.scorer import Scorer
from us_sim.scene.building import build_scanner, load_volume
from us_sim.scene.reading import load_scene
from us_sim.scoring.result_place import KEPT_FOLDER

BLIND = "name: b\nfeedback: afterwards\ntask: {kind: compression, points: 3}\n"
KEEP = "name: hold\ntask: {kind: keep_force, force: 5 N, tolerance: 1 N, duration: 8 s}\n"
VEIN = 6


@pytest.fixture
def node(bench, small_scene, tmp_path):
    (tmp_path / "hold.yaml").write_text(KEEP.replace("8 s", "10 s"))
    return bench.make(Scorer, scene=str(small_scene), exercise=str(tmp_path / "hold.yaml"))


@pytest.fixture
def scanned(bench, node, small_scene):
    """Eleven seconds at 10 mm/s and 5 N, and the vein's labels, half of them gone from 5 s on."""
    scene = load_scene(str(small_scene))
    labels = build_scanner(scene, load_volume(scene)).render_labels(Pose())
    rows = np.flatnonzero((labels == VEIN).any(axis=1))
    half = labels.copy()
    half[rows[: len(rows) // 2]] = 3
    part = (half == VEIN).sum() / (labels == VEIN).sum()
    poses = bench.publisher(PoseStamped, "probe/pose")
    wrenches = bench.publisher(WrenchStamped, "probe/wrench")
    images = bench.publisher(Image, "ultrasound/labels")
    scores = bench.collect(DiagnosticArray, "score", latched=True)

    def publish(second):
        pose = pose_at(0.0, second + 1, x=0.01 * (second % 2))
        poses.publish(pose)
        force = np.array([0, 3.0, -4.0]) if second else np.zeros(3)  # it comes from the air
        wrench = wrench_message(force, np.zeros(3), pose.header.stamp, "probe")
        wrenches.publish(wrench)

    for second in range(11):
        publish(second)
    bench.spin_until(lambda: bool(scores) and values(scores[-1])["Elapsed Time, s"] == "10")
    came = node.health.received
    for count, second in enumerate(range(0, 11, 2), came + 1):  # at the pose where they were found
        stamp = pose_at(0.0, second + 1).header.stamp
        images.publish(image_message(half if second > 4 else labels, stamp, "probe"))
        bench.spin_until(lambda count=count: node.health.received == count)
    publish(11)  # the last one, after which nothing counts
    bench.spin_until(lambda: values(scores[-1])["Elapsed Time, s"] == "11")
    return scores, part


def values(score):
    return {each.key: each.value for each in score.status[0].values}


def test_what_the_hand_did_is_told_as_numbers_and_steps(bench, scanned):
    scores, part = scanned
    area = "Smallest Part of the Area at Rest of vein, %"
    bench.spin_until(lambda: float(values(scores[-1]).get(area, "100")) < 90)
    found = values(scores[-1])
    assert float(found["Path Length, mm"]) == pytest.approx(110.0)
    assert float(found["Peak Probe Force, N"]) == pytest.approx(5.0)
    assert float(found["Time in Contact, s"]) == pytest.approx(11.0)
    assert float(found[area]) == pytest.approx(100 * part, rel=1e-4)
    step = scores[-1].status[1]
    assert (step.level, step.message) == (DiagnosticStatus.OK, "held for 10.0 s")


def ask(bench, name):
    client = bench.peer.create_client(Trigger, f"scorer/{name}")
    bench.spin_until(client.service_is_ready)
    future = client.call_async(Trigger.Request())
    bench.spin_until(future.done)
    return future.result().success


@pytest.mark.slow
@pytest.mark.usefixtures("scanned")
def test_the_picture_is_drawn_once_passed_and_when_asked_for_and_cleared(bench):
    pictures = bench.collect(CompressedImage, "score/picture", latched=True)
    bench.spin_until(lambda: bool(pictures) and len(pictures[-1].data))  # the last step is done
    assert bytes(pictures[-1].data[:4]) == b"\x89PNG"
    before = len(pictures)
    assert ask(bench, "draw")
    bench.spin_until(lambda: len(pictures) > before)
    assert len(pictures[-1].data)
    assert ask(bench, "clear")
    bench.spin_until(lambda: not len(pictures[-1].data))
    assert not ask(bench, "draw")  # of nothing


def test_clear_begins_anew(bench, scanned):
    scores, _ = scanned
    assert ask(bench, "clear")
    press(bench, 0.0, 2)
    bench.spin_until(lambda: values(scores[-1])["Elapsed Time, s"] == "1")
    assert scores[-1].status[1].level == DiagnosticStatus.WARN


def test_an_exercise_of_a_vessel_that_the_scene_lacks_is_refused(bench, small_scene, tmp_path):
    file = tmp_path / "centre.yaml"
    file.write_text("name: c\ntask: {kind: centre, structure: aorta}\n")
    with pytest.raises(ScoreError, match="aorta"):
        bench.make(Scorer, scene=str(small_scene), exercise=str(file))


def test_a_step_says_where_it_is_to_be_done(bench, small_scene, tmp_path):
    file = tmp_path / "two.yaml"
    file.write_text("name: c\ntask: {kind: compression, points: [1 cm]}\n")
    node = bench.make(Scorer, scene=str(small_scene), exercise=str(file))
    scores = bench.collect(DiagnosticArray, "score", latched=True)
    press(bench, 0.0, 2)
    bench.spin_until(lambda: bool(scores))
    step = scores[-1].status[1]
    assert step.level == DiagnosticStatus.WARN
    [target] = [json.loads(each.value) for each in step.values if each.key == "target"]
    place = node._live.lines["vein"].interpolate_point(0.01)
    np.testing.assert_allclose(target, [place], atol=1e-4)


def statuses(score, kind):
    return [each for each in score.status if each.hardware_id == kind]


def test_the_result_is_written_when_the_attempt_has_ended(bench, small_scene, tmp_path):
    file = tmp_path / "hold.yaml"
    file.write_text(KEEP)
    out = tmp_path / "class"
    bench.make(
        Scorer, scene=str(small_scene), exercise=str(file), student="A. B.", results=str(out)
    )
    press(bench, 5.0)
    bench.spin_until(lambda: len(list(out.glob("*.json"))) == 1)
    result = json.loads(next(out.glob("*.json")).read_text())
    assert (result["state"], result["about"]["student"]) == ("passed", "A. B.")
    assert len(result["about"]["checksum"]) == 12
    assert list(result["plain"].values()) == ["8", "5", "0", "110", "1"]
    page = next(out.glob("*.html")).read_text()
    assert "Passed" in page
    assert "data:image/png" in page


def test_a_result_that_cannot_be_written_is_kept_and_tried_again_at_the_end(
    bench, small_scene, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hold.yaml").write_text(KEEP)
    out = tmp_path / "class"
    out.write_text("no folder")
    given = {"exercise": str(tmp_path / "hold.yaml"), "results": str(out)}
    node = bench.make(Scorer, scene=str(small_scene), **given)
    press(bench, 5.0)
    bench.spin_until(lambda: KEPT_FOLDER in node.health.warning)
    kept = list((tmp_path / KEPT_FOLDER).iterdir())
    assert sorted(file.suffix for file in kept) == [".html", ".json"]
    out.unlink()
    node.destroy_node()
    assert sorted(file.suffix for file in out.iterdir()) == [".html", ".json"]
    assert not any(file.exists() for file in kept)


def press(bench, newtons, seconds=12):
    """Publish poses and forces, the first of them in the air."""
    poses = bench.publisher(PoseStamped, "probe/pose")
    wrenches = bench.publisher(WrenchStamped, "probe/wrench")
    for second in range(seconds):
        pose = pose_at(0.0, second + 1, x=0.01 * (second % 2))
        poses.publish(pose)
        force = np.array([0.0, 0.0, -newtons if second else 0.0])
        wrenches.publish(wrench_message(force, np.zeros(3), pose.header.stamp, "probe"))


def test_an_attempt_that_a_killed_scorer_forgot_is_void_until_it_is_begun_anew(
    bench, small_scene, tmp_path
):
    (tmp_path / "hold.yaml").write_text(KEEP)
    given = {"scene": str(small_scene), "exercise": str(tmp_path / "hold.yaml")}
    bench.make(Scorer, **given, begun=12.5)
    scores = bench.collect(DiagnosticArray, "score", latched=True)
    press(bench, 5.0)
    bench.spin_until(lambda: bool(scores))
    assert statuses(scores[-1], "plain")[0].message == "void"
    assert "begin anew" in statuses(scores[-1], "fault")[0].message
    assert ask(bench, "clear")
    press(bench, 5.0)
    bench.spin_until(lambda: statuses(scores[-1], "plain")[0].message != "void")
    assert not statuses(scores[-1], "fault")


def test_answers_are_refused_where_an_exercise_asks_nothing(node):
    refused = node.set_parameters([Parameter("answers", value=["compressible"])])[0]
    assert not refused.successful
    assert "asks nothing" in refused.reason


@pytest.fixture
def examination(bench, small_scene, tmp_path):
    """The scorer of an exercise that tells nothing before all is answered."""
    file = tmp_path / "blind.yaml"
    file.write_text(BLIND)
    return bench.make(
        Scorer, scene=str(small_scene), exercise=str(file), results=str(tmp_path / "class")
    )


def answer(node):
    points = Parameter("answers", value=["compressible"] * 3)
    assert all(
        node.set_parameters([each])[0].successful
        for each in (points, Parameter("thrombus", value="none"))
    )


def test_an_examination_tells_no_metrics_and_draws_no_picture_before_its_end(
    bench, examination, tmp_path
):
    scores = bench.collect(DiagnosticArray, "score", latched=True)
    pictures = bench.collect(CompressedImage, "score/picture", latched=True)
    press(bench, 5.0)
    bench.spin_until(lambda: bool(scores) and told(scores[-1], "plain")["Highest force, N"] == "5")
    assert statuses(scores[-1], "plain")[0].message == "running"
    assert not values(scores[-1])
    assert not ask(bench, "draw")
    bench.spin_for(20)
    assert not any(len(each.data) for each in pictures)
    assert not (tmp_path / "class").exists()
    answer(examination)
    bench.spin_until(lambda: bool(values(scores[-1])) and len(pictures[-1].data) > 0)
    [result] = [json.loads(each.read_text()) for each in (tmp_path / "class").glob("*.json")]
    assert result["metrics"] == values(scores[-1])
    assert ask(bench, "draw")


@pytest.mark.usefixtures("examination")
def test_an_examination_that_is_abandoned_is_kept_without_a_picture(bench, tmp_path):
    scores = bench.collect(DiagnosticArray, "score", latched=True)
    press(bench, 5.0)
    bench.spin_until(lambda: bool(scores) and told(scores[-1], "plain")["Highest force, N"] == "5")
    assert ask(bench, "clear")
    [page] = (tmp_path / "class").glob("*.html")
    assert "<img" not in page.read_text()


def told(score, kind):
    return {each.key: each.value for each in statuses(score, kind)[0].values}


def test_an_arm_is_known_once_an_examination_of_it_has_ended(bench, examination):
    scores = bench.collect(DiagnosticArray, "score", latched=True)

    def begin_anew():
        assert ask(bench, "clear")
        scores.clear()
        press(bench, 5.0)
        bench.spin_until(lambda: bool(scores))
        return told(scores[-1], "about")["arm"]

    press(bench, 5.0)
    bench.spin_until(lambda: bool(scores))
    assert begin_anew() == ""  # nothing was told
    answer(examination)
    bench.spin_until(lambda: statuses(scores[-1], "plain")[0].message == "not passed")
    assert told(scores[-1], "about")["arm"] == ""
    assert begin_anew() == "known from an attempt before"


@pytest.mark.usefixtures("node")
def test_a_setting_that_is_changed_meanwhile_stands_in_the_result(bench):
    events = bench.publisher(ParameterEvent, "/parameter_events")
    scores = bench.collect(DiagnosticArray, "score", latched=True)
    press(bench, 5.0)
    for name in ("slice_interpolator", "viewer"):
        gain = Parameter("gain", value=3.0).to_parameter_msg()
        stamp = pose_at(0.0, 5).header.stamp
        events.publish(ParameterEvent(stamp=stamp, node=f"/{name}", changed_parameters=[gain]))
    bench.spin_until(lambda: bool(scores) and told(scores[-1], "about")["changed"] != "")
    assert told(scores[-1], "about")["changed"] == "slice_interpolator.gain = 3.0 at 4 s"
    assert ask(bench, "clear")
    scores.clear()
    press(bench, 5.0)
    bench.spin_until(lambda: bool(scores))
    assert told(scores[-1], "about")["changed"] == "slice_interpolator.gain = 3.0 before"


@pytest.mark.usefixtures("node")
def test_who_moves_the_probe_stands_in_the_result(bench):
    bench.peer.create_publisher(PoseStamped, "tracker/pose", 1)
    scores = bench.collect(DiagnosticArray, "score", latched=True)
    press(bench, 5.0)
    bench.spin_until(lambda: bool(scores))
    bench.spin_until(lambda: told(scores[-1], "about")["moved by"] == "bench")
    bench.peer.create_publisher(WrenchStamped, "probe/wrench", 1)
    bench.spin_until(lambda: told(scores[-1], "about")["others"] == "bench")


def test_what_was_chosen_at_the_start_stands_in_the_result(bench, small_scene, tmp_path):
    (tmp_path / "hold.yaml").write_text(KEEP)
    exercise = str(tmp_path / "hold.yaml")
    bench.make(Scorer, scene=str(small_scene), exercise=exercise, chosen=["scene.seed = 7"])
    scores = bench.collect(DiagnosticArray, "score", latched=True)
    press(bench, 5.0)
    bench.spin_until(lambda: bool(scores))
    about = told(scores[-1], "about")
    assert about["changed"] == "scene.seed = 7 before"
    assert about["scene checksum"] == load_scene(str(small_scene)).compute_checksum()


def test_nothing_counts_after_the_end(bench, node):
    scores = bench.collect(DiagnosticArray, "score", latched=True)
    press(bench, 5.0)
    bench.spin_until(lambda: bool(scores) and told_state(scores[-1]) == "passed")
    before = values(scores[-1])
    press(bench, 9.0, 40)
    bench.spin_until(lambda: node.health.received >= 104)
    count = len(scores)
    bench.spin_until(lambda: len(scores) > count)
    assert values(scores[-1]) == before


def told_state(score):
    return statuses(score, "plain")[0].message


def test_an_attempt_does_not_begin_before_the_tissue_answers(bench, node):
    scores = bench.collect(DiagnosticArray, "score", latched=True)
    poses = bench.publisher(PoseStamped, "probe/pose")
    for second in range(100):
        poses.publish(pose_at(0.0, second + 1, x=0.01 * second))
    bench.spin_until(lambda: node.health.received >= 100)
    node._publish_score()  # as once a second
    bench.spin_for(30)
    assert not scores
    press(bench, 5.0)
    bench.spin_until(lambda: bool(scores) and told(scores[-1], "plain")["Highest force, N"] == "5")
    assert float(told(scores[-1], "plain")["Time, s"]) < 20


def test_nobody_answers_before_the_first_touch(bench, examination):
    press(bench, 0.0)
    bench.spin_for(20)
    refused = examination.set_parameters([Parameter("answers", value=["compressible"])])[0]
    assert not refused.successful
    assert "first touch" in refused.reason


def test_answers_go_to_their_points_in_any_order(bench, examination):
    node = examination
    scores = bench.collect(DiagnosticArray, "score", latched=True)
    press(bench, 5.0)
    bench.spin_until(lambda: bool(scores))
    answers = Parameter("answers", value=["-", "not seen"])
    assert node.set_parameters([answers])[0].successful
    bench.spin_until(lambda: bool(scores) and "not seen" in statuses(scores[-1], "step")[1].message)
    assert "no answer yet" in statuses(scores[-1], "step")[0].message
    assert not node.set_parameters([Parameter("thrombus", value="4")])[0].successful
    assert ask(bench, "clear")
    assert node.get_parameter("answers").value == [""]
