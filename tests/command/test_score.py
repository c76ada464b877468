"""The command `score`: sessions whose values are known, its files, and what is left out."""

import csv
import json

import numpy as np
import pytest
from session_files import EPOCH, PERIOD, TYPES, T, cloud, image, pose, press, write

from us_sim.command.main import main
from us_sim.recording.schemas import load_jazzy_definitions
from us_sim.recording.writer import BagWriter
from us_sim.run.session_score import read_scan
from us_sim.scene.building import build_tissue_model, load_volume
from us_sim.scene.reading import load_scene


def table(folder):
    with (folder / "score.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    return {(row["MetricName"], row["MetricRoles"]): row["MetricValue"] for row in rows}


@pytest.mark.slow
def test_a_press_of_8_newtons_for_two_seconds(tmp_path, capsys):
    session = write(tmp_path / "s.mcap", press(120))
    assert main(["score", str(session), "--out", str(tmp_path), "--force-limit", "4 N"]) == 0
    found = {name: float(value) for (name, _), value in table(tmp_path).items()}
    turn = np.pi * np.arange(120) / 120
    seconds = 119 * PERIOD * 1e-9
    assert found["Elapsed Time"] == pytest.approx(seconds, rel=1e-5)
    assert found["Path Length"] == pytest.approx(8 * np.abs(np.diff(np.sin(turn))).sum(), rel=1e-5)
    assert found["Peak Probe Force"] == pytest.approx(8.0)
    assert found["Time above 4 N"] == pytest.approx(2 * 2 / 3, abs=0.04)  # sin > 1/2
    page = (tmp_path / "score.md").read_text()
    assert "score.png" in page
    assert (tmp_path / "score.png").read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr().out
    assert "left out: areas" in said
    assert "Area" not in "".join(name for name, _ in table(tmp_path))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--exercise", "compresion"], "compression"),
        (["--exercise", "compression"], "without a scene"),
        (["--force-limit", "2 kg"], "--force-limit"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, capsys, options, said):
    session = write(tmp_path / "s.mcap", press(20))
    assert main(["score", str(session), *options]) == 1
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error


def test_a_file_that_is_no_bag_and_a_score_that_is_there_are_refused(tmp_path, capsys):
    (tmp_path / "x.mcap").write_text("no bag")
    assert main(["score", str(tmp_path / "x.mcap")]) == 1
    assert "x.mcap" in capsys.readouterr().err
    session = write(tmp_path / "s.mcap", press(20))
    (tmp_path / "score.md").write_text("mine")
    assert main(["score", str(session), "--out", str(tmp_path)]) == 1
    assert (tmp_path / "score.md").read_text() == "mine"


@pytest.fixture(scope="module")
def squashed(small_scene, tmp_path_factory):
    """A session along the vein whose tissue is pressed to half its height for a while."""
    model = build_tissue_model(load_scene(small_scene), load_volume(load_scene(small_scene)))
    rest, half = model.mesh.nodes, model.mesh.nodes * [1.0, 1.0, 0.5]
    layout = T["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    tetrahedra = T["std_msgs/msg/Int32MultiArray"](
        layout=layout, data=model.mesh.tetrahedra.astype(np.int32).ravel()
    )
    store = load_jazzy_definitions()
    mesh = store.serialize_cdr(tetrahedra, "std_msgs/msg/Int32MultiArray", little_endian=True)
    file = tmp_path_factory.mktemp("squashed") / "s.mcap"
    latched = {
        "/tissue/rest": ("sensor_msgs/msg/PointCloud2", cloud(EPOCH, rest)),
        "/tissue/tetrahedra": ("std_msgs/msg/Int32MultiArray", mesh),
    }
    with BagWriter(file, sidecar=False) as bag:
        for topic, kind in TYPES.items():
            bag.add_topic(topic, kind)
        bag.attach_file("scene.yaml", "text/yaml", small_scene.read_bytes(), EPOCH)
        for topic, (kind, data) in latched.items():
            bag.add_topic(topic, kind)
            bag.write_message(topic, data, EPOCH)
        for k in range(9):
            stamp = EPOCH + k * 10**8
            nodes = half if 3 <= k < 6 else rest
            pixels = np.zeros((80, 96), np.uint8)
            for topic, data in (
                ("/probe/pose", pose(stamp, x=0.002)),
                ("/tissue/nodes", cloud(stamp, nodes)),
                ("/ultrasound/image", image(stamp, pixels)),
            ):
                bag.write_message(topic, data, stamp)
    return file


def test_areas_of_the_attached_scene(squashed):
    scan = read_scan(squashed)
    assert scan.force is None
    vein = scan.sections["vein"]
    assert vein.fraction[[0, 1, 7, 8]] == pytest.approx(1.0)
    assert vein.fraction[3:6] == pytest.approx(0.5, abs=0.06)
    assert abs(vein.lateral).max() < 2e-3
    assert scan.lines["vein"].lengths[-1] == pytest.approx(0.06, abs=0.004)


def test_a_centred_vein_is_held(squashed, tmp_path, capsys):
    file = tmp_path / "e.yaml"
    file.write_text("name: c\ntask: {kind: centre, structure: vein, duration: 0.7 s}\n")
    assert main(["score", str(squashed), "--exercise", str(file)]) == 0
    assert "passed: 1 of 1" in capsys.readouterr().out
    file.write_text("name: c\ntask: {kind: centre, structure: aorta}\n")
    assert main(["score", str(squashed), "--exercise", str(file)]) == 1
    assert "aorta" in capsys.readouterr().err


def test_the_results_of_a_class_are_one_table(tmp_path, capsys):
    about = {"student": "Ada", "begun": "2026-11-29T07:00:00+00:00"}
    result = {"name": "Press", "state": "passed", "about": about, "steps": [], "faults": []}
    (tmp_path / "a.json").write_text(json.dumps({**result, "plain": {"Time, s": "12"}}))
    assert main(["score", "--class", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    assert "Ada" in capsys.readouterr().out
    assert "Press" in (tmp_path / "out" / "class.csv").read_text()
    assert main(["score", "--class", str(tmp_path), "--out", str(tmp_path / "out")]) == 1
    assert "exists already" in capsys.readouterr().err
    assert main(["score"]) == 1
    assert "--class" in capsys.readouterr().err
