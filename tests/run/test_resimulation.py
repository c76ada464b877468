"""A session holds all that it takes to be simulated again; a sentence where it does not."""

import hashlib

import numpy as np
import pytest
from session_files import EPOCH, press, write

from us_sim.command.main import main
from us_sim.nodes.sessions.attachments import session_attachments
from us_sim.nodes.settings import SessionRecorderSettings
from us_sim.recording.path import ProbePath, read_path, write_poses
from us_sim.recording.repair import versions
from us_sim.recording.writer import BagWriter
from us_sim.run.plan import parameters_file, simulation_nodes
from us_sim.run.resimulation import resimulation
from us_sim.scene.reading import load_scene
from us_sim.volume.files.writing import write_volume
from us_sim.volume.volume import Volume


@pytest.fixture
def scene(tmp_path):
    voxels = np.random.default_rng(1).integers(0, 255, (180, 180, 180), dtype=np.uint8)
    write_volume(tmp_path / "large.nrrd", Volume(voxels, np.diag([5e-4, 5e-4, 5e-4, 1.0])))
    file = tmp_path / "plain.yaml"
    probe = "{aperture: 40 mm, depth: 30 mm}"
    file.write_text(f"name: plain\nvolume: {{file: large.nrrd}}\nprobe: {probe}\n")
    return file


@pytest.fixture
def attached(scene):
    """The attachments of a session of it, with a parameter that a person gave."""
    nodes = simulation_nodes(load_scene(scene), {"slice_interpolator": {"stale_after": "0.7"}})
    settings = SessionRecorderSettings(scene=str(scene), parameters=parameters_file(nodes))
    return {name: data for name, (_, data) in session_attachments(settings).items()}


def prepared(tmp_path, attached, **options):
    session = write(tmp_path / "session.mcap", press(30), attached)
    return resimulation(session, tmp_path / "again", **options)


def refused(tmp_path, capsys, attached, *options):
    session = write(tmp_path / "session.mcap", press(30), attached)
    out = tmp_path / "out"
    assert main(["render", "--session", str(session), "--out", str(out), *map(str, options)]) == 1
    assert not out.exists()
    return capsys.readouterr().err


def test_poses_and_parameters_are_those_of_the_session(tmp_path, attached):
    again, note = prepared(tmp_path, attached)
    assert again.topic == "/probe/pose"
    recorded = read_path(tmp_path / "session.mcap", "/probe/pose")
    played = read_path(again.path)
    for name in ("stamps", "log_times", "positions", "orientations"):
        assert (getattr(played, name) == getattr(recorded, name)).all()
    assert again.parameters["slice_interpolator"] == {"stale_after": "0.7"}
    assert again.parameters["probe_tracker"] == {"filter": "none"}  # these poses were filtered
    assert note == ""
    assert again.scene.volume.file == str(tmp_path / "large.nrrd")


def test_poses_of_a_tracker_are_filtered_again(tmp_path, attached):
    stamps = EPOCH + np.arange(5) * 10**7
    poses = np.zeros((5, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (5, 1))
    with BagWriter(tmp_path / "both.mcap", sidecar=False) as bag:
        write_poses(bag, ProbePath("/tracker/pose", "patient", stamps, *poses))
        for name, data in attached.items():
            bag.attach(name, "text/plain", data, EPOCH)
    again, _ = resimulation(tmp_path / "both.mcap", tmp_path / "again")
    assert again.topic == "/tracker/pose"
    assert again.parameters["probe_tracker"] == {}


def test_without_a_scene(tmp_path, capsys):
    told = refused(tmp_path, capsys, {})
    assert "has no scene attached" in told


def test_a_volume_that_is_gone(tmp_path, capsys, attached):
    (tmp_path / "large.nrrd").unlink()
    told = refused(tmp_path, capsys, attached)
    assert "large.nrrd, which was too large to be attached and is not there" in told


def test_a_volume_of_another_hash(tmp_path, capsys, attached):
    file = tmp_path / "large.nrrd"
    then = hashlib.sha256(file.read_bytes()).hexdigest()
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    now = hashlib.sha256(file.read_bytes()).hexdigest()
    told = refused(tmp_path, capsys, attached)
    assert f"(SHA-256 {now[:12]}… where {then[:12]}… was)" in told


def test_a_volume_elsewhere(tmp_path, capsys, attached):
    moved = tmp_path / "elsewhere.nrrd"
    (tmp_path / "large.nrrd").rename(moved)
    assert prepared(tmp_path, attached, volume=moved)[0].scene.volume.file == str(moved)
    (tmp_path / "session.mcap").unlink()
    other = tmp_path / "other.nrrd"
    write_volume(other, Volume(np.zeros((9, 9, 9), np.uint8), np.eye(4)))
    told = refused(tmp_path, capsys, attached, "--volume", other)
    assert "other.nrrd is not the volume that" in told


@pytest.mark.slow
def test_other_versions_are_told(tmp_path, attached):
    text = versions()
    numpy = next(line for line in text.splitlines() if line.startswith("numpy "))
    attached["versions.txt"] = text.replace(numpy, "numpy 1.20.0").encode()
    _, note = prepared(tmp_path, attached)
    assert f"was made with numpy 1.20.0 (now {np.__version__}): images may differ" in note


def test_unknown_versions_are_told(tmp_path, attached):
    del attached["versions.txt"]
    _, note = prepared(tmp_path, attached)
    assert "does not say with which versions it was made" in note


def test_parameters_that_are_none(tmp_path, capsys, attached):
    attached["parameters.yaml"] = b"slice_interpolator: 3\n"
    assert "holds no parameters of nodes" in refused(tmp_path, capsys, attached)


def test_a_scene_beside_a_session(tmp_path, capsys, attached, scene):
    told = refused(tmp_path, capsys, attached, scene)
    assert "leave out the scene, --case, --path and --topic" in told
